"""Scores of what an ear is given and of how true a simulator is; most need the extra ``eval``."""

from hlsim.evaluation.fidelity import fidelity_markdown, summarise
from hlsim.evaluation.folders import haspi_report
from hlsim.evaluation.haspi import HaspiItem, haspi_many
from hlsim.evaluation.report import HaspiReport, ItemScore, write_report
from hlsim.evaluation.significance import PairedComparison, paired_comparison

__all__ = [
    "HaspiItem",
    "HaspiReport",
    "ItemScore",
    "PairedComparison",
    "fidelity_markdown",
    "haspi_many",
    "haspi_report",
    "paired_comparison",
    "summarise",
    "write_report",
]

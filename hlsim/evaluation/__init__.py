"""Scores of what an ear is given and of how true a simulator is; most need the extra ``eval``."""

from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.haspi_report import HaspiReport, haspi_report
from hlsim.evaluation.scores import Failure, ItemScore
from hlsim.evaluation.scoring import FileItem, score_items
from hlsim.evaluation.simulators import summarise
from hlsim.evaluation.statistics import (
    PairedComparison,
    bootstrap_interval,
    holm,
    paired_comparison,
)
from hlsim.evaluation.store import ScoreStore

__all__ = [
    "Comparison",
    "Failure",
    "FileItem",
    "HaspiReport",
    "ItemScore",
    "PairedComparison",
    "ScoreStore",
    "bootstrap_interval",
    "haspi_report",
    "holm",
    "paired_comparison",
    "score_items",
    "summarise",
]

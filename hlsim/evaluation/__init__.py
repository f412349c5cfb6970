"""Studies of hearing aids and simulators: items, conditions and measures in, one table out."""

from hlsim.evaluation.comparison import ConditionComparison, compare
from hlsim.evaluation.measures import MEASURES
from hlsim.evaluation.recordings import haspi_report
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.store import ScoreStore
from hlsim.evaluation.study import Condition, Item, Measure, run_study

__all__ = [
    "MEASURES",
    "ConditionComparison",
    "Condition",
    "Evaluation",
    "Item",
    "Measure",
    "ScoreStore",
    "compare",
    "haspi_report",
    "run_study",
]

"""A digits-in-noise test of a simulated ear, which measures its speech reception threshold."""

from hlsim.evaluation.digits.psychometric import Estimate
from hlsim.evaluation.digits.recogniser import DigitListener, load_listener
from hlsim.evaluation.digits.speech_reception import (
    DigitTest,
    ReceptionThreshold,
    reception_threshold,
)

__all__ = [
    "DigitListener",
    "DigitTest",
    "Estimate",
    "ReceptionThreshold",
    "load_listener",
    "reception_threshold",
]

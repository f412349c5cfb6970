"""The exact MSBG model of hearing loss."""

from hlsim.msbg.delay import estimate_delay
from hlsim.msbg.model import MSBG

__all__ = ["MSBG", "estimate_delay"]

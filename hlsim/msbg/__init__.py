"""The exact MSBG model of hearing loss."""

from hlsim.msbg.model import MSBG

__all__ = ["MSBG"]

"""The version of hlsim, for the package metadata and for checkpoints."""

__version__ = "0.1.0"

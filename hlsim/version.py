"""The version of hlsim, which the package metadata and the checkpoints state, too."""

__version__ = "0.1.0"

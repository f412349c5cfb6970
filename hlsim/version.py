"""The version of hlsim, for the package metadata, checkpoints and the command line."""

__version__ = "0.1.0"

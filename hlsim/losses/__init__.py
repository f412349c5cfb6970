"""What a loss compares of two waveforms."""

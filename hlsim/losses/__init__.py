"""Training losses that compare two waveforms."""

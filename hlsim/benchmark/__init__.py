"""Times simulators, a training step and the scan."""

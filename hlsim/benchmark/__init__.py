"""Times simulators, a training step and metrics."""

"""Speech, noise and ears from which trainings and evaluations draw, and bundled speech."""

"""Speech, noise and ears for training and evaluation: corpora, random clips, bundled speech."""

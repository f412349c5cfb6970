"""Corpora of speech: their layouts, manifests and training instances."""

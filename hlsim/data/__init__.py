"""Corpora, plans, instances, augmentation: what training reads."""

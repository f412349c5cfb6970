"""Gains of a fitted aid: export to other programs, and verification from two recordings."""

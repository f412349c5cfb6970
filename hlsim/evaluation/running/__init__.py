"""Runs of studies: in parallel, with stored scores, and with hashes that keep them valid."""

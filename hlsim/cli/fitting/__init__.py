"""Commands around the gains of a fitted aid."""

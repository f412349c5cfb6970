"""Kates' model of the ear, on which the scores HASPI, HASQI and HAAQI are based."""

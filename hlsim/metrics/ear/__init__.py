"""Kates' model of the ear, on which HASPI, HASQI and HAAQI rest."""

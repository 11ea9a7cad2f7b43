"""Corners: scenes in which any two features meet, each judged by formulas that are not those of the package."""

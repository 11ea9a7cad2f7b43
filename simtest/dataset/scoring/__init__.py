"""Scores answers that were made elsewhere."""

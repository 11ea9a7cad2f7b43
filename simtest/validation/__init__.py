"""Experiments, metrics, error laws and statistics."""

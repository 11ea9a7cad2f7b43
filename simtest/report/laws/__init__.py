"""The error laws: what was measured against what they predict."""

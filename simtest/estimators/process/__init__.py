"""Cores in any language: estimators that run in a process of their own and are asked over pipes or files."""

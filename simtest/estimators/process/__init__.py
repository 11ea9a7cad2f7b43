"""Cores in any language: estimators that run in a process of their own and are asked over pipes or files."""

PREFIX = "command:"  # what a name of an estimator begins with where it is a command


def is_core(name: str) -> bool:
    """Return whether an estimator's name is a command or a core's TOML file."""
    return name.startswith(PREFIX) or name.endswith(".toml")

"""Cores in any language: estimators that run in a process of their own and are asked over pipes or files.

`command` reads how a core is started, `child` starts and ends its process, `wire` frames the messages, `core` asks it
and starts it again after a fault, `requests` and `answers` translate, `files` hands arrays over in a folder, and
`estimator` makes estimators of cores.
"""

PREFIX = "command:"
"""What a name of an estimator begins with where it is a command."""


def is_core(name: str) -> bool:
    """Return whether an estimator's name is a command or a core's TOML file."""
    return name.startswith(PREFIX) or name.endswith(".toml")

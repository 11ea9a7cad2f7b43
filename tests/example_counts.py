"""How many examples a property test draws: all, or in `make test` a few of them."""

import os

FEW = 40


def examples(count: int) -> int:
    """Return the number of examples of a test that draws `count` of them; `SIMTEST_EXAMPLES=few` bounds it by `FEW`."""
    return min(count, FEW) if os.environ.get("SIMTEST_EXAMPLES") == "few" else count

"""Where the package keeps what it can make again."""

from pathlib import Path

import platformdirs


def user_cache() -> Path | None:
    """Return the user's cache folder of this package; None for a user without a home, as in some containers."""
    try:
        return Path(platformdirs.user_cache_dir("simtest"))
    except RuntimeError:
        return None

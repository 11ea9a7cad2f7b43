"""The logger "simtest": steps as debug messages, and warnings where a program wants them there.

The package warns as Python does (`warnings`): that is seen without any setting, and what is kept on disk or discarded
depends on it.
"""

import logging
import warnings

LOGGER = logging.getLogger("simtest")
LOGGER.addHandler(logging.NullHandler())


def log_warnings() -> None:
    """Send the warnings of this process to the logger, as `logging.captureWarnings` sends them to "py.warnings".

    Examples
    --------
    >>> import logging, warnings
    >>> from simtest.runtime.messages import log_warnings
    >>> logging.getLogger("simtest").addHandler(logging.FileHandler("simtest.log"))  # doctest: +SKIP
    >>> log_warnings()  # doctest: +SKIP
    """
    warnings.showwarning = _log


def _log(message: Warning | str, *_: object, **__: object) -> None:
    LOGGER.warning("%s", message)

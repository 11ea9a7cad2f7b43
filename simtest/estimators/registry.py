"""Estimators by name: those of packages (entry-point group ``simtest.estimators``), and those of the user's own."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from simtest.errors import InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.estimators.process import is_core
from simtest.estimators.protocol import AnyEstimator, Estimator, FrameEstimator
from simtest.runtime.resources import SUFFIX, parse_model


def as_estimator(name: str, given: object) -> AnyEstimator:
    """Return an object as an estimator; raise `InputError` if it is none, or a class where an instance is meant."""
    if isinstance(given, type):
        raise InputError(f"estimator {name!r}: {given.__qualname__} is a class; must be an instance of it")
    if isinstance(given, Estimator | FrameEstimator):
        return given
    raise InputError(
        f"estimator {name!r}: {given!r:.80} has neither estimate(patch, camera, priors) nor "
        "estimate_frame(frame, camera, priors)"
    )


def load_estimators(estimators: Sequence[str] | Mapping[str, object]) -> dict[str, AnyEstimator]:
    """Load estimators by name, or take those of a mapping, in the given order.

    A name is as registered, or "package:name" where two packages register it; or it is a core's
    (`simtest.estimators.process.command.parse_core`), which is started, or that of a network of the user's own
    ("learned_spot:FILE.onnx", `simtest.runtime.resources`), which is read. Both stand under their short names.

    Raises
    ------
    InputError
        If a name is unknown, ambiguous or given twice, its package cannot be imported, an object is no estimator, a
        core cannot be started, a network cannot be used, or either has the name of an installed estimator.
    """
    if isinstance(estimators, Mapping):
        return {name: as_estimator(name, given) for name, given in estimators.items()}
    loaded: dict[str, AnyEstimator] = {}
    for name in estimators:
        short, given = _core(name) if is_core(name) else _network(name) if parse_model(name) else _plain(name)
        if short in loaded:
            raise InputError(f"estimator {short!r}: given twice")
        loaded[short] = as_estimator(name, given)
    return loaded


def _plain(name: str) -> tuple[str, object]:
    """Return the name and estimator of a registered name; errors say what else it may have meant."""
    if "," in name:
        each = " ".join(f"--estimator {part.strip()}" for part in name.split(","))
        raise InputError(f"estimator {name!r}: one name each; several are given as {each}")
    if name.endswith(SUFFIX):
        raise InputError(
            f"estimator {name!r}: is no estimator's name; a network stands behind what runs it, as in "
            f"learned_spot:{Path(name)}"
        )
    if " " in name.strip() or "/" in name:
        raise InputError(f"estimator {name!r}: is no estimator's name; a program of yours needs 'command: ' before it")
    return name, _installed(name)


def _network(name: str) -> tuple[str, object]:
    """Return the short name of an estimator with a user's network, and the estimator."""
    from simtest.estimators.process.naming import short_name

    # Loaded first: an unknown estimator is told before the name that its results would bear.
    given = ESTIMATORS.load(name)
    return short_name(name), given


def _installed(name: str) -> object:
    """Return an installed estimator; where there is none, but a file of its name, the error says how that is run."""
    try:
        return ESTIMATORS.load(name)
    except InputError as error:
        if name in ESTIMATORS.names() or not Path(name).is_file():
            raise
        how = f"python {name}" if name.endswith(".py") else f"./{name}"
        raise InputError(f"{error}; the file {name} is run by 'command: {how}'") from error


def _core(name: str) -> tuple[str, object]:
    """Return a core's short name and its estimator; imported at need, since few runs name one."""
    from simtest.estimators.process.estimator import load_core
    from simtest.estimators.process.naming import short_name

    return short_name(name), load_core(name)

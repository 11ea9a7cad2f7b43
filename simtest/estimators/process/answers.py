"""What a core answers: messages as estimates and failures; what they hold, `estimate_check` judges."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.estimators.estimate_check import ROUNDED, Refused, check, unit_vector
from simtest.estimators.isophote_fit import FittedIsophote
from simtest.estimators.process.core import MAX_ISOPHOTES, Hello
from simtest.estimators.process.wire import Message, excerpt
from simtest.estimators.protocol import Estimate, EstimatedCurvature, Target
from simtest.geometry import Array, Camera
from simtest.geometry.vectors import basis_across

MAX_ESTIMATES = 10_000
OWN_REASONS = ("core_", "estimator_error")
"""How the reasons begin that simtest alone gives."""


def estimate_of(answer: Message, camera: Camera, hello: Hello) -> Estimate | Failure:
    """Return a core's answer about one highlight.

    An estimate with a malformed field is a Failure ``estimator_error``, one that is not finite ``not_finite``.
    """
    if answer.header["type"] == "failure":
        return _failure(answer.header)
    return check(_read({**answer.header, **answer.arrays}, camera, hello), camera)


def estimates_of(answer: Message, camera: Camera, hello: Hello) -> list[Estimate | Failure] | Failure:
    """Return a core's answer about a frame, each estimate as it was read: `check` judges it where it is assigned."""
    if answer.header["type"] == "failure":
        return _failure(answer.header)
    try:
        return [_read(fields, camera, hello) for fields in _listed(answer)]
    except Refused as refused:
        return refused.failure


def _read(fields: Mapping[str, Any], camera: Camera, hello: Hello) -> Estimate | Failure:
    """Return an estimate of its fields, or what is wrong with the first that cannot be read."""
    try:
        return _estimate(fields, camera, hello.target)
    except Refused as refused:
        return refused.failure


def _listed(answer: Message) -> list[dict[str, Any]]:
    """Return the fields of each estimate: those of the list, and an element of each array."""
    lengths = {len(array) if array.ndim else -1 for array in answer.arrays.values()}
    count = max(lengths, default=0)
    listed = answer.header.get("estimates", [{}] * min(count, MAX_ESTIMATES))
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise Refused(f"estimates: {_told(listed)}; must be a list of objects")
    if (most := max(count, len(listed))) > MAX_ESTIMATES:
        raise Refused(f"{most} estimates of a frame; at most {MAX_ESTIMATES}")
    if lengths - {len(listed)}:
        raise Refused(f"arrays of lengths {sorted(lengths)} for {len(listed)} estimates")
    return [each | {name: array[i] for name, array in answer.arrays.items()} for i, each in enumerate(listed)]


def _failure(header: Mapping[str, Any]) -> Failure:
    """Return a core's own failure; a reason that simtest does not know is kept as text."""
    reason, detail = header.get("reason", ""), header.get("detail", "")
    if not isinstance(reason, str) or not isinstance(detail, str):
        return Failure(Reason.ESTIMATOR_ERROR, "failure: reason and detail must be text")
    shown = excerpt(detail.encode("utf-8", "replace"), 300)
    if reason in set(Reason) and not reason.startswith(OWN_REASONS):
        return Failure(Reason(reason), shown)
    named = excerpt(reason.encode("utf-8", "replace"), 60)
    return Failure(Reason.NO_ESTIMATE, ": ".join(part for part in (named, shown) if part))


def _estimate(fields: Mapping[str, Any], camera: Camera, target: Target) -> Estimate:
    """Return an estimate of its fields; raise `Refused` at the first that cannot be read."""
    normal = unit_vector(_numbers(fields, "normal", (3,)), "normal")
    stated = fields.get("target")
    return Estimate(
        normal,
        normal[None] if fields.get("candidates") is None else _numbers(fields, "candidates", (None, 3)),
        _look(fields, camera),
        axis_ratio=_number(fields, "axis_ratio"),
        axis_ratio_deviation=_number(fields, "axis_ratio_deviation"),
        isophotes=_isophotes(fields.get("isophotes")),
        choice_margin=_number(fields, "choice_margin"),
        flags=_flags(fields.get("flags")),
        curvature=_curvature(fields.get("curvature")),
        target=target if stated is None else stated,
        **_uncertainty(fields, normal),
    )


def _look(fields: Mapping[str, Any], camera: Camera) -> Array:
    """Return the pixel at which an estimate is stated."""
    if fields.get("look_px") is not None:
        return _numbers(fields, "look_px", (2,))
    if fields.get("look_ray") is None:
        raise Refused("look_px or look_ray: missing; an estimate must say where it looks")
    look = camera.project(_numbers(fields, "look_ray", (3,)))
    if not np.isfinite(look).all():
        raise Refused("look_ray: the camera images no such direction")
    return look


def _uncertainty(fields: Mapping[str, Any], normal: Array) -> dict[str, Any]:
    """Return the covariance, or the budget, in the basis that simtest states them in."""
    turn = _turn(fields, normal)
    parts = fields.get("budget")
    if parts is None:
        if fields.get("covariance") is None:
            return {}
        return {"covariance": _covariance(fields, "covariance", turn)}
    if not isinstance(parts, Mapping):
        raise Refused(f"budget: {_told(parts)}; must be an object")
    return {"budget": {name: _covariance(parts, name, turn) for name in parts}}


def _turn(fields: Mapping[str, Any], normal: Array) -> Array:
    """Return the matrix, shape (2, 2), from the core's basis of the tangent plane to ours."""
    if fields.get("basis") is None:
        return np.eye(2)
    basis = _numbers(fields, "basis", (2, 3))
    frame = np.concatenate([basis, normal[None]])
    if np.abs(frame @ frame.T - np.eye(3)).max() > 2 * ROUNDED:
        raise Refused("basis: must be two unit vectors across each other and the normal")
    return np.asarray(basis_across(normal) @ basis.T)


def _covariance(fields: Mapping[str, Any], name: str, turn: Array) -> Array:
    """Return a covariance, rad^2, in our basis."""
    return np.asarray(turn @ _numbers(fields, name, (2, 2)) @ turn.T)


def _isophotes(given: object) -> tuple[FittedIsophote, ...]:
    """Return the isophotes that an estimate says it was made of: isovalue and cone of sightlines of each."""
    listed = [] if given is None else given
    if not isinstance(listed, list) or len(listed) > MAX_ISOPHOTES or not all(isinstance(i, Mapping) for i in listed):
        raise Refused(f"isophotes: {_told(given)}; must be at most {MAX_ISOPHOTES} objects")
    return tuple(_isophote(each) for each in listed)


def _isophote(given: Mapping[str, Any]) -> FittedIsophote:
    isovalue = float(_numbers(given, "isovalue", ()))
    cone, sightline = _numbers(given, "cone", (3, 3)), unit_vector(_numbers(given, "sightline", (3,)), "sightline")
    if not 0 < isovalue < 1:
        raise Refused(f"isovalue {isovalue:g}: must be in (0, 1)")
    made = FittedIsophote(isovalue, np.empty((0, 2)), None, cone, sightline)
    if np.abs(cone - cone.T).max() > ROUNDED * np.abs(cone).max() or isinstance(made.pose(), Failure):
        raise Refused("cone: must be symmetric, and an elliptic cone about the sightline")
    return made


def _curvature(given: object) -> EstimatedCurvature | None:
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise Refused(f"curvature: {_told(given)}; must be an object")
    if (ratio := _number(given, "axis_ratio")) is None:
        raise Refused("curvature axis_ratio: missing")
    hypotheses = None if given.get("hypotheses") is None else _numbers(given, "hypotheses", (None, 2))
    return EstimatedCurvature(_numbers(given, "directions", (2, 3)), ratio, hypotheses)


def _flags(given: object) -> tuple[str, ...]:
    if given is None:
        return ()
    if not isinstance(given, list) or not all(isinstance(flag, str) and " " not in flag for flag in given):
        raise Refused(f"flags: {_told(given)}; must be a list of words")
    return tuple(given)


def _number(fields: Mapping[str, Any], name: str) -> float | None:
    return None if fields.get(name) is None else float(_numbers(fields, name, ()))


def _numbers(fields: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Array:
    """Return a field as an array of this shape, None standing for any length; raise `Refused` if it is another."""
    given = fields.get(name)
    if given is None:
        raise Refused(f"{name}: missing")
    wanted = "a number" if not shape else f"numbers of shape ({', '.join('n' if n is None else str(n) for n in shape)})"
    try:
        values = given if isinstance(given, np.ndarray | np.generic) else np.array(_only_numbers(given), dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise Refused(f"{name}: {_told(given)}; must be {wanted}") from None
    if values.dtype.kind == "b":
        raise Refused(f"{name}: holds true or false; must be {wanted}")
    fits = len(values.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))
    if not fits:
        raise Refused(f"{name}: {_told(given)}; must be {wanted}")
    numbers: npt.NDArray[np.float64] = np.array(values, dtype=float)
    if not np.isfinite(numbers).all():
        raise Refused(f"{name} holds NaN or infinity", Reason.NOT_FINITE)
    return numbers


def _only_numbers(given: object) -> object:
    """Return nested lists of numbers as they are; raise `TypeError` where they hold text, true or false."""
    if isinstance(given, list):
        for each in given:
            _only_numbers(each)
    elif isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError
    return given


def _told(value: object) -> str:
    return excerpt(repr(value).encode("utf-8", "replace"), 60)

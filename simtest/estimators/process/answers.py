"""What a core answers: messages as estimates and failures, every field checked."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.estimators.isophote_fit import FittedIsophote
from simtest.estimators.process.core import MAX_ISOPHOTES, Hello
from simtest.estimators.process.wire import Message, excerpt
from simtest.estimators.protocol import LARGEST_VARIANCE, NEAR_PX, Estimate, EstimatedCurvature, Target
from simtest.geometry import Array, Camera
from simtest.geometry.vectors import basis_across

ROUNDED = 1e-3
"""A normal whose length differs from 1 by less was printed with few digits; it is made a unit vector."""

MAX_ESTIMATES = 10_000
MAX_CANDIDATES = 64
MAX_FLAGS = 16
MAX_PARTS = 16
OWN_REASONS = ("core_", "estimator_error")
"""How the reasons begin that simtest alone gives."""


class _Refused(Exception):
    """An answer that keeps to the protocol but states no estimate."""

    def __init__(self, reason: Reason, detail: str) -> None:
        super().__init__(detail)
        self.failure = Failure(reason, detail)


def estimate_of(answer: Message, camera: Camera, hello: Hello) -> Estimate | Failure:
    """Return a core's answer about one highlight.

    An estimate with a malformed field is a Failure ``estimator_error``, one that is not finite ``not_finite``.
    """
    if answer.header["type"] == "failure":
        return _failure(answer.header)
    try:
        return _estimate({**answer.header, **answer.arrays}, camera, hello.target)
    except _Refused as refused:
        return refused.failure


def estimates_of(answer: Message, camera: Camera, hello: Hello) -> list[Estimate] | Failure:
    """Return a core's answer about a frame; one malformed estimate refuses them all (see `estimate_of`)."""
    if answer.header["type"] == "failure":
        return _failure(answer.header)
    made: list[Estimate] = []
    try:
        for fields in _listed(answer):
            made.append(_estimate(fields, camera, hello.target))
    except _Refused as refused:
        return Failure(refused.failure.reason, f"estimate {len(made)}: {refused.failure.detail}")
    return made


def _listed(answer: Message) -> list[dict[str, Any]]:
    """Return the fields of each estimate: those of the list, and an element of each array."""
    lengths = {len(array) if array.ndim else -1 for array in answer.arrays.values()}
    count = max(lengths, default=0)
    listed = answer.header.get("estimates", [{}] * min(count, MAX_ESTIMATES))
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"estimates: {_told(listed)}; must be a list of objects")
    if (most := max(count, len(listed))) > MAX_ESTIMATES:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{most} estimates of a frame; at most {MAX_ESTIMATES}")
    if lengths - {len(listed)}:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"arrays of lengths {sorted(lengths)} for {len(listed)} estimates")
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
    """Return an estimate of its fields; raise `_Refused` at the first malformed one."""
    normal = _unit(_numbers(fields, "normal", (3,)), "normal")
    candidates = normal[None]
    if fields.get("candidates") is not None:
        given = _numbers(fields, "candidates", (None, 3))
        if not 1 <= len(given) <= MAX_CANDIDATES:
            raise _Refused(Reason.ESTIMATOR_ERROR, f"{len(given)} candidates; must be 1 to {MAX_CANDIDATES}")
        candidates = np.array([_unit(each, "candidate") for each in given])
        if np.abs(candidates[0] - normal).max() > ROUNDED:
            raise _Refused(Reason.ESTIMATOR_ERROR, "the first candidate must be the proposed normal")
        candidates[0] = normal
    stated = fields.get("target")
    if stated is not None and (not isinstance(stated, str) or stated not in ("fine", "base")):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"target {_told(stated)}; must be fine or base")
    return Estimate(
        normal,
        candidates,
        _look(fields, camera),
        axis_ratio=_ratio(fields, "axis_ratio"),
        axis_ratio_deviation=_deviation(fields, "axis_ratio_deviation"),
        isophotes=_isophotes(fields.get("isophotes")),
        choice_margin=_number(fields, "choice_margin"),
        flags=_flags(fields.get("flags")),
        curvature=_curvature(fields.get("curvature")),
        target=target if stated is None else stated,  # type: ignore[arg-type]
        **_uncertainty(fields, normal),
    )


def _look(fields: Mapping[str, Any], camera: Camera) -> Array:
    """Return the pixel at which an estimate is stated."""
    if fields.get("look_px") is not None:
        return _in_frame(_numbers(fields, "look_px", (2,)), camera)
    if fields.get("look_ray") is None:
        raise _Refused(Reason.ESTIMATOR_ERROR, "look_px or look_ray: missing; an estimate must say where it looks")
    look = camera.project(_numbers(fields, "look_ray", (3,)))
    if not np.isfinite(look).all():
        raise _Refused(Reason.ESTIMATOR_ERROR, "look_ray: the camera images no such direction")
    return _in_frame(look, camera)


def _in_frame(look: Array, camera: Camera) -> Array:
    """Return a pixel that lies in the frame, or next to it; raise `_Refused` for another."""
    (x, y), (width, height) = look.tolist(), (camera.width, camera.height)
    if not (-NEAR_PX <= x <= width + NEAR_PX and -NEAR_PX <= y <= height + NEAR_PX):
        raise _Refused(
            Reason.ESTIMATOR_ERROR, f"looks at the pixel ({x:g}, {y:g}); must lie in the frame of {width} x {height} px"
        )
    return look


def _uncertainty(fields: Mapping[str, Any], normal: Array) -> dict[str, Any]:
    """Return the covariance, or the budget, in the basis that simtest states them in."""
    turn = _turn(fields, normal)
    parts = fields.get("budget")
    if parts is None:
        if fields.get("covariance") is None:
            return {}
        return {"covariance": _covariance(fields, "covariance", turn)}
    if not isinstance(parts, Mapping) or not 1 <= len(parts) <= MAX_PARTS:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"budget: must be an object of 1 to {MAX_PARTS} parts")
    if bad := next((name for name in parts if not name.isidentifier() or len(name) > 40), None):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"budget: part {_told(bad)}; must be a word")
    return {"budget": {name: _covariance(parts, name, turn) for name in parts}}


def _turn(fields: Mapping[str, Any], normal: Array) -> Array:
    """Return the matrix, shape (2, 2), from the core's basis of the tangent plane to ours."""
    if fields.get("basis") is None:
        return np.eye(2)
    basis = _numbers(fields, "basis", (2, 3))
    frame = np.concatenate([basis, normal[None]])
    if np.abs(frame @ frame.T - np.eye(3)).max() > 2 * ROUNDED:
        raise _Refused(Reason.ESTIMATOR_ERROR, "basis: must be two unit vectors across each other and the normal")
    return np.asarray(basis_across(normal) @ basis.T)


def _covariance(fields: Mapping[str, Any], name: str, turn: Array) -> Array:
    """Return a covariance, rad^2, in our basis."""
    given = _numbers(fields, name, (2, 2))
    size = float(np.abs(given).max())
    if abs(given[0, 1] - given[1, 0]) > ROUNDED * size or np.linalg.eigvalsh(given).min() < -ROUNDED * size:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: must be symmetric and have no negative eigenvalue")
    if size > LARGEST_VARIANCE:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: holds {size:g}; must be at most {LARGEST_VARIANCE:.4g} rad^2")
    # Few digits may leave it not quite symmetric.
    return np.asarray(turn @ ((given + given.T) / 2) @ turn.T)


def _isophotes(given: object) -> tuple[FittedIsophote, ...]:
    """Return the isophotes that an estimate says it was made of: isovalue and cone of sightlines of each."""
    listed = [] if given is None else given
    if not isinstance(listed, list) or len(listed) > MAX_ISOPHOTES or not all(isinstance(i, Mapping) for i in listed):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"isophotes: {_told(given)}; must be at most {MAX_ISOPHOTES} objects")
    return tuple(_isophote(each) for each in listed)


def _isophote(given: Mapping[str, Any]) -> FittedIsophote:
    isovalue = float(_numbers(given, "isovalue", ()))
    cone, sightline = _numbers(given, "cone", (3, 3)), _unit(_numbers(given, "sightline", (3,)), "sightline")
    if not 0 < isovalue < 1:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"isovalue {isovalue:g}: must be in (0, 1)")
    made = FittedIsophote(isovalue, np.empty((0, 2)), None, cone, sightline)
    if np.abs(cone - cone.T).max() > ROUNDED * np.abs(cone).max() or isinstance(made.pose(), Failure):
        raise _Refused(Reason.ESTIMATOR_ERROR, "cone: must be symmetric, and an elliptic cone about the sightline")
    return made


def _curvature(given: object) -> EstimatedCurvature | None:
    if given is None:
        return None
    if not isinstance(given, Mapping):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"curvature: {_told(given)}; must be an object")
    directions = np.array([_unit(each, "direction") for each in _numbers(given, "directions", (2, 3))])
    if (ratio := _ratio(given, "axis_ratio")) is None:
        raise _Refused(Reason.ESTIMATOR_ERROR, "curvature axis_ratio: missing")
    hypotheses = None if given.get("hypotheses") is None else _numbers(given, "hypotheses", (None, 2))
    if hypotheses is not None and not 1 <= len(hypotheses) <= MAX_CANDIDATES:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"curvature hypotheses: must be 1 to {MAX_CANDIDATES} pairs")
    return EstimatedCurvature(directions, ratio, hypotheses)


def _flags(given: object) -> tuple[str, ...]:
    flags = [] if given is None else given
    good = isinstance(flags, list) and len(flags) <= MAX_FLAGS
    if not isinstance(flags, list) or not good or not all(isinstance(f, str) and _is_word(f) for f in flags):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"flags: {_told(given)}; must be at most {MAX_FLAGS} words")
    return tuple(flags)


def _is_word(text: str) -> bool:
    return 0 < len(text) <= 60 and text.isprintable() and not set(text) & set(" ,")


def _unit(vector: Array, name: str) -> Array:
    length = float(np.linalg.norm(vector))
    if abs(length - 1) > ROUNDED:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name} of length {length:g}: must be a unit vector")
    # An exact one keeps its last digits.
    return vector if abs(length - 1) < 1e-12 else vector / length


def _number(fields: Mapping[str, Any], name: str) -> float | None:
    return None if fields.get(name) is None else float(_numbers(fields, name, ()))


def _ratio(fields: Mapping[str, Any], name: str) -> float | None:
    ratio = _number(fields, name)
    if ratio is not None and not 0 < ratio <= 1:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: {ratio:g}; must be in (0, 1]")
    return ratio


def _deviation(fields: Mapping[str, Any], name: str) -> float | None:
    deviation = _number(fields, name)
    if deviation is not None and not deviation > 0:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: {deviation:g}; must be above 0")
    return deviation


def _numbers(fields: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> Array:
    """Return a field as an array of this shape, None standing for any length; raise `_Refused` if it is another."""
    given = fields.get(name)
    if given is None:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: missing")
    wanted = "a number" if not shape else f"numbers of shape ({', '.join('n' if n is None else str(n) for n in shape)})"
    try:
        values = given if isinstance(given, np.ndarray | np.generic) else np.array(_only_numbers(given), dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: {_told(given)}; must be {wanted}") from None
    if values.dtype.kind == "b":
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: holds true or false; must be {wanted}")
    fits = len(values.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))
    if not fits:
        raise _Refused(Reason.ESTIMATOR_ERROR, f"{name}: {_told(given)}; must be {wanted}")
    numbers: npt.NDArray[np.float64] = np.array(values, dtype=float)
    if not np.isfinite(numbers).all():
        raise _Refused(Reason.NOT_FINITE, f"{name} holds NaN or infinity")
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

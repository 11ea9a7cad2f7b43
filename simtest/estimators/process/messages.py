"""What a core answers: messages as estimates and failures; what they hold, `estimate_check` judges.

What a core is told of a highlight or a frame: the header and the arrays of a request.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.calibration.priors import Distribution, LogUniform, Normal
from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure, Reason
from simtest.estimators.isophotes import FittedIsophote
from simtest.estimators.process.pipe import PROTOCOL, Message, broken, excerpt
from simtest.estimators.protocol import ROUNDED, Estimate, EstimatedCurvature, Refused, Target, check, unit_vector
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across

PATCH_ARRAYS = ("values", "raw", "noise", "saturated", "seen", "rays")

FRAME_ARRAYS = ("encoded", "channels", "intensity", "smoothed", "noise", "clipped", "seen", "rays")

OUTLINES = ("isophote_", "isophote_rays_")
"""Names of the arrays of an isovalue, without it."""

MAX_ISOPHOTES = 16


@dataclass(frozen=True)
class Hello:
    """A core's greeting: what it is and what it wants.

    Parameters
    ----------
    name, version : str
        What the core calls itself.
    kind : {"patch", "frame"}
        Whether it takes single highlights or whole frames.
    transport : {"stream", "files"}
        How arrays are handed over.
    arrays : tuple of str
        Names of the arrays that it wants.
    isophotes : tuple of float
        Isovalues of the isophotes that it wants.
    target : {"fine", "base"}
        Which surface's normals it states where an estimate does not say so.
    """

    name: str
    version: str
    kind: Literal["patch", "frame"]
    transport: Literal["stream", "files"] = "stream"
    arrays: tuple[str, ...] = ()
    isophotes: tuple[float, ...] = ()
    target: Literal["fine", "base"] = "fine"


def outline_names(level: float) -> tuple[str, str]:
    """Return the names of the arrays of an isovalue: the isophote's points, px, and their sightlines."""
    return f"{OUTLINES[0]}{level:g}", f"{OUTLINES[1]}{level:g}"


def hello_of(header: Mapping[str, Any]) -> Hello:
    """Read a core's greeting; raise `CoreFault` where it is malformed."""
    if header.get("type") != "hello":
        raise broken(f"the first line is of type {told(header.get('type'))}; must be hello")
    if header.get("protocol") != PROTOCOL or isinstance(header.get("protocol"), bool):
        raise broken(f"hello: protocol {told(header.get('protocol'))}; simtest speaks {PROTOCOL}")
    name, version = header.get("name"), header.get("version", "")
    if not isinstance(name, str) or not 0 < len(name) <= 80 or not name.isprintable():
        raise broken(f"hello: name {told(name)}; must be text of 1 to 80 characters")
    if not isinstance(version, str | int | float) or len(str(version)) > 80 or not str(version).isprintable():
        raise broken(f"hello: version {told(version)}; must be text of at most 80 characters")
    kind = header.get("kind")
    if kind not in ("patch", "frame"):
        raise broken(f"hello: kind {told(kind)}; must be patch or frame")
    transport = header.get("transport", "stream")
    if transport not in ("stream", "files"):
        raise broken(f"hello: transport {told(transport)}; must be stream or files")
    target = header.get("target", "fine")
    if target not in ("fine", "base"):
        raise broken(f"hello: target {told(target)}; must be fine or base")
    levels = _levels(header.get("isophotes", []), kind)
    return Hello(name, str(version), kind, transport, _wanted(header.get("arrays"), kind, levels), levels, target)


def _levels(given: object, kind: str) -> tuple[float, ...]:
    """Return the isovalues of a greeting."""
    listed: list[Any] = given if isinstance(given, list) else [None]
    good = all(isinstance(t, int | float) and not isinstance(t, bool) and 0 < t < 1 for t in listed)
    if not good or len(listed) > MAX_ISOPHOTES or (listed and kind == "frame"):
        allowed = "none, since a frame has no peak" if kind == "frame" else f"at most {MAX_ISOPHOTES} numbers in (0, 1)"
        raise broken(f"hello: isophotes {told(given)}; must be {allowed}")
    if len({outline_names(level) for level in listed}) < len(set(listed)):
        raise broken(
            f"hello: isophotes {told(given)}; must differ in their first six digits, by which arrays are named"
        )
    return tuple(float(t) for t in listed)


def _wanted(given: object, kind: str, levels: tuple[float, ...]) -> tuple[str, ...]:
    """Return the names of the wanted arrays; an isovalue of which none is named gets both of its own."""
    offered = PATCH_ARRAYS if kind == "patch" else FRAME_ARRAYS
    outlines = [outline_names(level) for level in levels]
    allowed = (*offered, *itertools.chain.from_iterable(outlines))
    if given is None:
        given = ["values" if kind == "patch" else "intensity"]
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise broken(f"hello: arrays {told(given)}; must be a list of names")
    if unknown := next((name for name in given if name not in allowed), None):
        raise broken(f"hello: array {told(unknown)}; must be one of {', '.join(allowed)}")
    unnamed = [name for pair in outlines if not set(pair) & set(given) for name in pair]
    return tuple(dict.fromkeys([*given, *unnamed]))


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
        raise Refused(f"estimates: {told(listed)}; must be a list of objects")
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
        raise Refused(f"budget: {told(parts)}; must be an object")
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
        raise Refused(f"isophotes: {told(given)}; must be at most {MAX_ISOPHOTES} objects")
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
        raise Refused(f"curvature: {told(given)}; must be an object")
    if (ratio := _number(given, "axis_ratio")) is None:
        raise Refused("curvature axis_ratio: missing")
    hypotheses = None if given.get("hypotheses") is None else _numbers(given, "hypotheses", (None, 2))
    return EstimatedCurvature(_numbers(given, "directions", (2, 3)), ratio, hypotheses)


def _flags(given: object) -> tuple[str, ...]:
    if given is None:
        return ()
    if not isinstance(given, list) or not all(isinstance(flag, str) and " " not in flag for flag in given):
        raise Refused(f"flags: {told(given)}; must be a list of words")
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
        raise Refused(f"{name}: {told(given)}; must be {wanted}") from None
    if values.dtype.kind == "b":
        raise Refused(f"{name}: holds true or false; must be {wanted}")
    fits = len(values.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))
    if not fits:
        raise Refused(f"{name}: {told(given)}; must be {wanted}")
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


def told(value: object) -> str:
    """Return the beginning of a value's text, for a message."""
    return excerpt(repr(value).encode("utf-8", "replace"), 60)


Named = dict[str, npt.NDArray[Any]]
Offer = Mapping[str, Callable[[], npt.NDArray[Any] | str]]
"""How each array on offer is made; the making returns a text where there is none, which says why."""

MOST_KEPT_RAYS = 1_000_000
"""Pixels of the largest camera whose sightlines are kept: they take 24 bytes each."""


@lru_cache(maxsize=8)
def camera_message(camera: Camera) -> dict[str, Any]:
    """Return a camera as a request holds it: size and K in px, pixel centres at integer + 0.5."""
    lens = camera.distortion
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion": None if lens is None else {"model": lens.type, **asdict(lens)},
        "view_mask": None if camera.view_mask is None else asdict(camera.view_mask),
    }


@lru_cache(maxsize=8)
def priors_message(priors: Priors) -> dict[str, Any]:
    """Return what is known beforehand as a request holds it (see `simtest.calibration.Priors`), lengths in mm."""
    named = {name: getattr(priors, name) for name in ("lobe_curvature", "light_offset_mm", "falloff_power")}
    # Where no distance is told its default holds.
    named |= {"distance_mm": priors.distance, "relief_slope": priors.relief_slope}
    return {
        "lights_mm": [list(light) for light in priors.lights_mm],
        **{
            name: None if prior is None else _distribution(prior) | {"told": _is_told(priors, name)}
            for name, prior in named.items()
        },
        "camera": priors.camera.deviations,
        "plane": priors.plane,
        # A core that was written before this key existed gets the messages that it knows.
        **({"lights_covariance_mm2": priors.lights_covariance_mm2} if priors.lights_covariance_mm2 else {}),
    }


def _is_told(priors: Priors, name: str) -> bool:
    return bool(getattr(priors, name) != getattr(NO_PRIORS, name))


def _distribution(prior: Distribution) -> dict[str, Any]:
    if isinstance(prior, Normal):
        name = "normal" if prior.sd > 0 else "exact"
        parameters = {"mean": prior.mean, "sd": prior.sd} if prior.sd > 0 else {"value": prior.mean}
    else:
        name = "log_uniform" if isinstance(prior, LogUniform) else "uniform"
        parameters = {"low": prior.low, "high": prior.high}
    return {"distribution": name, "parameters": parameters, "mean": prior.mean, "sd": prior.sd}


def patch_request(patch: Patch, camera: Camera, priors: Priors, hello: Hello) -> tuple[dict[str, Any], Named]:
    """Return the header and the arrays of a request about one highlight."""
    height, width = patch.values.shape
    offer: dict[str, Callable[[], npt.NDArray[Any] | str]] = {
        "values": lambda: patch.values,
        "raw": lambda: _known(patch.raw),
        "noise": lambda: _known(patch.noise, patch.values.shape),
        "saturated": lambda: _known(patch.saturated),
        "seen": lambda: _seen(patch.seen, (height, width)),
        "rays": lambda: _rays(camera, patch.origin_px, (height, width)),
    }
    for level in hello.isophotes:
        points, sightlines = outline_names(level)
        offer[points] = lambda level=level: _outline(patch, level)  # type: ignore[misc]
        offer[sightlines] = lambda level=level: _outline(patch, level, camera)  # type: ignore[misc]
    arrays, missing = _taken(hello.arrays, offer)
    about = {
        "origin_px": list(patch.origin_px),
        "size_px": [width, height],
        "peak_px": patch.peak_px.tolist(),
        "peak_value": float(patch.peak_value),
        "peak_pixel": list(patch.peak_pixel),
        "smoothing_px": float(patch.smoothing_px),
        "noise": None if isinstance(patch.noise, np.ndarray) or patch.noise is None else float(patch.noise),
        "others_px": None if patch.others_px is None else [list(other) for other in patch.others_px],
        "others_value": [float(value) for value in patch.others_value],
    }
    return _header("patch", camera, priors, about, missing), arrays


def frame_request(frame: Frame, camera: Camera, priors: Priors, hello: Hello) -> tuple[dict[str, Any], Named]:
    """Return the header and the arrays of a request about a whole frame."""
    shape = (camera.height, camera.width)
    noise = frame.noise
    offer: Offer = {
        "encoded": lambda: frame.encoded,
        "channels": lambda: frame.channels,
        "intensity": lambda: frame.corrected.intensity,
        "smoothed": lambda: frame.smoothed,
        "noise": lambda: _known(noise, shape),
        "clipped": lambda: frame.clipped,
        "seen": lambda: _seen(frame.seen, shape),
        "rays": lambda: _rays(camera, (0, 0), shape),
    }
    arrays, missing = _taken(hello.arrays, offer)
    about = {
        "smoothing_px": float(frame.smoothing_px),
        "noise": None if isinstance(noise, np.ndarray) else float(noise),
        "channels": 1 if frame.encoded.ndim == 2 else frame.encoded.shape[2],
        "saturation_level": frame.calibration.saturation_level,
    }
    return _header("frame", camera, priors, about, missing), arrays


def _header(
    kind: str, camera: Camera, priors: Priors, about: dict[str, Any], missing: dict[str, str]
) -> dict[str, Any]:
    shared = {"camera": camera_message(camera), "priors": priors_message(priors)}
    return {"type": kind, **shared, kind: about, "missing": missing}


def _taken(wanted: tuple[str, ...], offer: Offer) -> tuple[Named, dict[str, str]]:
    """Return the wanted arrays, and why others are missing."""
    arrays: Named = {}
    missing: dict[str, str] = {}
    for name in wanted:
        made = offer[name]()
        if isinstance(made, str):
            missing[name] = made
        else:
            arrays[name] = made
    return arrays, missing


def _known(value: object, shape: tuple[int, ...] = ()) -> npt.NDArray[Any] | str:
    """Return an array, or a number as an array of this shape."""
    if value is None:
        return "not known"
    return value if isinstance(value, np.ndarray) else np.full(shape, value, dtype=np.float32)


def _seen(seen: npt.NDArray[np.bool_] | None, shape: tuple[int, int]) -> npt.NDArray[Any]:
    return np.ones(shape, dtype=bool) if seen is None else seen


@lru_cache(maxsize=2)
def _whole_rays(camera: Camera) -> Array:
    return camera.unproject(camera.pixel_centres())


def _rays(camera: Camera, origin: tuple[int, int], shape: tuple[int, int]) -> Array:
    """Return the unit sightlines of a region's pixels, shape (h, w, 3); those of a small camera are computed once."""
    (x, y), (height, width) = origin, shape
    inside = min(x, y) >= 0 and x + width <= camera.width and y + height <= camera.height
    if inside and camera.width * camera.height <= MOST_KEPT_RAYS:
        return _whole_rays(camera)[y : y + height, x : x + width]
    across, down = np.arange(width) + x + PIXEL_CENTRE, np.arange(height) + y + PIXEL_CENTRE
    return camera.unproject(np.stack(np.meshgrid(across, down), axis=-1))


def _outline(patch: Patch, level: float, camera: Camera | None = None) -> npt.NDArray[Any] | str:
    """Return an isophote as a closed polygon, px, or its sightlines; or why it does not close."""
    points = patch.isophote(level)
    if isinstance(points, Failure):
        return str(points)
    return points if camera is None else camera.unproject(points)

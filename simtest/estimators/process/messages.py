"""The messages between simtest and a core: its greeting and its answers as models, and what a request tells it.

What an answer holds is read here, and judged where all estimates are (`simtest.estimators.protocol.check`).
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
)
from pydantic.dataclasses import dataclass

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

OUTLINES = ("isophote_", "isophote_rays_")  # names of the arrays of an isovalue, without it

MAX_ISOPHOTES = 16


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError
    return text


Name = Annotated[str, Field(max_length=80), AfterValidator(_printable)]
Level = Annotated[float, Field(gt=0, lt=1)]
FROM_LIST = BeforeValidator(lambda given: tuple(given) if isinstance(given, list) else given)


@dataclass(frozen=True, config=ConfigDict(strict=True))
class Hello:
    """A core's greeting: what it is and what it wants."""

    name: Annotated[Name, Field(min_length=1, description="text of 1 to 80 characters")]
    version: Annotated[Name, Field(description="text of at most 80 characters")]
    kind: Annotated[Literal["patch", "frame"], Field(description="patch or frame")]
    transport: Annotated[Literal["stream", "files"], Field(description="stream or files")] = "stream"
    arrays: Annotated[tuple[str, ...], FROM_LIST, Field(description="a list of names")] = ()
    isophotes: Annotated[
        tuple[Level, ...], Field(max_length=MAX_ISOPHOTES), FROM_LIST,
        Field(description=f"at most {MAX_ISOPHOTES} numbers in (0, 1)"),
    ] = ()  # fmt: skip
    target: Annotated[Target, Field(description="fine or base")] = "fine"  # of estimates that do not say which


def outline_names(level: float) -> tuple[str, str]:
    """Return the names of the arrays of an isovalue: the isophote's points, px, and their sightlines."""
    return f"{OUTLINES[0]}{level:g}", f"{OUTLINES[1]}{level:g}"


def hello_of(header: Mapping[str, Any]) -> Hello:
    """Read a core's greeting; raise `CoreFault` where it is malformed."""
    if header.get("type") != "hello":
        raise broken(f"the first line is of type {shown_value(header.get('type'))}; must be hello")
    if header.get("protocol") != PROTOCOL or isinstance(header.get("protocol"), bool):
        raise broken(f"hello: protocol {shown_value(header.get('protocol'))}; simtest speaks {PROTOCOL}")
    is_patch = header.get("kind") == "patch"
    given = {"version": ""} | {field.name: header[field.name] for field in fields(Hello) if field.name in header}
    if isinstance(given["version"], int | float):
        given["version"] = str(given["version"])
    if given.get("arrays") is None:
        given["arrays"] = ["values" if is_patch else "intensity"]
    if header.get("kind") == "frame" and given.get("isophotes"):
        raise broken(f"hello: isophotes {shown_value(given['isophotes'])}; must be none, since a frame has no peak")
    try:
        hello = Hello(**given)
    except ValidationError as error:
        raise broken(f"hello: {_malformed(error, given, Hello)}") from None
    # An isovalue of which no array is named gets both of its own.
    outlines = [outline_names(level) for level in hello.isophotes]
    if len(set(outlines)) < len(set(hello.isophotes)):
        must = "must differ in their first six digits, by which arrays are named"
        raise broken(f"hello: isophotes {shown_value(given['isophotes'])}; {must}")
    offered = (*(PATCH_ARRAYS if is_patch else FRAME_ARRAYS), *itertools.chain.from_iterable(outlines))
    if unknown := next((name for name in hello.arrays if name not in offered), None):
        raise broken(f"hello: array {shown_value(unknown)}; must be one of {', '.join(offered)}")
    unnamed = [name for pair in outlines if not set(pair) & set(hello.arrays) for name in pair]
    return replace(hello, arrays=tuple(dict.fromkeys([*hello.arrays, *unnamed])))


def _malformed(error: ValidationError, given: Mapping[str, Any], model: type) -> str:
    """Return name and value of a message's first malformed field, and what it must be, as the field says."""
    name = str(error.errors(include_url=False, include_input=False)[0]["loc"][0])
    value = shown_value(given[name]) if name in given else "missing"
    return f"{name} {value}; must be {model.__pydantic_fields__[name].description}"  # type: ignore[attr-defined]


def _only_numbers(given: object) -> object:
    """Return nested lists of numbers as they are; raise `TypeError` where they hold text, true or false."""
    if isinstance(given, list):
        for each in given:
            _only_numbers(each)
    elif isinstance(given, bool) or not isinstance(given, int | float):
        raise TypeError
    return given


def _read_numbers(given: Any, name: str | None, shape: tuple[int | None, ...]) -> Array | float:
    """Return an array of finite numbers, or a number where the shape is (); raise `Refused` where it is none."""
    wanted = f"numbers of shape ({', '.join('n' if n is None else str(n) for n in shape)})" if shape else "a number"
    is_array = isinstance(given, np.ndarray | np.generic)
    try:
        values = given if is_array else np.array(_only_numbers(given), dtype=float)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise Refused(f"{name}: {shown_value(given)}; must be {wanted}") from None
    if values.dtype.kind == "b":
        raise Refused(f"{name}: holds true or false; must be {wanted}")
    if values.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, values.shape, strict=True)):
        raise Refused(f"{name}: {shown_value(given)}; must be {wanted}")
    numbers: Array = np.array(values, dtype=float)
    # `Refused` is no ValueError: pydantic lets it pass with its reason.
    if not np.isfinite(numbers).all():
        raise Refused(f"{name} holds NaN or infinity", Reason.NOT_FINITE)
    return numbers if shape else float(numbers)


def _numbers(*shape: int | None) -> PlainValidator:
    """Read a field as finite numbers of this shape, None standing for any length, () for a number."""
    return PlainValidator(lambda given, info: _read_numbers(given, info.field_name, shape))


def _read_budget(given: Any) -> dict[str, Array]:
    """Read the covariances of a budget; a malformed one is told by its own name."""
    if not isinstance(given, dict):
        raise ValueError
    return {name: np.asarray(_read_numbers(part, name, (2, 2))) for name, part in given.items()}


Number = Annotated[float, _numbers()]
Pair = Annotated[Array, _numbers(2)]
Vector = Annotated[Array, _numbers(3)]
Square = Annotated[Array, _numbers(2, 2)]
Directions = Annotated[Array, _numbers(2, 3)]


class AnsweredIsophote(BaseModel):
    """An isophote that an estimate says it was made of: isovalue and cone of sightlines."""

    isovalue: Number
    cone: Annotated[Array, _numbers(3, 3)]
    sightline: Vector

    def fitted(self) -> FittedIsophote:
        """Return the isophote as a fitted one; raise `Refused` where it is none."""
        if not 0 < self.isovalue < 1:
            raise Refused(f"isovalue {self.isovalue:g}: must be in (0, 1)")
        sightline = unit_vector(self.sightline, "sightline")
        made = FittedIsophote(self.isovalue, np.empty((0, 2)), None, self.cone, sightline)
        asymmetry = np.abs(self.cone - self.cone.T).max()
        if asymmetry > ROUNDED * np.abs(self.cone).max() or isinstance(made.pose(), Failure):
            raise Refused("cone: must be symmetric, and an elliptic cone about the sightline")
        return made


class AnsweredCurvature(BaseModel):
    """The surface's curvature (see `simtest.estimators.EstimatedCurvature`)."""

    directions: Directions
    axis_ratio: Number
    hypotheses: Annotated[Array, _numbers(None, 2)] | None = None


class AnsweredEstimate(BaseModel):
    """What a core answers of one highlight: an `Estimate`, in the basis that it names."""

    model_config = ConfigDict(strict=True)

    normal: Vector = Field(description="numbers of shape (3)")
    candidates: Annotated[Array, _numbers(None, 3)] | None = None
    look_px: Pair | None = None
    look_ray: Vector | None = None
    basis: Directions | None = None
    covariance: Square | None = None
    budget: Annotated[dict[str, Array], PlainValidator(_read_budget)] | None = Field(None, description="an object")
    axis_ratio: Number | None = None
    axis_ratio_deviation: Number | None = None
    choice_margin: Number | None = None
    isophotes: list[AnsweredIsophote] | None = Field(
        None, max_length=MAX_ISOPHOTES,
        description=f"at most {MAX_ISOPHOTES} objects of isovalue, cone and sightline",
    )  # fmt: skip
    flags: list[Annotated[str, Field(pattern="^[^ ]*$")]] | None = Field(None, description="a list of words")
    curvature: AnsweredCurvature | None = Field(None, description="an object of directions and axis_ratio")
    target: Any = None  # `check` judges it

    def estimate(self, camera: Camera, target: Target) -> Estimate:
        """Return the estimate; raise `Refused` at the first part that is none."""
        normal = unit_vector(self.normal, "normal")
        return Estimate(
            normal,
            normal[None] if self.candidates is None else self.candidates,
            self._look(camera),
            axis_ratio=self.axis_ratio,
            axis_ratio_deviation=self.axis_ratio_deviation,
            isophotes=tuple(each.fitted() for each in self.isophotes or ()),
            choice_margin=self.choice_margin,
            flags=tuple(self.flags or ()),
            curvature=None if self.curvature is None else EstimatedCurvature(**dict(self.curvature)),
            target=target if self.target is None else self.target,
            **self.uncertainty(normal),
        )

    def _look(self, camera: Camera) -> Array:
        """Return the pixel at which the estimate is stated."""
        if self.look_px is not None:
            return self.look_px
        if self.look_ray is None:
            raise Refused("look_px or look_ray: missing; an estimate must say where it looks")
        look = camera.project(self.look_ray)
        if not np.isfinite(look).all():
            raise Refused("look_ray: the camera images no such direction")
        return look

    def uncertainty(self, normal: Array) -> dict[str, Any]:
        """Return the covariance, or the budget, in the basis that simtest states them in."""
        turn = np.eye(2)
        if self.basis is not None:
            frame = np.concatenate([self.basis, normal[None]])
            if np.abs(frame @ frame.T - np.eye(3)).max() > 2 * ROUNDED:
                raise Refused("basis: must be two unit vectors across each other and the normal")
            turn = basis_across(normal) @ self.basis.T
        parts = {"": self.covariance} if self.budget is None and self.covariance is not None else self.budget
        if parts is None:
            return {}
        turned = {name: turn @ part @ turn.T for name, part in parts.items()}
        return {"covariance": turned[""]} if self.budget is None else {"budget": turned}


MAX_ESTIMATES = 10_000
OWN_REASONS = ("core_", "estimator_error")  # how the reasons begin that simtest alone gives


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
        return [_read(each, camera, hello) for each in _listed(answer)]
    except Refused as refused:
        return refused.failure


def _read(given: Mapping[str, Any], camera: Camera, hello: Hello) -> Estimate | Failure:
    """Return an estimate of its fields, or what is wrong with the first that cannot be read."""
    try:
        return AnsweredEstimate.model_validate(given).estimate(camera, hello.target)
    except Refused as refused:
        return refused.failure
    except ValidationError as error:
        return Failure(Reason.ESTIMATOR_ERROR, _malformed(error, given, AnsweredEstimate))


def _listed(answer: Message) -> list[dict[str, Any]]:
    """Return the fields of each estimate: those of the list, and an element of each array."""
    lengths = {len(array) if array.ndim else -1 for array in answer.arrays.values()}
    count = max(lengths, default=0)
    listed = answer.header.get("estimates", [{}] * min(count, MAX_ESTIMATES))
    if not isinstance(listed, list) or not all(isinstance(each, dict) for each in listed):
        raise Refused(f"estimates: {shown_value(listed)}; must be a list of objects")
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


Named = dict[str, npt.NDArray[Any]]
Offer = Mapping[str, Callable[[], npt.NDArray[Any] | str]]
"""How each array on offer is made; the making returns a text where there is none, which says why."""

MOST_KEPT_RAYS = 1_000_000  # pixels of the largest camera whose sightlines are kept: they take 24 bytes each


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
            name: None
            if prior is None
            else _distribution(prior) | {"told": bool(getattr(priors, name) != getattr(NO_PRIORS, name))}
            for name, prior in named.items()
        },
        "camera": priors.camera.deviations,
        "plane": priors.plane,
        # A core that was written before this key existed gets the messages that it knows.
        **({} if (spread := priors.lights_covariance) is None else {"lights_covariance_mm2": spread.tolist()}),
    }


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
        "diffuse": float(patch.diffuse),
        "clipped_share": float(patch.clipped_share),
        "score": patch.score,
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


def shown_value(value: object) -> str:
    """Return the beginning of a value's text, for a message."""
    return excerpt(repr(value).encode("utf-8", "replace"), 60)

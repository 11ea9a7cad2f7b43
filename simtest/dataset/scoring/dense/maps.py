"""Maps of normals or depths, what their values mean, and the methods that give them."""

import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from simtest.dataset.scoring.dense.depth import KINDS, LEAST_PIXELS, DepthKind, depth_factor, spread
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.dataset.scoring.dense.truth import FrameTruth
from simtest.errors import InputError
from simtest.geometry.axes import ALL, NAMED, described, matrix
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.validation.depth_maps import DEPTH_SUFFIXES, read_values

Kind = Literal["normal", "depth"]
Encoding = Literal["components", "unit", "centred", "positive_z"]
ENCODINGS: dict[Encoding, str] = {
    "components": "components in [-1, 1]",
    "unit": "2 v / largest - 1",
    "centred": "(v - half) / (half - 1), half 128 or 32768",
    "positive_z": "2 v / largest - 1, but v / largest in the third channel",
}
"""How a file's values v hold a component; largest is 255 or 65535, and 1 for floats."""

SHORTEST = 0.1

FARTHEST, NOTHING = 1e12, 1e-3
"""Numbers beyond the first stand for infinity; three channels below the second hold no direction."""


@dataclass(frozen=True)
class MapFile:
    """The map of one frame: of normals or of depths."""

    frame: str
    kind: Kind | None
    path: Path


def find_maps(folder: Path) -> list[MapFile]:
    """Return the maps of a folder, and of its folders normal/ and depth/."""
    places: dict[Path, Kind | None] = {folder: None, folder / "normal": "normal", folder / "depth": "depth"}
    found: list[MapFile] = []
    for place, kind in places.items():
        files = sorted(place.iterdir()) if place.is_dir() else []
        found += [_named(path, kind) for path in files if path.suffix.lower() in DEPTH_SUFFIXES and path.is_file()]
    if not found:
        raise InputError(f"{folder}: holds no maps; must be {', '.join(DEPTH_SUFFIXES)}, called as their frames")
    held: dict[tuple[str, str | None], Path] = {}
    for one in found:
        other = held.setdefault((one.frame, one.kind), one.path)
        if other is not one.path:
            raise InputError(f"{one.path}: a second map of frame {one.frame}, beside {other.name}")
    return found


def _named(path: Path, kind: Kind | None) -> MapFile:
    """Return a map by its file's name: that of the frame, or with _normal, _normals or _depth behind it."""
    match = re.fullmatch(r"(.+)[_.-](normals?|depth)", path.stem)
    if kind is None and match:
        return MapFile(match[1], "depth" if match[2] == "depth" else "normal", path)
    return MapFile(path.stem, kind, path)


@dataclass(frozen=True)
class RawMap:
    """What a file holds: channels as red, green, blue; floats as they are, integers undecoded."""

    path: Path
    kind: Kind  # "normal" or "depth"
    # shape (H, W, 3) or (H, W); NaN cannot stand in integers; there 0 in all channels is no answer
    values: npt.NDArray[np.generic]
    clear: npt.NDArray[np.bool_] | None = None  # where an alpha channel is 0: no answer; shape (H, W)

    @property
    def is_encoded(self) -> bool:
        """Whether values are integers, which stand for others."""
        return self.values.dtype.kind in "iu"

    @property
    def largest(self) -> float:
        """The largest value that the file can hold; 1 for floats."""
        # An integer's largest value, by its number of bytes; files hold 1, 2 or 4.
        return float(2 ** (8 * self.values.dtype.itemsize) - 1) if self.is_encoded else 1.0


def read_map(one: MapFile, size: tuple[int, int]) -> RawMap:
    """Read a map of a frame of a size, height and width."""
    path = one.path
    values = read_values(path, "a map of normals or depths")
    if values.ndim == 3 and values.shape[1:] == size and values.shape[0] in (1, 3):
        # Networks write their channels first.
        values = np.moveaxis(values, 0, -1)
    if path.suffix.lower() in (".png", ".tif", ".tiff") and values.ndim == 3 and values.shape[2] >= 3:
        # OpenCV's order of channels is BGR.
        values = values[:, :, [2, 1, 0, *range(3, values.shape[2])]]
    clear = None
    if values.ndim == 3 and values.shape[2] == 4:
        clear = np.asarray(values[:, :, 3] == 0)
        values = values[:, :, :3]
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim not in (2, 3) or (values.ndim == 3 and values.shape[2] != 3):
        raise InputError(f"{path}: has shape {values.shape}; must be (H, W, 3) for normals or (H, W) for depths")
    if values.shape[:2] != size:
        height, width = values.shape[:2]
        raise InputError(f"{path}: is {width} x {height} px; must be {size[1]} x {size[0]}, as its frame")
    kind = one.kind or kind_of(values)
    if kind == "normal" and values.ndim == 2:
        raise InputError(f"{path}: has one channel; a normal map has three")
    if kind == "normal" and values.dtype.kind in "iu" and values.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: normals are {values.dtype}; must be uint8, uint16 or floats")
    if kind == "depth" and values.ndim == 3:
        if (values != values[:, :, :1]).any():
            raise InputError(f"{path}: channels differ; a depth map has one, or equal ones")
        values = values[:, :, 0]
    return RawMap(path, kind, values, clear)


def kind_of(values: npt.NDArray[np.generic]) -> Kind:
    """Return what a map without a telling name holds: depths where it has one channel, or three equal ones.

    Three channels of nothing but zeros are normals without an answer.
    """
    return "depth" if values.ndim == 2 or bool((values == values[:, :, :1]).all() and values.any()) else "normal"


def channel_vectors(raw: RawMap, encoding: Encoding) -> Array:
    """Return the channel vectors of a normal map, shape (H, W, 3), as long as they are; NaN where there is no answer.

    In integers no answer is 0 in all channels, or nearly the middle of all.
    """
    values = raw.values.astype(float)
    # Numbers that stand for infinity; their squares overflow.
    values[~(np.abs(values) < FARTHEST)] = np.nan
    largest = raw.largest
    if encoding == "components":
        vectors = values
    elif encoding == "centred":
        half = (largest + 1) / 2
        vectors = (values - half) / (half - 1)
    else:
        vectors = 2 * values / largest - 1
        if encoding == "positive_z":
            vectors[..., 2] = values[..., 2] / largest
    if raw.is_encoded:
        vectors[(raw.values == 0).all(axis=-1)] = np.nan
        # What is shorter than a tenth is the grey of "no direction", no rounded unit vector.
        vectors[np.linalg.norm(vectors, axis=-1) < SHORTEST] = np.nan
    elif encoding == "unit":
        # 0, or nearly: three components of -1 are no unit vector.
        vectors[(np.abs(values) < NOTHING).all(axis=-1)] = np.nan
    if raw.clear is not None:
        vectors[raw.clear] = np.nan
    return vectors


def decode_depth(raw: RawMap, unit_mm: float | None) -> Array:
    """Return the depths of a map in mm, or in its own unit where that is not told; NaN where there is no answer."""
    if raw.is_encoded and unit_mm is None:
        raise InputError(
            f"{raw.path}: holds integers; --unit-mm must say how many mm one step is (1 where nobody knows; "
            "then take the aligned figures)"
        )
    depth = raw.values.astype(float) * (1.0 if unit_mm is None else unit_mm)
    depth[~(np.isfinite(depth) & (depth > 0) & (depth < FARTHEST))] = np.nan
    if raw.clear is not None:
        depth[raw.clear] = np.nan
    return depth


# What the values mean -----------------------------------------------------------------------------------------------

MOST_PIXELS = 20_000
"""Of a frame, by which maps are compared with the truth, evenly spread."""

LONG = 0.1
"""Vectors whose length is off by more than this in the mean are no unit vectors."""

BETTER_COSINE, BETTER_SPREAD = 0.05, 0.9
"""Other axes are told that fit by so much more in the mean cosine, and the other kind of depths that leaves less than
such a share of the spread."""

_MATRICES = np.stack([matrix(axes) for axes in ALL])


@dataclass(frozen=True)
class MapOptions:
    """What a user states of the maps; None: the default.

    Axes are written as the camera's own axis (x right, y down, z forward) that each channel holds, with its sign:
    "x,-y,-z" says that red holds x, green holds -y (up) and blue holds -z (towards the camera).

    Parameters
    ----------
    name : str, optional
        Of the method, on the page.
    encoding : str, optional
        One of `ENCODINGS`; default "unit" for integers, "components" for others.
    frame : str, optional
        Axes of the channels: opencv (default), opengl, directx, or such as "x,-y,-z".
    depth : str, optional
        "z" (default) or "ray".
    unit_mm : float, optional
        mm of one unit of the depths; integers need it, for others 1.
    """

    name: str | None = None
    encoding: str | None = None
    frame: str | None = None
    depth: str | None = None
    unit_mm: float | None = None

    def check(self) -> None:
        """Raise `InputError` for what is not allowed."""
        if self.encoding is not None and self.encoding not in ENCODINGS:
            raise InputError(f"--encoding {self.encoding}: unknown; allowed: {', '.join(ENCODINGS)}")
        if self.frame is not None:
            parse_axes(self.frame)
        if self.depth is not None and self.depth not in KINDS:
            raise InputError(f"--depth {self.depth}: unknown; allowed: {', '.join(KINDS)}")
        if self.unit_mm is not None and not 1e-9 <= self.unit_mm <= 1e6:
            raise InputError(f"--unit-mm {self.unit_mm:g}: must be 1e-9 to 1e6 mm")

    @property
    def axes(self) -> str:
        """The axes of the channels."""
        return parse_axes(self.frame or "opencv")

    @property
    def along(self) -> DepthKind:
        """The kind of depths."""
        return "ray" if self.depth == "ray" else "z"

    def encoding_of(self, raw: RawMap) -> Encoding:
        """Return how a normal map holds its components."""
        default: Encoding = "unit" if raw.is_encoded else "components"
        return next((name for name in ENCODINGS if name == self.encoding), default)

    def normals(self, raw: RawMap) -> Array:
        """Return the unit normals of a map, camera frame, shape (H, W, 3); NaN where there is no answer."""
        return to_camera(unit(channel_vectors(raw, self.encoding_of(raw))), self.axes)


@dataclass(frozen=True)
class Answer:
    """What a method answers for a frame: maps as their files hold them."""

    normal: RawMap | None = None
    depth: RawMap | None = None


@dataclass
class Fit:
    """How well the maps of all frames fit the truth as they are read, and read otherwise."""

    options: MapOptions
    encoding: Encoding | None = None
    lengths: list[float] = field(default_factory=list)
    """Mean error of the vectors' length, a frame."""
    correlation: Array = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum over the pixels of true normals times channel vectors."""
    pixels: int = 0
    spreads: dict[DepthKind, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    """Spread of the depths' relative errors after an affine alignment, a frame: a shift would hide the kind."""

    def add(self, truth: FrameTruth, answer: Answer) -> None:
        """Add a frame's maps."""
        chosen = np.flatnonzero(truth.scored)
        chosen = chosen[:: max(1, len(chosen) // MOST_PIXELS)]
        if answer.normal is not None:
            self.encoding = self.options.encoding_of(answer.normal)
            vectors = channel_vectors(answer.normal, self.encoding).reshape(-1, 3)[chosen]
            off = np.abs(np.linalg.norm(vectors, axis=-1) - 1)
            # A frame without an answer says nothing.
            if (off := off[np.isfinite(off)]).size:
                self.lengths.append(float(off.mean()))
            vectors = unit(vectors)
            known = np.isfinite(vectors).all(axis=1)
            self.correlation += truth.normal["base"].reshape(-1, 3)[chosen][known].T @ vectors[known]
            self.pixels += int(known.sum())
        if answer.depth is not None:
            depth = decode_depth(answer.depth, self.options.unit_mm).ravel()[chosen]
            for kind in KINDS:
                true = (truth.distance * depth_factor(truth.camera, kind)).ravel()[chosen]
                known = np.isfinite(depth) & np.isfinite(true)
                if known.sum() >= LEAST_PIXELS:
                    self.spreads[kind].append(spread(depth[known], true[known]))

    @property
    def cosines(self) -> Array:
        """Mean cosine with the truth of each of the 48 assignments of axes, shape (48,): signed sums of one matrix."""
        return np.asarray(np.einsum("kij,ij->k", _MATRICES, self.correlation) / max(self.pixels, 1))

    def lines(self) -> list[str]:
        """Return what is told of the conventions, a line each; what the truth contradicts begins with "warning:"."""
        told, options = [], self.options
        if self.encoding is not None:
            how = "as stated" if options.encoding else "by default"
            told.append(f"normals: encoding {self.encoding} ({ENCODINGS[self.encoding]}), {how}")
            how = "as stated" if options.frame else "by default"
            axes, cosines = options.axes, self.cosines
            own, best = float(cosines[ALL.index(axes)]), int(np.argmax(cosines))
            told.append(f"normals: channels hold {described(axes)}, {how}; mean cosine with the truth {own:.4f}")
            if not self.pixels:
                told.append("warning: normals: no pixel holds a direction; all count as unanswered")
            elif cosines[best] > own + BETTER_COSINE:
                told.append(
                    f"warning: normals fit the truth better with --frame {ALL[best]}: mean cosine {cosines[best]:.4f}"
                )
            if self.lengths and (off := float(np.mean(self.lengths))) > LONG:
                told.append(
                    f"warning: normals: vectors are off from length 1 by {off:.2g} in the mean, and only their "
                    "direction counts; --encoding says how they are held"
                )
        if self.spreads[options.along]:
            along = {"z": "the axis (z)", "ray": "the ray"}
            told.append(f"depths: along {along[options.along]}, {'as stated' if options.depth else 'by default'}")
            name: DepthKind = "z" if options.along == "ray" else "ray"
            own, other = self._spread(options.along), self._spread(name)
            if other < BETTER_SPREAD * own:
                told.append(
                    f"warning: depths fit the truth better along {along[name]}, --depth {name}: the spread that an "
                    f"affine alignment leaves is {other:.3g} instead of {own:.3g}"
                )
        return told

    def _spread(self, kind: DepthKind) -> float:
        return float(np.mean(self.spreads[kind]))

    def to_json(self) -> JsonObject:
        """Return the conventions, whether the user said so, and how well they fit."""
        held: JsonObject = {}
        options, cosines = self.options, self.cosines
        if self.encoding is not None:
            best = int(np.argmax(cosines))
            held["normals"] = {
                "encoding": self.encoding, "encoding_stated": options.encoding is not None,
                "axes": options.axes, "axes_stated": options.frame is not None,
                "mean_cosine": float(cosines[ALL.index(options.axes)]),
                "best_axes": ALL[best], "best_mean_cosine": float(cosines[best]),
                "length_error": float(np.mean(self.lengths)) if self.lengths else None,
            }  # fmt: skip
        if self.spreads[options.along]:
            held["depths"] = {
                "along": options.along, "along_stated": options.depth is not None,
                "unit_mm": 1.0 if options.unit_mm is None else options.unit_mm,
                "unit_stated": options.unit_mm is not None,
                **{f"spread_{kind}": self._spread(kind) for kind in KINDS},
            }  # fmt: skip
        return held


def parse_axes(text: str) -> str:
    """Return axes such as "x,-y,-z" from these or their name; raise `InputError` for others."""
    axes = NAMED.get(text.strip().lower(), text.replace(" ", "").replace("+", "").lower())
    if axes not in ALL:
        raise InputError(
            f"--frame {text}: unknown; allowed: {', '.join(NAMED)}, or the axes of the three channels, such as x,-y,-z"
        )
    return axes


def to_camera(vectors: Array, axes: str) -> Array:
    """Return channel vectors, shape (..., 3), in the camera frame."""
    return vectors @ matrix(axes).T


def unit(vectors: Array, least: float = 1e-3) -> Array:
    """Return unit vectors, shape (..., 3); NaN where the length is below `least` or not finite."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isfinite(length) & (length >= least), vectors / length, np.nan)


# Methods ------------------------------------------------------------------------------------------------------------


class Method(Protocol):
    """What answers maps for frames."""

    @property
    def name(self) -> str:
        """Name of the method, as the page shows it."""

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of maps that it gives, before any frame is read."""

    def options(self, stated: MapOptions) -> MapOptions:
        """Return the user's options with what the method itself knows of its maps."""

    def answer(self, truth: FrameTruth) -> Answer:
        """Return the maps of a frame. A method takes the frame's name, image and calibration, nothing else."""

    def check(self, frames: Iterable[str]) -> None:
        """Raise `InputError`, or warn, where its maps do not belong to the frames of these names."""


@dataclass
class MapFolder:
    """A folder of maps."""

    folder: Path  # holds the files (`find_maps`)
    maps: dict[tuple[str, Kind | None], MapFile] = field(init=False)

    def __post_init__(self) -> None:
        self.maps = {(one.frame, one.kind): one for one in find_maps(self.folder)}

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    @cached_property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of maps; where no file's name tells, the first file does."""
        named = {kind for _, kind in self.maps}
        plain = next((one for one in self.maps.values() if one.kind is None), None)
        if plain is not None:
            named.add(_peek(plain))
        kinds: tuple[Kind, ...] = ("normal", "depth")
        return tuple(kind for kind in kinds if kind in named)

    def options(self, stated: MapOptions) -> MapOptions:
        """Return the options as they are: files tell nothing of their conventions."""
        return stated

    def answer(self, truth: FrameTruth) -> Answer:
        """Read the maps of a frame; raise `InputError` where a file does not fit."""
        found: dict[Kind, RawMap] = {}
        for kind in (None, "normal", "depth"):
            if (one := self._find(truth.name, kind)) is None:
                continue
            raw = read_map(one, truth.size)
            if raw.kind in found:
                raise InputError(f"{one.path}: a second {raw.kind} map of frame {truth.name}")
            if kind is None and raw.kind not in self.kinds:
                raise InputError(
                    f"{one.path}: holds a {raw.kind} map, others {self.kinds[0]} maps; call the files "
                    "NAME_normal and NAME_depth"
                )
            found[raw.kind] = raw
        return Answer(found.get("normal"), found.get("depth"))

    def _find(self, frame: str, kind: Kind | None) -> MapFile | None:
        # A frame's name may carry the suffix of its picture.
        return self.maps.get((frame, kind)) or self.maps.get((Path(frame).stem, kind))

    def check(self, frames: Iterable[str]) -> None:
        """Warn of maps that belong to no frame; raise `InputError` where none belongs to any."""
        names = {own for frame in frames for own in (frame, Path(frame).stem)}
        strangers = sorted(one.path.name for one in self.maps.values() if one.frame not in names)
        if strangers and len(strangers) == len(self.maps):
            example = min(names, default="")
            raise InputError(
                f"{self.folder}: no map is called as a frame (found {strangers[0]}; a frame is called {example})"
            )
        if strangers:
            more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
            warnings.warn(f"{self.folder}: {strangers[0]}{more}: no such frame; left out", stacklevel=3)


def _peek(one: MapFile) -> Kind:
    """Return what the first file whose name does not tell holds."""
    values = read_values(one.path, "a map of normals or depths")
    if values.ndim == 3 and values.shape[0] in (1, 3) and values.shape[2] not in (1, 3, 4):
        values = np.moveaxis(values, 0, -1)
    return kind_of(values[:, :, 0] if values.ndim == 3 and values.shape[2] == 1 else values[..., :3])


@dataclass(frozen=True)
class Shading:
    """The baseline: normals and depths by shading alone (`simtest.dataset.scoring.dense.shading`)."""

    name: str = "shading"
    kinds: tuple[Kind, ...] = ("normal", "depth")

    def options(self, stated: MapOptions) -> MapOptions:
        """Return its own conventions: camera frame, distances along the ray in a unit that nobody knows."""
        return replace(stated, encoding="components", frame="opencv", depth="ray", unit_mm=None)

    def answer(self, truth: FrameTruth) -> Answer:
        """Compute the maps of a frame from its picture and calibration."""
        if truth.image is None or truth.calibration is None:
            raise InputError(f"frame {truth.name}: has no picture, which the method shading needs")
        normal, distance = shading_maps(truth.image, truth.calibration)
        where = Path(truth.name)
        return Answer(RawMap(where, "normal", normal), RawMap(where, "depth", distance))

    def check(self, frames: Iterable[str]) -> None:
        """Accept all frames."""


METHODS: Mapping[str, Callable[[], Method]] = {"shading": Shading}
"""Methods by the word that stands for their maps."""


def open_method(maps: str | Path) -> Method:
    """Return the method of a name in `METHODS`, or the maps of a folder; raise `InputError` where it is neither."""
    if (made := METHODS.get(str(maps))) and not Path(maps).exists():
        return made()
    folder = Path(maps)
    if not folder.is_dir():
        raise InputError(f"{folder}: no folder of maps; must be one, or a method: {', '.join(METHODS)}")
    return MapFolder(folder)

"""Maps in a folder, a file a frame: normals of three channels, or depths of one; PNG, TIFF, NPY or EXR."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.runtime.arrays import Array
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

_ENDINGS = {"normal": "normal", "normals": "normal", "depth": "depth"}
"""Last words of a file's name that say which kind it is: NAME_normal.png."""


@dataclass(frozen=True)
class MapFile:
    """The map of one frame: of normals or of depths."""

    frame: str
    kind: Kind | None
    path: Path


def find_maps(folder: Path) -> list[MapFile]:
    """Return the maps of a folder, and of its folders normal/ and depth/."""
    places: list[tuple[Path, Kind | None]] = [
        (folder, None),
        (folder / "normal", "normal"),
        (folder / "depth", "depth"),
    ]
    found: list[MapFile] = []
    for place, kind in places:
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
    """Return a map by its file's name: that of the frame, or with _normal or _depth behind it."""
    match = re.fullmatch(r"(.+)[_.-](normals?|depth)", path.stem)
    if kind is None and match:
        return MapFile(match[1], "normal" if _ENDINGS[match[2]] == "normal" else "depth", path)
    return MapFile(path.stem, kind, path)


@dataclass(frozen=True)
class RawMap:
    """What a file holds: channels as red, green, blue; floats as they are, integers undecoded.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        "normal" or "depth".
    values : ndarray, shape (H, W, 3) or (H, W)
        NaN cannot stand in integers; there 0 in all channels is no answer.
    clear : ndarray of bool, shape (H, W), optional
        Where an alpha channel is 0: no answer.
    """

    path: Path
    kind: Kind
    values: npt.NDArray[np.generic]
    clear: npt.NDArray[np.bool_] | None = None

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


def length_error(vectors: Array) -> float:
    """Return how far channel vectors, shape (..., 3), are from length 1, in the mean; inf without any."""
    off = np.abs(np.linalg.norm(vectors, axis=-1) - 1)
    off = off[np.isfinite(off)]
    return float(off.mean()) if off.size else float("inf")


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

"""Where the maps of frames come from: a folder of files, or a method that this package brings."""

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from simtest.dataset.scoring.dense.conventions import Answer, MapOptions
from simtest.dataset.scoring.dense.frame_truth import FrameTruth
from simtest.dataset.scoring.dense.map_files import Kind, MapFile, RawMap, find_maps, read_map
from simtest.dataset.scoring.dense.shading_maps import shading_maps
from simtest.errors import InputError


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
    """A folder of maps.

    Parameters
    ----------
    folder : Path
        Holds the files (`find_maps`).
    """

    folder: Path
    maps: dict[tuple[str, Kind | None], MapFile] = field(init=False)
    _told: Kind | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.maps = {(one.frame, one.kind): one for one in find_maps(self.folder)}

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of maps; where no file's name tells, the first file does."""
        told = {kind for _, kind in self.maps if kind is not None}
        plain = next((one for one in self.maps.values() if one.kind is None), None)
        if plain is not None:
            self._told = self._told or _peek(plain)
            told.add(self._told)
        kinds: tuple[Kind, ...] = ("normal", "depth")
        return tuple(kind for kind in kinds if kind in told)

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
    from simtest.dataset.scoring.dense.map_files import kind_of
    from simtest.validation.depth_maps import read_values

    values = read_values(one.path, "a map of normals or depths")
    if values.ndim == 3 and values.shape[0] in (1, 3) and values.shape[2] not in (1, 3, 4):
        values = np.moveaxis(values, 0, -1)
    return kind_of(values[:, :, 0] if values.ndim == 3 and values.shape[2] == 1 else values[..., :3])


@dataclass(frozen=True)
class Shading:
    """The baseline: normals and depths by shading alone (`simtest.dataset.scoring.dense.shading_maps`)."""

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

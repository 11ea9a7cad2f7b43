"""Sets of frames with their scenes: picture files, folders, films, datasets, and scenes that are rendered for it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from simtest.dataset.reader import open_manifest, read_samples, shard_names
from simtest.errors import InputError
from simtest.reconstruction.images import Source, is_sequence, open_source, read_picture
from simtest.runtime.arrays import Image, only_reading
from simtest.runtime.files import check_count, require_plain
from simtest.spec.scene import Scene, load_scene

if TYPE_CHECKING:
    from simtest.rendering import Session

Item = TypeVar("Item")

MOST_GENERATED = 10_000

FILM_FRAMES = 20
"""Frames of one film that are measured, evenly spread: neighbours are nearly the same picture."""


@dataclass(frozen=True)
class NamedFrame:
    """A frame of a set: its scene's name, its own, and how to read it.

    `read` returns sRGB values in [0, 1], shape (H, W, 3), float32; it raises `InputError` where there are none.
    """

    scene: str
    name: str
    read: Callable[[], Image]


def open_frames(paths: Sequence[Path]) -> list[NamedFrame]:
    """Open picture files, each a scene; films, each a scene; and folders of pictures, each picture a scene.

    Pictures of one film lie in a folder whose name ends in ``.film``: it is one scene.
    """
    frames: list[NamedFrame] = []
    for path in paths:
        if not is_sequence(path):
            require_plain(path, "picture_bytes", "a picture, a film or a folder of pictures")
            frames.append(NamedFrame(str(path), path.name, partial(read_picture, path)))
            continue
        source = open_source(path)
        if source.is_video:
            film = _Film(source)
            frames += [NamedFrame(str(path), f"{path.name}#{index}", partial(film.read, index))
                       for index in _spread(range(source.count), FILM_FRAMES)]  # fmt: skip
        else:
            one = path.suffix == ".film"
            kept = _spread(source.files, FILM_FRAMES) if one else source.files
            frames += [NamedFrame(str(path if one else file), file.name, partial(read_picture, file))
                       for file in kept]  # fmt: skip
    return frames


class _Film:
    """A film whose frames are asked for in their order: each is decoded when it is asked for."""

    def __init__(self, source: Source) -> None:
        self.source, self.left, self.held = source, source.frames(), 0

    def read(self, index: int) -> Image:
        """Return a frame; raise `InputError` where the film ends before it."""
        if index < self.held:
            # A second reading starts at the beginning.
            self.left, self.held = self.source.frames(), 0
        for frame in self.left:
            self.held = frame.index + 1
            if frame.index == index:
                return frame.read()
        path, count = self.source.path, self.source.count
        raise InputError(f"{path}: ends after {self.held} of the {count} frames that it announces")


def _spread(items: Sequence[Item], most: int) -> Sequence[Item]:
    """Return at most so many items, evenly spread."""
    if len(items) <= most:
        return items
    return [items[int(i)] for i in np.linspace(0, len(items) - 1, most)]


def open_generated(against: str, count: int, surfaces: Sequence[str] = ()) -> list[NamedFrame]:
    """Open the generated side: a dataset's folder, a folder or film of frames, or a scene to be rendered.

    Of a dataset at most `count` samples are taken, of as many anatomies as possible; its anatomies are the scenes. Of a
    folder's pictures `count` are taken, evenly spread. `surfaces` names those that are taken of a dataset, by kind of
    surface (colon) or by base scene (tissue_stomach, or stomach), by default all. A scene is rendered `count` times,
    from another viewpoint and with another seed of relief, pattern and noise each time; each frame counts as a scene.
    """
    check_count(count, "--count", MOST_GENERATED)
    if not against.strip():
        raise InputError("--against is empty; must be a dataset's folder, a folder of pictures, or a scene")
    path = Path(against)
    if path.is_dir() and (path / "manifest.json").is_file():
        return _dataset(path, count, surfaces)
    if surfaces:
        raise InputError(f"--surface {surfaces[0]}: only of a dataset, and {against} is none")
    if path.exists() and path.suffix != ".toml":
        return list(_spread(open_frames([path]), count))
    return rendered_frames(load_scene(against), count)


def rendered_frames(base: Scene, count: int) -> list[NamedFrame]:
    """Return frames of a scene that are rendered when they are read, each a scene of its own (see `varied`)."""
    held = _Rendered(base)
    names = [f"{base.name} {i}" for i in range(count)]
    return [NamedFrame(name, name, partial(held.read, i)) for i, name in enumerate(names)]


def _dataset(path: Path, count: int, surfaces: Sequence[str]) -> list[NamedFrame]:
    # Imported here: pictures need no tables.
    import polars as pl

    from simtest.dataset.index import SAMPLES

    names = shard_names(path)
    index = pl.read_parquet(path / SAMPLES).filter(pl.col("shard").is_in(names))
    held = index["surface"].unique(maintain_order=True).to_list()
    described: Any = open_manifest(path).dataset
    scenes = [Path(family["scene"]).stem for family in described["families"]]
    wanted = []
    for name in surfaces:
        of_scene = [i for i, scene in enumerate(scenes) if name in (scene, scene.removeprefix("tissue_"))]
        if name not in held and not of_scene:
            allowed = dict.fromkeys((*held, *scenes))
            raise InputError(f"--surface {name}: {path} has none; it has {', '.join(allowed)}")
        wanted.append(pl.col("surface") == name if name in held else pl.col("family").is_in(of_scene))
    if wanted:
        index = index.filter(pl.any_horizontal(wanted))
    # The first sample of each anatomy, then the second of each, ...: neighbours show one anatomy.
    turn = pl.int_range(pl.len()).over("family", "anatomy")
    taken = index.sort("index").sort(turn, maintain_order=True).head(count).sort("index")
    rows = taken.select("surface", "family", "anatomy", "key", "shard", "index").iter_rows()
    return [NamedFrame(f"{surface} {family}.{anatomy}", key, partial(_sample, path, shard, number))
            for surface, family, anatomy, key, shard, number in rows]  # fmt: skip


def _sample(path: Path, shard: str, index: int) -> Image:
    for sample in read_samples(path, fields=["image"], shards=[shard], indices={index}):
        return np.asarray(sample.images["image"].astype(np.float32) / np.float32(255))
    raise InputError(f"{path / shard}: has no sample {index}; simtest dataset verify --repair mends it")


def varied(scene: Scene, number: int) -> Scene:
    """Return a scene as seen the `number`-th time: another viewpoint, relief, pattern and noise; 0 is the scene."""
    if number == 0:
        return scene
    keys = scene.model_dump(mode="json")
    surface, sensor = keys["surface"], keys["sensor"]
    if surface.get("viewpoint") is not None:
        surface["viewpoint"] += number
    tables = [surface.get("relief"), keys["reflectance"].get("albedo"), sensor, keys["render"]]
    for table in tables:
        if table is not None and "seed" in table:
            table["seed"] = (table["seed"] or 0) + number
    return Scene.model_validate(keys)


class _Rendered:
    """Frames of a scene, rendered one after the other in one session."""

    def __init__(self, base: Scene) -> None:
        self.base = base
        self.session: Session | None = None

    def read(self, number: int) -> Image:
        """Return the scene as seen the `number`-th time."""
        # Imported here: sets of files need no renderer.
        from simtest.rendering import Session
        from simtest.rendering.backend import colour_variant
        from simtest.simulation.frame import render_picture
        from simtest.simulation.sensor import displayed

        scene = varied(self.base, number)
        # Each frame has a relief of its own: none is kept in the user's cache.
        with only_reading("relief"):
            self.session = self.session or Session(scene, colour_variant())
            return displayed(render_picture(self.session, scene), scene.sensor)

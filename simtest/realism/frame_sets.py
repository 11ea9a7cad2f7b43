"""Sets of frames with their scenes: picture files, folders, films, datasets, and scenes that are rendered for it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from simtest.dataset.reader import open_manifest, read_samples
from simtest.errors import InputError
from simtest.reconstruction.image_io import is_sequence, open_source, read_picture
from simtest.runtime.arrays import AnyArray, Image, Picture
from simtest.runtime.resources import shown
from simtest.spec.scene import Scene, load_scene

Item = TypeVar("Item")

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


def open_frames(paths: list[Path]) -> list[NamedFrame]:
    """Open picture files, each a scene; films, each a scene; and folders of pictures, each picture a scene.

    Pictures of one film lie in a folder whose name ends in ``.film``: it is one scene.

    Raises
    ------
    InputError
        If a path is missing or holds no frame.
    """
    frames: list[NamedFrame] = []
    for path in paths:
        if not is_sequence(path):
            if not path.is_file():
                raise InputError(f"{shown(path)}: no such file; must be a picture, a film or a folder of pictures")
            frames.append(NamedFrame(str(path), path.name, partial(read_picture, path)))
            continue
        source = open_source(path)
        if source.is_video:
            frames += _film(path)
        else:
            one = path.suffix == ".film"
            kept = _spread(list(source.files)) if one else source.files
            frames += [NamedFrame(str(path if one else file), file.name, partial(read_picture, file))
                       for file in kept]  # fmt: skip
    return frames


def _film(path: Path) -> Iterator[NamedFrame]:
    """Yield frames of a film, decoded now; a film that ends early yields those it has."""
    count = open_source(path).count
    wanted = set(_spread(list(range(count))))
    for frame in open_source(path).frames():
        if frame.index in wanted:
            # Read now: a film is read in its order.
            yield NamedFrame(str(path), frame.name, partial(_as_values, _as_bytes(frame.read())))


def _as_bytes(values: Image) -> Picture:
    return np.asarray(np.rint(values * 255), dtype=np.uint8)


def _as_values(picture: AnyArray) -> Image:
    return np.asarray(picture.astype(np.float32) / np.float32(255))


def _spread(items: list[Item]) -> list[Item]:
    """Return at most `FILM_FRAMES` items, evenly spread."""
    if len(items) <= FILM_FRAMES:
        return items
    return [items[int(i)] for i in np.linspace(0, len(items) - 1, FILM_FRAMES)]


def open_generated(against: str, count: int) -> list[NamedFrame]:
    """Open the generated side: a dataset's folder, a folder or film of frames, or a scene to be rendered.

    Of a dataset at most `count` samples are taken, in their order; its anatomies are the scenes. A scene is rendered
    `count` times, from another viewpoint and with another seed of relief, pattern and noise each time; each frame
    counts as a scene.
    """
    path = Path(against)
    if path.is_dir() and (path / "manifest.json").is_file():
        open_manifest(path)
        return [*_dataset(path, count)]
    if path.exists() and path.suffix != ".toml":
        return open_frames([path])[:count]
    base = load_scene(against)
    names = [f"{base.name} {i}" for i in range(count)]
    return [NamedFrame(name, name, partial(_rendered, base, i)) for i, name in enumerate(names)]


def _dataset(path: Path, count: int) -> Iterator[NamedFrame]:
    for number, sample in enumerate(read_samples(path, fields=["image"])):
        if number == count:
            return
        anatomy = sample.meta["anatomy"]
        scene = f"{anatomy['family']} {anatomy['number']}"
        yield NamedFrame(scene, sample.key, partial(_as_values, sample.images["image"]))


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


def _rendered(base: Scene, number: int) -> Image:
    # Imported here: sets of files need no renderer.
    from simtest.simulation.camera_chain import to_uint8
    from simtest.simulation.labelled_frame import make_frame

    scene = varied(base, number)
    made = make_frame(scene)
    values = np.clip(made.image, 0, 1) if scene.sensor.encodes else to_uint8(made.image).astype(np.float32) / 255
    return np.asarray(values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2), dtype=np.float32)

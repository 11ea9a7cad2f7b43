"""One scene of the array, rendered, reconstructed and stored once for all checks; and the same scene seen otherwise."""

import copy
import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration import Calibration
from simtest.calibration.photometry import AngularProfile
from simtest.dataset import read
from simtest.dataset.shard_writer import write_dataset
from simtest.estimators.protocol import Target
from simtest.reconstruction import Specularities, reconstruct
from simtest.rendering import Frame, HighlightPoint, Session, TruthMaps
from simtest.runtime.arrays import Array, Image
from simtest.runtime.processes import make_engine
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import Scene, load_dataset
from simtest.spec.scene import scene_from_dict
from studies.corners import formulas
from studies.corners.design import Row
from studies.corners.scenes import settings

ESTIMATORS = ("brightest_point", "cone_axis", "curved", "circle_pose", "bisector", "photometric")

GROWN_PX = 3
"""A region of interest is the box of the brightest detection, grown on each side by so much."""

ROOM_PX = 5
"""How far a highlight that stands alone is from the border, beyond its half height."""

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""What turns directions where the picture is turned by 90 deg, x to y."""


Faults = list[str]
"""What a check found wrong, a line each."""


class NotAskedError(Exception):
    """A check does not apply to a scene; the text says why."""


class View:
    """A scene as it is rendered: session, radiance with labels, exact truth, and the judged view."""

    def __init__(self, tables: Mapping[str, Any]) -> None:
        self.tables = tables
        self.camera: Mapping[str, Any] = tables["camera"]

    @cached_property
    def scene(self) -> Scene:
        """The validated scene."""
        return scene_from_dict(copy.deepcopy(dict(self.tables)))

    @cached_property
    def session(self) -> Session:
        """A session at the scene."""
        return Session(self.scene, labelled=True)

    @cached_property
    def frame(self) -> Frame:
        """Radiance and labels."""
        return self.session.frame()

    @cached_property
    def seen(self) -> RenderedView:
        """The view with its highlights."""
        return render_view(self.session, self.scene, self.frame.radiance)

    @cached_property
    def truth(self) -> TruthMaps:
        """The exact truth at each pixel's centre."""
        self.session.update(self.scene)
        return self.session.truth()

    @cached_property
    def light(self) -> Image:
        """Noise-free light behind the lens, mean of the channels."""
        return mean(self.seen.light)

    @cached_property
    def specular(self) -> Array:
        """The lobe's part of it: no scene has a point spread, and the lens's falloff is known."""
        specular = mean(self.frame.radiance.specular).astype(float)
        return specular * self.falloff

    @cached_property
    def falloff(self) -> Array:
        """The vignetting at each pixel's centre."""
        profile = self.tables["sensor"].get("vignetting")
        return np.ones(self.rays.shape[:2]) if profile is None else self.rays[..., 2].clip(0) ** profile["power"]

    @cached_property
    def rays(self) -> Array:
        """Unit sightlines of the pixels' centres, by the checks' formulas."""
        return formulas.sightlines(self.camera, formulas.pixel_centres(self.camera))

    def stands_alone(self, point: HighlightPoint) -> bool:
        """Return whether a lit highlight is bright and large, and far from the border, from others and from metal.

        Far is beyond the reach of the smoothing by which highlights are judged, 2 px.
        """
        height, width = self.specular.shape
        column, row = (min(int(v), n - 1) for v, n in zip(point.bp_px, (width, height), strict=True))
        start = formulas.climbed(self.specular, (row, column))
        rows, columns = np.nonzero(formulas.at_half_height(self.specular, start))
        radius = float(np.sqrt(len(rows) / np.pi))
        closed = min(rows.min(), columns.min(), height - 1 - rows.max(), width - 1 - columns.max()) >= ROOM_PX
        reach = 3 * radius + 2 * ROOM_PX
        others = [o.bp_px for o in self.seen.highlights if np.linalg.norm(o.bp_px - point.bp_px) > 1e-6]
        metal = self.frame.labels.instrument > 0
        down, right = np.nonzero(metal)
        others += list(np.stack([right, down], axis=-1) + 0.5)
        alone = not others or np.linalg.norm(np.array(others) - point.bp_px, axis=1).min() > reach
        bright = self.specular[start] > max(0.3 * self.specular[~metal].max(), 0.5 * self.light[start])
        return bool(point.lit and closed and alone and bright and radius > 2)


class Case(View):
    """A scene of the array in one of its draws.

    `number`: of the row, from 0; `row`: its levels; `draw`: number of the draw.
    """

    def __init__(self, number: int, row: Row, draw: int = 0) -> None:
        super().__init__(settings(row, draw))
        self.number, self.row, self.draw = number, row, draw
        self._folder: Path | None = None

    @property
    def folder(self) -> Path:
        """A folder for files, removed by `close`."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="corners-"))
        return self._folder

    def close(self) -> None:
        """Remove what was written."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    @property
    def calibration(self) -> Calibration:
        """What reconstruction is given: an emission that is known also where the light is beside the camera."""
        given = self.seen.calibration
        profile = self.tables["rig"]["lights"][0].get("profile")
        if self.row["emission"] != "known" or profile is None or not given.emission.is_uniform:
            return given
        return replace(given, emission=AngularProfile(profile["power"]))

    @cached_property
    def picture(self) -> Image:
        """The sensor's frame, with its noise."""
        return self.seen.frame(self.scene.sensor.seed)

    @cached_property
    def answers(self) -> Specularities:
        """What is reconstructed, in the whole frame or in a region of interest."""
        target: Target = "base" if self.row["relief"] == "not_resolved" else "fine"
        whole = reconstruct(self.picture, self.calibration, ESTIMATORS, target=target)
        if self.row["roi"] == "frame" or not whole:
            return whole
        x, y, width, height = whole[0].region.box
        left, top = max(x - GROWN_PX, 0), max(y - GROWN_PX, 0)
        right = min(x + width + GROWN_PX, self.camera["width"])
        bottom = min(y + height + GROWN_PX, self.camera["height"])
        box = (left, top, right - left, bottom - top)
        return reconstruct(self.picture, self.calibration, ESTIMATORS, roi=box, target=target)

    def written(self) -> Path:
        """Write the scene as a file, and return it."""
        file = self.folder / "corner.toml"
        file.write_text("\n".join(f"{name} = {_toml(value)}" for name, value in self.tables.items()))
        return file

    @cached_property
    def sample(self) -> dict[str, Any]:
        """The sample of a dataset of this scene alone, as it is read back."""
        recipe = self.folder / "corners.toml"
        recipe.write_text(
            "samples = 1\nhighlights = 0\nvisible = true\nradiance = true\n"
            f"splits = {{ train = 1.0, validation = 0.0, test = 0.0 }}\n"
            f"[[families]]\nscene = {json.dumps(str(self.written()))}\n"
        )
        write_dataset(load_dataset(recipe), self.dataset, make_engine())
        return next(iter(read(self.dataset)))

    @property
    def dataset(self) -> Path:
        """The dataset's folder."""
        return self.folder / "dataset"

    # The same scene seen otherwise -------------------------------------------------------------------------------

    @cached_property
    def mirrored(self) -> View:
        """The scene in a mirror: left and right are changed."""
        if self.tables["surface"]["type"] == "anatomy":
            raise NotAskedError("no description of an anatomy's mirror image")
        if self.row["relief"] != "none":
            raise NotAskedError("no description of a relief's mirror image")
        tables = copy.deepcopy(dict(self.tables))
        surface, camera = tables["surface"], tables["camera"]
        surface["azimuth_deg"] = _wrapped(180 - surface["azimuth_deg"])
        surface["spin_deg"] = -surface["spin_deg"]
        for placed in [*tables["rig"]["lights"], *tables.get("instruments", [])]:
            placed["azimuth_deg"] = _wrapped(180 - placed.get("azimuth_deg", 0.0))
        for shaft in tables.get("instruments", []):
            shaft["tip"] = [1 - shaft["tip"][0], shaft["tip"][1]]
        camera["cx"] = camera["width"] - camera["cx"]
        if "p2" in camera.get("distortion", {}):
            camera["distortion"]["p2"] *= -1
        if moved := camera.get("moved"):
            (x, y, z), (a, b, c) = moved["translation_mm"], moved["rotation_deg"]
            camera["moved"] = {"translation_mm": [-x, y, z], "rotation_deg": [a, -b, -c]}
        return View(tables)

    @cached_property
    def turned(self) -> View:
        """The camera, its lights left where they are, turned so that the picture turns by 90 deg, x to y."""
        tables = copy.deepcopy(dict(self.tables))
        camera = tables["camera"]
        width, height = camera["width"], camera["height"]
        camera |= {"width": height, "height": width, "fx": camera["fy"], "fy": camera["fx"],
                   "cx": height - camera["cy"], "cy": camera["cx"]}  # fmt: skip
        if (lens := camera.get("distortion")) and "p1" in lens:
            lens["p1"], lens["p2"] = lens["p2"], -lens["p1"]
        pose = formulas.moved_pose(self.camera)
        vector = formulas.rotation_vector(pose[:3, :3] @ TURN.T)
        camera["moved"] = {"translation_mm": pose[:3, 3].tolist(), "rotation_deg": np.degrees(vector).tolist()}
        for placed in [*tables["rig"]["lights"], *tables.get("instruments", [])]:
            placed["azimuth_deg"] = _wrapped(placed.get("azimuth_deg", 0.0) + 90)
        for shaft in tables.get("instruments", []):
            shaft["tip"] = [1 - shaft["tip"][1], shaft["tip"][0]]
        return View(tables)


def _toml(value: Any) -> str:
    """Return a value as TOML writes it on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{name} = {_toml(each)}" for name, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)


def _wrapped(angle_deg: float) -> float:
    """Return an angle in the range that scenes take."""
    return (angle_deg + 180) % 360 - 180


def mean(image: Image) -> Image:
    """Return the mean of an image's channels, shape (H, W)."""
    return image if image.ndim == 2 else image.mean(axis=2)

"""Frames of tissue with relief for the study of clouds, each with the highlight points of its base; kept on disk."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration import Calibration
from simtest.conventions import PIXEL_CENTRE
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Image, IntArray
from simtest.simulation.frame import render_picture
from simtest.simulation.highlights import CloudRegions
from simtest.spec import load_scene, scene_from_dict
from simtest.spec.scene import Scene
from studies.kept import of_this_code, write_arrays

PICTURE_TABLE = ((3.0, 1.5), (6.0, 1.5), (6.0, 3.0))
"""Slope, deg, and wavelength, mm, of theory.md's table of clouds from a picture."""

STRIDE = 2
"""Of the pixels whose cloud is kept, px."""

FOCAL_PX = 300.0
"""At 512 px: 81 deg. The point that a plane tilted by 25 deg has its cloud around is 140 px off the centre."""


@dataclass(frozen=True)
class Case:
    """A frame to be rendered.

    Parameters
    ----------
    group : str
        What it is counted among.
    seed : int
        Of relief, noise and viewpoint.
    data : mapping
        The scene.
    """

    group: str
    seed: int
    data: Mapping[str, object]

    @property
    def scene(self) -> Scene:
        """The scene."""
        return scene_from_dict(dict(self.data))


@dataclass(frozen=True)
class BaseFrame:
    """A frame with the lit highlight points of its base.

    Parameters
    ----------
    case : Case
        What was rendered.
    picture : ndarray of float32, shape (H, W) or (H, W, 3)
        As encoded.
    lights : ndarray of int, shape (K,)
        Light of each point.
    points_px, normals, gains : ndarray, shape (K, 2), (K, 3), (K, 2)
        Where the points lie, the base's normals there, and 1 + d k of the base along `directions`, shape (K, 2, 3).
    distances : ndarray, shape (K,)
        mm.
    owners : ndarray of int, shape (L, H / 2, W / 2)
        The point that each second pixel belongs to, of each light; -1 for none.
    """

    case: Case
    picture: Image
    lights: IntArray
    points_px: Array
    normals: Array
    gains: Array
    directions: Array
    distances: Array
    owners: IntArray

    @property
    def calibration(self) -> Calibration:
        """What reconstruction is told; a told distance is that of the nearest point."""
        return self.case.scene.calibration(float(self.distances.min()) if len(self.distances) else None)

    def matched(self, points_px: Array, look_px: Array) -> list[int]:
        """Return for each light the highlight point that most of a cloud's spots, shape (N, 2), px, belong to.

        Of several, the nearest to where its estimate looks. Lights to whose points none belongs are left out.
        """
        votes, found = self.votes(points_px), []
        gaps = np.linalg.norm(self.points_px - look_px, axis=1)
        for light in np.unique(self.lights):
            own = np.flatnonzero((self.lights == light) & (votes > 0))
            if len(own):
                best = own[votes[own] == votes[own].max()]
                found.append(int(best[gaps[best].argmin()]))
        return found

    def votes(self, points_px: Array) -> IntArray:
        """Return how many image points, shape (N, 2), belong to each highlight point, over all lights, shape (K,)."""
        columns, rows = (points_px / STRIDE).astype(int).T
        height, width = self.owners.shape[1:]
        held = self.owners[:, np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
        return np.bincount(held[held >= 0].ravel(), minlength=len(self.lights))


def plane(slope_deg: float, wavelength_mm: float, seed: int, focal_px: float = FOCAL_PX) -> Case:
    """Return a case of theory.md's picture table."""
    azimuth = float(np.random.default_rng([seed, 1]).uniform(0, 360))
    surface = {"type": "plane", "distance_mm": 25.0, "tilt_deg": 25.0, "azimuth_deg": azimuth}
    return _smooth_base("plane", surface, (slope_deg, wavelength_mm), seed, focal_px)


def curved(shape: str, kd: float, slope_deg: float, wavelength_mm: float, seed: int) -> Case:
    """Return a case of a cylinder or sphere with a distance times curvature of about `kd`."""
    rng = np.random.default_rng([seed, 2])
    distance = float(rng.uniform(18, 30))
    surface = {
        "type": shape, "distance_mm": distance, "tilt_deg": 12.0, "azimuth_deg": float(rng.uniform(0, 360)),
        "radius_mm": abs(distance / kd), "side": "outside" if kd > 0 else "inside",
    }  # fmt: skip
    return _smooth_base(shape, surface, (slope_deg, wavelength_mm), seed, FOCAL_PX)


def _smooth_base(
    group: str, surface: Mapping[str, object], band: tuple[float, float], seed: int, focal_px: float
) -> Case:
    relief = {"bands": [{"slope_deg": band[0], "wavelength_mm": band[1]}], "seed": seed}
    return Case(
        f"{group} {band[0]:g} deg {band[1]:g} mm" if group == "plane" else group,
        seed,
        {
            "surface": {**surface, "relief": relief},
            "reflectance": {"type": "phong", "exponent": 400.0},
            "camera": {"width": 512, "height": 512, "fx": focal_px, "fy": focal_px},
            "sensor": {"noise_sigma": 0.01, "point_spread_px": 0.7, "exposure": {"percentile": 99.9}, "seed": seed},
            "render": {"samples_per_pixel": 4},
        },
    )


def tissue_scene(organ: str, seed: int) -> dict[str, Any]:
    """Return a shipped tissue scene at a viewpoint of its own, with its own rig."""
    told: dict[str, object] = {"surface.relief.seed": seed, "sensor.seed": seed, "render.samples_per_pixel": 4}
    if organ != "gallbladder":
        told["surface.viewpoint"] = seed
    else:
        rng = np.random.default_rng([seed, 3])
        told |= {"surface.tilt_deg": float(rng.uniform(0, 25)), "surface.spin_deg": float(rng.uniform(0, 180))}
    return load_scene(f"tissue_{organ}", told).model_dump(mode="json")


def tissue(organ: str, seed: int, two_lights: bool = False) -> Case:
    """Return a case of `tissue_scene`; its light at the camera, or its own rig."""
    data = tissue_scene(organ, seed)
    if not two_lights:
        data["rig"] = {"lights": [{"source": {"type": "disc", "radius_mm": 0.9}}]}
    else:
        data["known"] = {"distance_error": 0.0, "distance_sd": 0.1}
    return Case(f"{organ}, its rig" if two_lights else organ, seed, data)


def load(case: Case, folder: Path, session: Session | None) -> tuple[BaseFrame, Session | None]:
    """Return the frame of a case from a folder, or render it there; with the session, for the next one."""
    folder = of_this_code(folder)
    file = folder / f"{case.group.replace(' ', '_').replace(',', '')}_{case.seed}.npz"
    if not file.exists():
        frame, session = _render(case, session)
        arrays = {name: value for name, value in vars(frame).items() if name != "case"}
        scene = np.frombuffer(json.dumps(case.data).encode(), dtype=np.uint8)
        write_arrays(file, {**arrays, "scene": scene})
    with np.load(file) as kept:
        arrays = {name: kept[name] for name in kept.files}
    data = json.loads(arrays.pop("scene").tobytes())
    return BaseFrame(Case(case.group, case.seed, data), **arrays), session


def _render(case: Case, session: Session | None) -> tuple[BaseFrame, Session]:
    scene = case.scene
    if session is None:
        session = Session(scene)
    session.update(scene)
    radiance = session.radiance()
    picture = render_picture(session, scene, radiance)
    points = [point for point in session.base_highlights(radiance) if point.lit]
    height, width = picture.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(0, width, STRIDE), np.arange(0, height, STRIDE)), axis=-1) + PIXEL_CENTRE
    owners, regions = [], CloudRegions.of(session, points)
    for light in range(len(scene.rig.lights)):
        pixels = grid.reshape(-1, 2)
        own = regions.assign(np.full(len(pixels), light), pixels)
        owners.append(np.array([-1 if n is None else n for n in own]).reshape(grid.shape[:2]))
    frame = BaseFrame(
        case=case,
        picture=picture,
        lights=np.array([point.light for point in points], dtype=np.int64),
        points_px=np.array([point.bp_px for point in points]).reshape(-1, 2),
        normals=np.array([point.normal_base for point in points]).reshape(-1, 3),
        gains=np.array([[1 + point.kd_min_base, 1 + point.kd_max_base] for point in points]).reshape(-1, 2),
        directions=np.array(
            [[point.direction_min, np.cross(point.normal_base, point.direction_min)] for point in points]
        ).reshape(-1, 2, 3),
        distances=np.array([point.distance for point in points]),
        owners=np.array(owners, dtype=np.int16),
    )
    return frame, session

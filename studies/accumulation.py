"""What highlights of many frames give over those of one: python -m studies.accumulation [--scenes N] [--first SEED].

A camera with its light moves over tissue with relief, within `REACH_MM` of its place and always looking the same way.
Spots are found in each noisy frame, as `cloud` finds them; poses and the plane of the tissue are told with errors. The
table has, for each slope, number of frames and error of the poses: the error of the base's normal of
`accumulated.base_normal`, the share of 95 % regions that hold the truth, the mean of the fine normals seen (which is
biased), and `cloud` of the first frame alone.
"""

import argparse
import sys

import numpy as np

from simtest.calibration import Frame
from simtest.errors import Failure
from simtest.estimators.accumulated import PatchNormal, Plane, Sighting, base_normal, fine_map
from simtest.estimators.cloud import cloud
from simtest.estimators.cloud_spots import find_spots
from simtest.geometry import Array
from simtest.geometry.vectors import angle_deg, rotation
from simtest.rendering import Session
from simtest.simulation.rendered_view import render_picture
from simtest.spec import Scene, scene_from_dict

SLOPES = 2.0, 4.0, 6.0
FRAMES = 1, 3, 10, 30
POSES = {"exact": (0.0, 0.0), "0.5 %, 0.2 deg": (0.005, 0.2), "2 %, 1 deg": (0.02, 1.0)}
"""Standard deviations of a told pose: of the centre as a share of the distance, and of the turn, deg."""

DISTANCE_MM, WAVELENGTH_MM, REACH_MM, RADIUS_MM = 20.0, 1.5, 5.0, 7.0
PLANE_ERROR = 0.02, 5.0
"""Standard deviations of the told plane: its distance as a share, its tilt in deg."""

CHI95 = 5.991
GOLDEN = 2.399963


def scene(slope_deg: float, seed: int, tilt: tuple[float, float], across: tuple[float, float]) -> Scene:
    """Return the scene with the camera moved across its axis, mm."""
    band = {"slope_deg": slope_deg, "wavelength_mm": WAVELENGTH_MM}
    return scene_from_dict(
        {
            "surface": {
                "type": "plane",
                "distance_mm": DISTANCE_MM,
                "tilt_deg": tilt[0],
                "azimuth_deg": tilt[1],
                "relief": {"bands": [band], "seed": seed},
            },
            "reflectance": {"type": "phong", "exponent": 1600.0, "diffuse": 0.02},
            "camera": {"width": 320, "height": 320, "fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 160.0,
                       "moved": {"translation_mm": [*across, 0.0]}},
            "sensor": {"noise_sigma": 0.01, "seed": seed, "exposure": {"percentile": 99.5}},
        }
    )  # fmt: skip


def film(slope_deg: float, seed: int) -> tuple[list[tuple[Array, Array]], Array, Array, object]:
    """Render a film; return true poses and sightlines of the spots, true base normal, its point, and `cloud` of one."""
    rng = np.random.default_rng([41, seed, int(slope_deg)])
    tilt = float(rng.uniform(0, 20)), float(rng.uniform(-180, 180))
    order = rng.permutation(max(FRAMES) - 1) + 1
    session, views, single = None, [], None
    for number, i in enumerate([0, *order]):
        r = REACH_MM * np.sqrt(i / (max(FRAMES) - 1))
        now = scene(slope_deg, seed, tilt, (float(r * np.cos(i * GOLDEN)), float(r * np.sin(i * GOLDEN))))
        now = now.model_copy(update={"sensor": now.sensor.model_copy(update={"seed": 1000 * seed + number})})
        session = session or Session(now)
        picture = render_picture(session, now)
        frame = Frame(picture, now.calibration(), 2.0)
        spots = find_spots(frame).points_px
        views.append((np.array(session.surface.model_from_camera), session.camera.unproject(spots)))
        if number == 0:
            single = cloud.estimate_frame(frame, session.camera)
    # The model frame of a plane has its normal along z, towards the camera, and the anchor at 0.
    return views, np.array([0.0, 0.0, 1.0]), np.zeros(3), single


def told(views: list[tuple[Array, Array]], error: tuple[float, float], rng: np.random.Generator) -> list[Sighting]:
    """Return the sightings with errors of the poses."""
    half = np.tan(np.arctan(160 / 300))

    def in_view(rays: Array) -> Array:
        return np.asarray((rays[:, 2] > 0) & (np.abs(rays[:, :2]) < half * rays[:, 2:]).all(axis=1))

    sightings = []
    for pose, rays in views:
        off = pose.copy()
        off[:3, 3] += rng.normal(0, error[0] * DISTANCE_MM, 3)
        off[:3, :3] = off[:3, :3] @ rotation(np.radians(rng.normal(0, error[1], 3)))
        sightings.append(Sighting(off, rays, in_view))
    return sightings


def one_film(slope_deg: float, seed: int) -> list[dict[str, object]]:
    """Return the rows of one film."""
    views, normal, point, single = film(slope_deg, seed)
    rng = np.random.default_rng([42, seed, int(slope_deg)])
    axis = rng.normal(0, 1, 3) * [1, 1, 0]
    coarse = rotation(np.radians(PLANE_ERROR[1]) * axis) @ normal
    # The patch lies where the first camera's axis meets the plane told.
    plane = Plane(point + normal * DISTANCE_MM * PLANE_ERROR[0] * rng.normal(), coarse)
    rows: list[dict[str, object]] = []
    one = float("nan")
    if not isinstance(single, Failure):
        pose = views[0][0]
        one = min(float(angle_deg(pose[:3, :3] @ each.normal, normal)) for each in single[:1])
    for name, error in POSES.items():
        for count in FRAMES:
            sightings = told(views[:count], error, rng)
            found = base_normal(sightings, plane, RADIUS_MM, (error[0] * DISTANCE_MM, float(np.radians(error[1]))))
            seen = fine_map(sightings, plane)
            near = np.linalg.norm(seen.position - plane.point, axis=1) < RADIUS_MM
            mean = seen.normal[near].mean(axis=0) if near.any() else np.full(3, np.nan)
            row = {"slope": slope_deg, "seed": seed, "poses": name, "frames": count, "cloud": one, "spots": near.sum()}
            row["mean"] = float(angle_deg(mean / np.linalg.norm(mean), normal))
            ok = isinstance(found, PatchNormal)
            row["error"] = float(angle_deg(found.normal, normal)) if ok else float("nan")
            row["d2"] = found.squared_mahalanobis(normal) if ok else float("nan")
            row["s"] = float(np.degrees(found.slope)) if ok else float("nan")
            row["sd"] = float(np.degrees(np.sqrt(np.trace(found.covariance)))) if ok else float("nan")
            rows.append(row)
    return rows


def table(rows: list[dict[str, object]]) -> str:
    """Return the table in Markdown."""
    lines = [
        "| slope, deg | poses off by | frames | spots | answers | error: mean, deg | stated, deg | 95 % regions hold | "
        "mean of fine normals, deg | `cloud` of one frame, deg (answers) |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for slope in SLOPES:
        for name in POSES:
            for count in FRAMES:
                own = [r for r in rows if (r["slope"], r["poses"], r["frames"]) == (slope, name, count)]
                if not own:
                    continue
                column = {k: np.array([r[k] for r in own], dtype=float) for k in ("error", "d2", "mean", "cloud", "sd")}
                ok = np.isfinite(column["error"])
                held = 100 * np.mean(column["d2"][ok] < CHI95) if ok.any() else np.nan
                told_one = np.isfinite(column["cloud"])
                one = column["cloud"][told_one].mean() if told_one.any() else np.nan
                spots = np.mean([float(r["spots"]) for r in own])  # type: ignore[arg-type]
                lines.append(
                    f"| {slope:g} | {name} | {count} | {spots:.0f} | {ok.sum()} of {len(own)} | "
                    f"{np.nanmean(column['error']) if ok.any() else np.nan:.2f} | "
                    f"{np.nanmean(column['sd']) if ok.any() else np.nan:.2f} | {held:.0f} % | "
                    f"{np.nanmean(column['mean']):.2f} | {one:.2f} ({told_one.sum()}) |"
                )
    return "\n".join(lines)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=16, help="films for each slope")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first film")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.scenes):
        for slope in SLOPES:
            rows += one_film(slope, seed)
        print(f"{seed - options.first + 1} of {options.scenes} films", file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()

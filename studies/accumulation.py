"""What many frames give over one: python -m studies.accumulation [--scenes N] [--first SEED].

A camera with its light moves over tissue with relief, within `REACH_MM` of its place and always looking the same way.
Poses and the plane of the tissue are told with errors. Three tables, with an estimate a film (spots and errors of
poses: of every fourth film):

1. by the number of frames, with exact poses: the error of the base's normal from the light of all highlights and from
   the spots counted (`accumulated.base_normal`), the share of 95 % regions that hold the truth, and the mean of the
   fine normals seen, which is biased;
2. the estimate of all frames against `cloud` of the first frame, in pairs;
3. all frames, by the error of the poses.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from simtest.errors import Failure
from simtest.estimators.accumulated import CHI95, base_normal
from simtest.estimators.cloud import cloud
from simtest.estimators.sightings import Plane, Sighting, fine_map, light_of, spots_of
from simtest.geometry import Array
from simtest.geometry.vectors import angle_deg, deviation_deg, rotation
from simtest.rendering import Session
from simtest.runtime.statistics import share_interval
from simtest.simulation.rendered_view import render_picture
from simtest.spec import Scene, scene_from_dict
from studies.kept import code_hash

SLOPES = 2.0, 4.0, 6.0
FRAMES = 1, 5, 10, 30
POSES = (0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (2.0, 0.0), (0.0, 0.5), (0.0, 1.0), (0.0, 2.0)
"""Standard deviations of a told pose: of the centre along each axis, mm, and of the turn about each axis, deg."""

DISTANCE_MM, WAVELENGTH_MM, REACH_MM, RADIUS_MM = 20.0, 1.5, 5.0, 7.0
PLANE_ERROR = 0.02, 5.0
"""Standard deviations of the told plane: its distance as a share, its tilt about each axis in deg."""

GOLDEN = 2.399963
MOST_TILT_DEG = 20.0
Views = list[tuple[Sighting, Sighting | None]]
Row = dict[str, float]


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


def film(slope_deg: float, seed: int) -> tuple[Views, float]:
    """Render a film; return light and spots of each frame at its true pose, and the error of `cloud` of the first, deg.

    Of films that are not whole the spots are left out, which cost more than the picture: they are None. The base's
    normal is z of the model frame, and the camera of the first frame looks at its origin.
    """
    rng = np.random.default_rng([41, seed, int(slope_deg)])
    tilt = float(rng.uniform(0, MOST_TILT_DEG)), float(rng.uniform(-180, 180))
    order = rng.permutation(max(FRAMES) - 1) + 1
    session, views, single = None, [], float("nan")
    for number, i in enumerate([0, *order]):
        r = REACH_MM * np.sqrt(i / (max(FRAMES) - 1))
        now = scene(slope_deg, seed, tilt, (float(r * np.cos(i * GOLDEN)), float(r * np.sin(i * GOLDEN))))
        now = now.model_copy(update={"sensor": now.sensor.model_copy(update={"seed": 1000 * seed + number})})
        session = session or Session(now)
        frame = Frame(render_picture(session, now), now.calibration(), 2.0)
        pose = np.array(session.surface.model_from_camera)
        views.append((light_of(frame, pose), spots_of(frame, pose) if is_whole(seed) else None))
        if number == 0:
            found = cloud.estimate_frame(frame, session.camera)
            if not isinstance(found, Failure):
                single = float(angle_deg(pose[:3, :3] @ found[0].normal, UP))
    return views, single


UP = np.array([0.0, 0.0, 1.0])


def is_whole(seed: int) -> bool:
    """Return whether a film is also for counted spots and errors of the poses: every fourth one is."""
    return seed % 4 == 0


def told(sightings: Iterable[Sighting], error: tuple[float, float], rng: np.random.Generator) -> list[Sighting]:
    """Return sightings whose poses are off by errors of these standard deviations, mm and deg."""
    moved = []
    for sighting in sightings:
        off = sighting.world_from_camera.copy()
        off[:3, 3] += rng.normal(0, error[0], 3)
        off[:3, :3] = off[:3, :3] @ rotation(np.radians(rng.normal(0, error[1], 3)))
        moved.append(Sighting(off, sighting.sightlines, sighting.in_view, sighting.light))
    return moved


def answer(row: Row, name: str, sightings: list[Sighting], plane: Plane, error: tuple[float, float]) -> None:
    """Estimate the base's normal, and write error, squared distance, stated uncertainty and slope into a row."""
    found = base_normal(sightings, plane, RADIUS_MM, (error[0], float(np.radians(error[1]))))
    if isinstance(found, Failure):
        row |= {f"{name} {what}": float("nan") for what in ("error", "d2", "stated", "slope")}
        return
    row[f"{name} error"] = float(angle_deg(found.normal, UP))
    row[f"{name} d2"] = found.squared_mahalanobis(UP)
    row[f"{name} stated"] = deviation_deg(found.covariance)
    row[f"{name} slope"] = float(np.degrees(found.slope))


def one_film(slope_deg: float, seed: int) -> list[Row]:
    """Return the rows of one film: one for each number of frames, and one for each error of the poses."""
    views, single = film(slope_deg, seed)
    rng = np.random.default_rng([42, seed, int(slope_deg)])
    axis = rng.normal(0, 1, 3) * [1, 1, 0]
    coarse = rotation(np.radians(PLANE_ERROR[1]) * axis) @ UP
    plane = Plane(UP * DISTANCE_MM * PLANE_ERROR[0] * rng.normal(), coarse)
    rows = []
    others = POSES[1:] if is_whole(seed) else ()
    for count, error in [*((n, POSES[0]) for n in FRAMES), *((max(FRAMES), each) for each in others)]:
        row: Row = {"slope": slope_deg, "seed": seed, "frames": count, "mm": error[0], "deg": error[1], "cloud": single}
        answer(row, "light", told((light for light, _ in views[:count]), error, rng), plane, error)
        spots = [spot for _, spot in views[:count] if spot is not None]
        if spots and error == POSES[0]:
            answer(row, "spots", spots, plane, error)
            seen = fine_map(spots, plane)
            near = np.linalg.norm(seen.position - plane.point, axis=1) < RADIUS_MM
            mean = seen.normal[near].mean(axis=0) if near.any() else np.full(3, np.nan)
            row["mean"] = float(angle_deg(mean / np.linalg.norm(mean), UP))
        rows.append(row)
    return rows


def column(rows: list[Row], name: str) -> Array:
    """Return a column of rows, shape (N,)."""
    return np.array([row.get(name, np.nan) for row in rows], dtype=float)


def held(rows: list[Row], name: str) -> str:
    """Return how many 95 % regions hold the truth, with a 95 % interval of their share."""
    d2 = column(rows, f"{name} d2")
    d2 = d2[np.isfinite(d2)]
    if not len(d2):
        return "none"
    hits = int(np.count_nonzero(d2 < CHI95))
    low, high = share_interval(d2 < CHI95)
    return f"{hits} of {len(d2)} ({100 * low:.0f} to {100 * high:.0f} %)"


def mean_of(rows: list[Row], name: str) -> str:
    """Return the mean of a column over the rows that have it."""
    values = column(rows, name)
    values = values[np.isfinite(values)]
    return f"{values.mean():.2f}" if len(values) else "none"


def by_frames(own: list[Row]) -> list[str]:
    """Return the cells of the first table."""
    light = [mean_of(own, f"light {name}") for name in ("error", "stated")]
    return [*light, held(own, "light"), mean_of(own, "spots error"), held(own, "spots"), mean_of(own, "mean")]


def by_poses(own: list[Row]) -> list[str]:
    """Return the cells of the third table."""
    return [mean_of(own, "light error"), mean_of(own, "light stated"), held(own, "light")]


def pairs(rows: list[Row]) -> str:
    """Return the second table: `cloud` of one frame and the estimate of all, of the films where both answer."""
    lines = [
        "| slope, deg | films | `cloud`, deg | all frames, deg | less, deg (95 % interval) |",
        "|---|---|---|---|---|",
    ]
    for slope in SLOPES:
        own = [r for r in rows if (r["slope"], r["frames"], r["mm"], r["deg"]) == (slope, max(FRAMES), 0, 0)]
        one, many = column(own, "cloud"), column(own, "light error")
        both = np.isfinite(one) & np.isfinite(many)
        if np.count_nonzero(both) < 2:
            lines.append(f"| {slope:g} | {np.count_nonzero(both)} of {len(own)} | | | |")
            continue
        gain = (one - many)[both]
        # Student's t would be wider by 6 % at 24 films: draw films instead.
        draws = np.random.default_rng(0).choice(gain, (10000, len(gain))).mean(axis=1)
        low, high = np.quantile(draws, [0.025, 0.975])
        lines.append(
            f"| {slope:g} | {len(gain)} of {len(own)} | {one[both].mean():.2f} | {many[both].mean():.2f} | "
            f"{gain.mean():.2f} ({low:.2f} to {high:.2f}) |"
        )
    return "\n".join(lines)


def table(head: str, rows: list[Row], keys: tuple[str, ...], cells: Callable[[list[Row]], list[str]]) -> str:
    """Return a table in Markdown: a line for each slope and value of the keys."""
    lines = [head, "|" + "---|" * (head.count("|") - 1)]
    for values in sorted({tuple(row[key] for key in ("slope", *keys)) for row in rows}):
        own = [row for row in rows if tuple(row[key] for key in ("slope", *keys)) == values]
        lines.append("| " + " | ".join([f"{value:g}" for value in values] + cells(own)) + " |")
    return "\n".join(lines)


def tables(rows: list[Row]) -> str:
    """Return all tables."""
    exact = [row for row in rows if row["mm"] == row["deg"] == 0]
    frames = (
        "| slope, deg | frames | light: error, deg | stated, deg | 95 % regions hold | spots: error, deg | "
        "95 % regions hold | mean of fine normals, deg |"
    )
    poses = "| slope, deg | centre, mm | turn, deg | error, deg | stated, deg | 95 % regions hold |"
    whole = [row for row in rows if row["frames"] == max(FRAMES) and is_whole(int(row["seed"]))]
    return "\n\n".join(
        [
            table(frames, exact, ("frames",), by_frames),
            pairs(rows),
            table(poses, whole, ("mm", "deg"), by_poses),
        ]
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=24, help="films for each slope")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first film")
    parser.add_argument(
        "--rows", type=Path, help="JSON file of the rows, film by film; films in it are not rendered again"
    )
    options = parser.parse_args()
    rows: list[Row] = []
    if options.rows is not None and options.rows.is_file():
        held = json.loads(options.rows.read_text())
        # Rows of other code are made again.
        rows = held["rows"] if held["code"] == code_hash() else []
    done = {row["seed"] for row in rows}
    for seed in range(options.first, options.first + options.scenes):
        if seed in done:
            continue
        for slope in SLOPES:
            rows += one_film(slope, seed)
        if options.rows is not None:
            options.rows.write_text(json.dumps({"code": code_hash(), "rows": rows}))
        print(f"{seed - options.first + 1} of {options.scenes} films", file=sys.stderr, flush=True)
    print(tables(rows))


if __name__ == "__main__":
    main()

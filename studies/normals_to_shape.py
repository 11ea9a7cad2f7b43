"""Whether the normals at highlights improve a coarse depth map: paired gains against the number of highlights.

    python -m studies.normals_to_shape [--frames N] [--first VIEWPOINT] [--out FILE]

Each frame of a colon or a liver, smooth or of tissue, gets three coarse maps of distance: the truth with a smooth error
of 5 % (`planted`), the same after blurring, as networks blur folds (`blurred`), and shading alone (`shading`). Normals
correct each map (`studies.depth_completion`), which is told the same error of 5 % every time. The error is
the angle between the map's normals and those of the base surface; the gain is the mean angle before minus that after,
over all pixels and over those within 10 px of a normal, in the coarse map's pixels.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import print_markdown
from simtest.calibration import Calibration
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.errors import Failure
from simtest.estimators.protocol import Target
from simtest.geometry import Camera
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import best_of
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Mask
from simtest.simulation.frame import render_view
from simtest.spec import Scene, load_scene
from simtest.validation.depth_maps import depth_normals
from studies.depth_completion import CoarseError, complete
from studies.resampling import interval_of_mean

EVERY = 6
"""The coarse maps hold every sixth pixel of a frame."""

ERROR = CoarseError(0.05, 30.0)
COUNTS = (1, 5, 20, 80)
NEAR_PX = 10.0
SURE_DEG = 0.1
BLUR_PX = 4.0
SIZE = {
    "camera.width": 642, "camera.height": 480, "camera.fx": 320.0, "camera.fy": 320.0, "camera.cx": 321.0,
    "camera.cy": 240.0,
}  # fmt: skip
KINDS = {
    "smooth colon": ("anatomy", {"surface.path": "colon", "reflectance.exponent": 400.0}),
    "smooth liver": ("anatomy", {"surface.path": "liver", "reflectance.exponent": 400.0}),
    "tissue colon": ("tissue_colon", {"render.samples_per_pixel": 4}),
    "tissue liver": ("tissue_liver", {"render.samples_per_pixel": 4}),
}
RESAMPLES = 2000

Normals = tuple[Array, Array, Array]
"""Pixels of the coarse map, shape (N, 2), normals (N, 3), and their covariances (N, 2, 2)."""


@dataclass(frozen=True)
class View:
    """A frame's truth on the coarse grid, its coarse maps, and the normals of each source.

    Parameters
    ----------
    camera : Camera
        Of the coarse grid.
    rays, normals : ndarray, shape (H, W, 3)
        Sightlines, and the true normals of the base.
    maps : dict of ndarray, shape (H, W)
        Coarse distances, mm, by kind.
    sources : dict
        Normals by where they come from.
    """

    camera: Camera
    rays: Array
    normals: Array
    maps: dict[str, Array]
    sources: dict[str, Normals]


def load_view(session: Session | None, scene: Scene, seed: int) -> tuple[View, Session]:
    """Render a frame, reconstruct it, and take its coarse maps and normals."""
    session = session or Session(scene, labelled=True)
    view = render_view(session, scene)
    truth = session.truth()
    fine = view.calibration.camera
    at = (slice(EVERY // 2, None, EVERY),) * 2
    mask = truth.mask[at]
    height, width = mask.shape
    camera = Camera(width, height, fine.fx / EVERY, fine.fy / EVERY, fine.cx / EVERY, fine.cy / EVERY)
    distance = np.where(mask, np.linalg.norm(truth.position[at], axis=-1), np.nan)
    normals = np.where(mask[..., None], truth.normal_base[at], np.nan)
    random = np.random.default_rng(seed)
    error = _field(random, mask.shape)
    image = view.frame(seed)
    _, shaded = shading_maps(image, view.calibration)
    shading = shaded[at] * np.nanmedian(distance) / np.nanmedian(shaded[at])
    maps = {
        "planted": distance * np.exp(error),
        "blurred": np.exp(_blur(np.log(distance), mask)) * np.exp(error),
        "shading": np.where(mask, shading, np.nan),
    }
    # A sensor of 8 bits gives a picture, in which highlights are found by colour.
    picture = np.round(255 * image).astype(np.uint8) if scene.sensor.bits == 8 else image
    sources = {
        "fine": _measured(picture, view.calibration, "fine"),
        "base": _measured(picture, view.calibration, "base"),
        "cloud": _measured(picture, view.calibration, "base", ["cloud"]),
        "exact": _exact(random, normals),
    }
    # Shading has no answer where a frame holds no matt pixel.
    maps = {kind: held for kind, held in maps.items() if np.isfinite(held).any()}
    return View(camera, camera.unproject(camera.pixel_centres()), normals, maps, sources), session


def _field(random: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return a smooth error of 5 %: white noise under a Gaussian as wide as the stated correlation."""
    noise = random.normal(size=(shape[0] + 80, shape[1] + 80))
    smooth = cv2.GaussianBlur(noise, (0, 0), ERROR.length_px / 4)[40:-40, 40:-40]
    return np.asarray(ERROR.share * smooth * np.sqrt(4 * np.pi) * ERROR.length_px / 4)


def _blur(values: Array, mask: Mask) -> Array:
    """Return values blurred inside a mask."""
    filled = np.where(mask, values, 0.0)
    weight = cv2.GaussianBlur(mask.astype(float), (0, 0), BLUR_PX)
    return np.asarray(np.where(mask, cv2.GaussianBlur(filled, (0, 0), BLUR_PX) / np.maximum(weight, 1e-9), np.nan))


def _measured(image: Array, calibration: Calibration, target: Target, names: list[str] | None = None) -> Normals:
    """Return the best normal of each highlight, by the default estimators or those named, with its covariance."""
    rows = []
    for spot in reconstruct(image, calibration, names, target=target):
        name, _ = best_of(spot.estimates)
        best = None if name is None else spot.estimates[name]
        if best is not None and not isinstance(best, Failure) and best.covariance is not None:
            rows.append((best.look_px / EVERY, best.normal, best.covariance))
    return _stacked(rows)


def _exact(random: np.random.Generator, normals: Array) -> Normals:
    """Return the true normals of the base at random pixels."""
    known = np.argwhere(np.isfinite(normals).all(axis=-1))
    chosen = known[random.permutation(len(known))[: max(COUNTS)]]
    variance = np.radians(SURE_DEG) ** 2 * np.eye(2)
    return _stacked([(at[::-1] + 0.5, normals[tuple(at)], variance) for at in chosen])


def _stacked(rows: list[tuple[Array, Array, Array]]) -> Normals:
    if not rows:
        return np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 2, 2))
    pixels, normals, covariances = (np.array(part, dtype=float) for part in zip(*rows, strict=True))
    return pixels, normals, covariances


def gains(view: View, seed: int) -> Iterator[dict[str, object]]:
    """Yield the mean angles before and after the correction of each map by each source and number of normals."""
    for source, (pixels, normals, covariances) in view.sources.items():
        order = np.random.default_rng(seed).permutation(len(pixels))
        for count in COUNTS:
            if len(order) < count:
                continue
            used = order[:count]
            near = _near(view.normals.shape[:2], pixels[used])
            for kind, coarse in view.maps.items():
                made = complete(coarse, view.camera, pixels[used], normals[used], covariances[used], ERROR)
                before, after = (_angles(view, each) for each in (coarse, made))
                for where, region in (("all", np.ones_like(near)), ("near", near)):
                    both = region & np.isfinite(before) & np.isfinite(after)
                    if both.any():
                        means = {"before": float(before[both].mean()), "after": float(after[both].mean())}
                        yield {"source": source, "count": count, "map": kind, "where": where, **means}


def _near(shape: tuple[int, ...], pixels: Array) -> Mask:
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    away = [np.hypot(columns - x, rows - y) for x, y in pixels]
    return np.asarray(np.min(away, axis=0) <= NEAR_PX)


def _angles(view: View, distance: Array) -> Array:
    """Return the angle between a map's normals and the true ones, deg, shape (H, W)."""
    found = depth_normals(distance[..., None] * view.rays, radius_px=1)
    return np.asarray(np.degrees(np.arccos(np.clip((found * view.normals).sum(axis=-1), -1, 1))))


def interval(values: Array) -> tuple[float, float]:
    """Return the 95 % interval of a mean by bootstrap over frames."""
    return interval_of_mean(values, np.arange(len(values)), RESAMPLES, seed=1)


def print_gains(rows: list[dict[str, object]]) -> None:
    """Print a line for each kind of surface, map, source, number of normals and region."""
    keys = ("kind", "map", "source", "count", "where")
    table = [(*keys, "frames", "before, deg", "gain, deg", "95 % interval")]
    for key in dict.fromkeys(tuple(row[name] for name in keys) for row in rows):
        own = [row for row in rows if tuple(row[name] for name in keys) == key]
        before, after = (np.array([row[name] for row in own], dtype=float) for name in ("before", "after"))
        gain = before - after
        low, high = interval(gain)
        span = f"{low:+.2f} to {high:+.2f}" if len(own) > 1 else "one frame"
        table.append((*map(str, key), str(len(own)), f"{before.mean():.2f}", f"{gain.mean():+.2f}", span))
    print_markdown(table)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=12, help="of each kind")
    parser.add_argument("--first", type=int, default=7000, help="first viewpoint")
    parser.add_argument("--out", type=Path, help="JSON that gets every row")
    given = parser.parse_args()
    rows: list[dict[str, object]] = []
    for kind, (name, settings) in KINDS.items():
        session = None
        for seed in range(given.first, given.first + given.frames):
            scene = load_scene(name, {**SIZE, **settings, "surface.viewpoint": seed})
            view, session = load_view(session, scene, seed)
            counts = {source: len(held[0]) for source, held in view.sources.items()}
            print(f"{kind} {seed}: normals {counts}", flush=True)
            rows += [{"kind": kind, "frame": seed, **row} for row in gains(view, seed)]
    if given.out is not None:
        given.out.write_text(json.dumps(rows))
    print_gains(rows)


if __name__ == "__main__":
    main()

"""The truth of one frame, as far as dense maps are scored against it: its maps, and zones and cells of its pixels."""

import hashlib
import itertools
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, Image, IntArray, Mask, short_repr, write_arrays
from simtest.runtime.files import write_atomically
from simtest.spec import Scene

if TYPE_CHECKING:
    from simtest.rendering import Session, TruthMaps
    from simtest.simulation.frame import RenderedView

SURFACES = ("fine", "base")
"""The two truths: with relief and without. They are equal where a scene has none."""

EXCLUDED = ("outside_view", "no_surface", "instrument")
"""Why a pixel is not scored; each pixel is counted at the first reason that holds."""


@dataclass(frozen=True)
class FrameTruth:
    """The truth at each pixel's centre, camera frame."""

    name: str  # of the frame; its map has the same
    camera: Camera
    normal: Mapping[str, Array]  # unit, shape (H, W, 3), of the fine surface and of the base, by name
    # principal curvature of the larger size, 1/mm, convex towards the camera positive, of both, shape (H, W)
    curvature: Mapping[str, Array]
    distance: Array  # along the pixel's ray, mm, shape (H, W)
    eps: float  # offset of the light that is farthest from the camera, mm
    scored: Mask  # pixels of the surface inside the view, which are scored, shape (H, W)
    excluded: Mapping[str, int]  # how many pixels are not, by reason
    zone: npt.NDArray[np.uint8]  # see `zones`, shape (H, W)
    image: Image | None = None  # the frame as the sensor encoded it, shape (H, W) or (H, W, 3)
    calibration: Calibration | None = None  # what methods are told of the camera
    setting: str = ""  # of the experiment
    swept: Mapping[str, object] = field(default_factory=dict)  # values of the swept parameters
    # names the scene, of a dataset the anatomy, which other frames may show too. Empty where each has its own
    scene: str = ""

    __repr__ = short_repr

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.camera.height, self.camera.width


def frame_truth(
    name: str, maps: "TruthMaps", camera: Camera, eps: float, regions: IntArray, image: Image | None = None,
    calibration: Calibration | None = None, setting: str = "", swept: Mapping[str, object] | None = None,
    scene: str = "",
) -> FrameTruth:  # fmt: skip
    """Return the truth of a frame from its maps and the regions of its visible highlights (`VisibleSpots.regions`)."""
    metal = maps.instrument > 0
    seen = np.ones(maps.mask.shape, dtype=bool) if camera.seen is None else camera.seen
    bare = ~maps.mask | ~np.isfinite(maps.normal).all(axis=-1) | ~np.isfinite(maps.normal_base).all(axis=-1)
    scored, excluded = np.ones(maps.mask.shape, dtype=bool), {}
    for reason, where in zip(EXCLUDED, (~seen, bare & ~metal, metal), strict=True):
        excluded[reason] = int((scored & where).sum())
        scored &= ~where
    # A reflection on metal is no highlight of the surface.
    of_surface = np.where(np.isin(regions, np.unique(regions[metal])), 0, regions) if metal.any() else regions
    low, high = maps.k_min_base, maps.k_max_base
    return FrameTruth(
        name=name,
        camera=camera,
        normal={"fine": maps.normal, "base": maps.normal_base},
        curvature={"fine": maps.larger_curvature, "base": np.where(np.abs(high) >= np.abs(low), high, low)},
        distance=maps.depth,
        eps=eps,
        scored=scored,
        excluded=excluded,
        zone=zones(of_surface),
        image=image,
        calibration=calibration,
        setting=setting,
        swept=dict(swept or {}),
        scene=scene,
    )


def truth_of_view(
    name: str, view: "RenderedView", session: "Session", setting: str = "",
    swept: Mapping[str, object] | None = None, image: Image | None = None, scene: str = "",
) -> FrameTruth:  # fmt: skip
    """Return the truth of a rendered view; the session stands at its scene, which `scene` names."""
    return frame_truth(
        name, session.truth(), session.camera, _eps(view.scene), view.spots.regions, image, view.calibration, setting,
        swept, scene or view.scene.model_dump_json(),
    )  # fmt: skip


def _eps(scene: Scene) -> float:
    return float(np.linalg.norm(scene.rig.true_mm(), axis=1).max())


# Kept beside a run --------------------------------------------------------------------------------------------------

MOST_KEPT = 64
"""Runs of more exported frames keep no truth, of some 20 MB a frame of 640 x 480."""


def kept_file(folder: Path, name: str, scene: Scene, variant: str) -> Path:
    """Return the file of a frame's truth: named by all that it depends on besides the packages."""
    key = f"{name} {variant} {provenance.source_hash()} {scene.model_dump_json()}"
    return folder / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.npz"


def keep_truth(path: Path, truth: FrameTruth, brightest_mm: float | None) -> None:
    """Write the truth at a frame's scored pixels, without loss, and its picture; `brightest_mm` is what it is told."""
    arrays = {
        "scored": truth.scored, "zone": truth.zone, "image": truth.image, "distance": truth.distance[truth.scored],
        "excluded": [truth.excluded[reason] for reason in EXCLUDED],
        "brightest_mm": np.nan if brightest_mm is None else brightest_mm,
    }  # fmt: skip
    for surface in SURFACES:
        arrays[f"normal_{surface}"] = truth.normal[surface][truth.scored]
        arrays[f"curvature_{surface}"] = truth.curvature[surface][truth.scored]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda part: write_arrays(part, {key: np.asarray(value) for key, value in arrays.items()}))


def read_truth(path: Path, name: str, scene: Scene, setting: str, swept: Mapping[str, object]) -> FrameTruth:
    """Return a kept truth of a frame of a scene; maps are NaN where nothing is scored."""
    try:
        # Opened here: NumPy leaves a damaged file open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            held = {key: file[key] for key in file.files}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: cannot be read ({error}); without its folder all is rendered again") from error
    scored, brightest = held["scored"], float(held["brightest_mm"])

    def whole(key: str) -> Array:
        full = np.full((*scored.shape, *held[key].shape[1:]), np.nan)
        full[scored] = held[key]
        return full

    calibration = scene.calibration(None if np.isnan(brightest) else brightest)
    return FrameTruth(
        name, calibration.camera, {surface: whole(f"normal_{surface}") for surface in SURFACES},
        {surface: whole(f"curvature_{surface}") for surface in SURFACES}, whole("distance"), _eps(scene), scored,
        dict(zip(EXCLUDED, held["excluded"].tolist(), strict=True)), held["zone"], held["image"], calibration, setting,
        dict(swept), scene.model_dump_json(),
    )  # fmt: skip


# Zones --------------------------------------------------------------------------------------------------------------

RINGS = (1.0, 2.0, 4.0)
"""Outer ends of the rings, as multiples of the highlight's radius, counted from the highlight's edge."""

ZONE_MEANINGS = {
    "all": "every scored pixel",
    "highlight": "visible highlights of the noise-free frame, down to half of each one's height",
    **{
        f"ring_{outer:g}": f"{inner:g} to {outer:g} radii outside a highlight's edge"
        for inner, outer in zip((0.0, *RINGS[:-1]), RINGS, strict=True)
    },
    "elsewhere": f"more than {RINGS[-1]:g} radii from every highlight",
}

ZONES = tuple(ZONE_MEANINGS)[1:]
"""Names of the zones, by number: at a highlight, in a ring around one, called by its outer end, or elsewhere."""


def zones(regions: IntArray) -> npt.NDArray[np.uint8]:
    """Return the zone of each pixel, shape (H, W): an index in `ZONES`.

    A highlight is the region of the spot above half its height, and its radius that of the circle of the same area. A
    pixel outside belongs to the innermost ring that any highlight has there.

    Parameters
    ----------
    regions : ndarray of int, shape (H, W)
        Number of the highlight whose pixel it is, from 1; 0 where there is none (`VisibleSpots.regions`).
    """
    # distance from each pixel to a highlight's edge over that one's radius, the least of all highlights
    nearness = np.full(regions.shape, np.inf)
    height, width = regions.shape
    for number in range(1, int(regions.max(initial=0)) + 1):
        inside = regions == number
        if not inside.any():
            continue
        radius = float(np.sqrt(inside.sum() / np.pi))
        # Only as far as the outermost ring reaches: a frame may hold hundreds of small highlights.
        reach = int(np.ceil(RINGS[-1] * radius)) + 2
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        top, bottom = max(rows[0] - reach, 0), min(rows[-1] + reach + 1, height)
        left, right = max(columns[0] - reach, 0), min(columns[-1] + reach + 1, width)
        window = np.where(inside[top:bottom, left:right], 0, 1).astype(np.uint8)
        # To the centre of the highlight's outermost pixel: its edge lies half a pixel nearer.
        away = (cv2.distanceTransform(window, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5) / radius
        view = nearness[top:bottom, left:right]
        np.minimum(view, away, out=view)
    numbers = np.searchsorted(RINGS, nearness, side="left") + 1
    return np.where(regions > 0, 0, numbers).astype(np.uint8)


# Cells --------------------------------------------------------------------------------------------------------------

BINS = {
    "d_k": (-np.inf, -1.0, -0.3, -0.1, 0.1, 0.3, 1.0, 3.0, np.inf),
    "eps_over_d": (0.0, 0.01, 0.03, 0.1, 0.3, np.inf),
    "distance_mm": (0.0, 5.0, 10.0, 20.0, 40.0, 80.0, np.inf),
}
"""Edges of the bins; a value on an edge lies in the bin above it.

d_k is the distance times the principal curvature of the larger size, of the surface that is scored."""

SCOPES = ("everywhere", "highlights")
"""Where the bins count: at all scored pixels, and at those of highlights alone."""


@dataclass(frozen=True)
class Cell:
    """A cell: its way of sorting (zone, d_k, ...), its label, and where it counts."""

    group: str
    label: str
    scope: str = "everywhere"


def _bin_names(edges: tuple[float, ...]) -> list[str]:
    inner = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(edges[1:-1])]
    return [f"< {edges[1]:g}", *inner, f">= {edges[-2]:g}"]


CELLS = (
    *(Cell("zone", name) for name in ZONE_MEANINGS),
    *(Cell(group, name, scope) for scope in SCOPES for group, edges in BINS.items() for name in _bin_names(edges)),
)
"""All cells, in the order of the figures."""


def cell_pixels(truth: FrameTruth, surface: str) -> list[tuple[int, IntArray]]:
    """Return the cells that hold scored pixels, by number in `CELLS`, with their places among the scored, in order.

    `surface` is the one of `SURFACES` against which is scored.
    """
    zone = truth.zone[truth.scored].astype(np.int64)
    distance = truth.distance[truth.scored]
    values = {
        "d_k": distance * truth.curvature[surface][truth.scored],
        "eps_over_d": truth.eps / distance,
        "distance_mm": distance,
    }
    in_cells = [np.zeros(len(zone), dtype=np.int64), 1 + zone]
    first = len(ZONE_MEANINGS)
    for scope in SCOPES:
        for group, edges in BINS.items():
            number = np.clip(np.searchsorted(edges, values[group], side="right") - 1, 0, len(edges) - 2)
            counts = np.isfinite(values[group]) & ((zone == ZONES.index("highlight")) | (scope == "everywhere"))
            in_cells.append(np.where(counts, first + number, -1))
            first += len(edges) - 1
    held = []
    for numbers in in_cells:
        # Short integers are sorted by counting.
        order = np.argsort(numbers.astype(np.int16), kind="stable")
        parts = np.split(order, np.cumsum(np.bincount(numbers + 1))[:-1])
        held += [(number - 1, part) for number, part in enumerate(parts) if number and len(part)]
    return held


# What is measured ---------------------------------------------------------------------------------------------------

ANGLE, DEPTH = "angle_deg", "depth_percent"
"""The angle between estimated and true normal, and the depth's error as a share of the distance."""

BELOW = {ANGLE: (5.0, 11.25, 22.5, 30.0), DEPTH: (1.0, 5.0, 10.0, 25.0)}
"""Thresholds below which the share of the pixels is reported."""

NORMAL = "normal"
SOURCE_MEANINGS = {
    NORMAL: "normal maps",
    "depth_none": "normals of the depth maps, as stated",
    "depth_scale": "normals of the depth maps, aligned by a factor a frame",
    "depth_affine": "normals of the depth maps, aligned by a factor and a shift a frame",
}
"""Sources of normals, and of distances where they are of depths."""

Key = tuple[str, str, str]
"""Source, quantity, surface."""


def depth_source(how: str) -> str:
    """Return the name of the source of normals and depths that an alignment gives."""
    return f"depth_{how}"

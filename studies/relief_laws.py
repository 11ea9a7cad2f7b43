"""Measure the laws of glints on relief: python -m studies.relief_laws [PART]... [--scale S].

Parts, default all: `normals` (the glints' normals against the base's, theory.md 7.4), `numbers` (7.2), `clouds` (7.1),
`sizes` (7.3), `shown` (7.4 of isolated and visible highlights), `search` (the search for glints
against an exhaustive one). S scales the number of glints that are wanted; 1 is that of the tables. Every frame has a
relief of its own.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from simtest.geometry.vectors import first_of_each
from simtest.rendering import Session, highlights
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import key
from simtest.simulation.frame import render_view
from simtest.spec.scene import scene_from_dict
from simtest.validation import laws

CURVED = {"plane": 0.0, "kd = 1": 1.0, "kd = -0.5": -0.5, "kd = 2": 2.0}
"""Distance times curvature across the axis of a cylinder."""

WANTED = 3200
"""Glints of each case of `normals`."""

POOLED = 10_500
"""Glints of each case of `clouds`."""

BOOTSTRAPS = 400


@dataclass(frozen=True)
class Case:
    """Where glints are counted: a plane or a cylinder that faces the camera.

    `surface`: key of `CURVED`; `slope_deg`, `wavelength_mm`: of one gaussian band; `distance_mm`: of the anchor;
    `tilt_deg`: of the surface.
    """

    surface: str
    slope_deg: float
    wavelength_mm: float
    distance_mm: float = 20.0
    tilt_deg: float = 0.0

    @property
    def kd(self) -> float:
        """Distance times curvature across the cylinder's axis."""
        return CURVED[self.surface]

    @property
    def gains(self) -> laws.Gains:
        """1 + d k along both principal directions."""
        return 1 + self.kd, 1.0

    @property
    def slope(self) -> float:
        """Standard deviation of the slope along one axis, rad."""
        return float(np.radians(self.slope_deg))

    def scene(self, seed: int, **more: object) -> dict[str, object]:
        """Return the scene with the relief of a seed; `more` are further tables."""
        placed = {"distance_mm": self.distance_mm, "tilt_deg": self.tilt_deg}
        band = {"slope_deg": self.slope_deg, "wavelength_mm": self.wavelength_mm}
        surface: dict[str, object] = {"type": "plane", **placed, "relief": {"bands": [band], "seed": seed}}
        if self.kd:
            side = "outside" if self.kd > 0 else "inside"
            surface |= {"type": "cylinder", "radius_mm": abs(self.distance_mm / self.kd), "side": side}
        camera = {"width": 640, "height": 560, "fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 280.0}
        return {"surface": surface, "camera": camera, **more}


def frames(case: Case, **more: object) -> Iterator[Session]:
    """Yield a session at frame after frame of a case, each with another relief; no two cases share one."""
    session = None
    first = key(repr(case)) % 2**31
    for seed in range(first, first + 100_000):
        scene = scene_from_dict(case.scene(seed, **more))
        if session is None:
            session = Session(scene)
        session.update(scene)
        yield session


@dataclass(frozen=True)
class Glints:
    """Glints of one frame: angle between fine and base normal, rad, and position on the tangent plane, mm."""

    angle: Array
    position: Array


def glints_of(session: Session) -> Glints:
    """Find the glints of a frame of the first light."""
    pixels = highlights.find_zeros(session, True)[0]
    points = session.exact_points(pixels)
    cosine = np.clip(np.sum(points.normal * points.normal_base, axis=1), -1, 1)
    pose = session.surface.model_from_camera
    position = points.position @ pose[:3, :3].T + pose[:3, 3]
    return Glints(np.arccos(cosine), position[:, :2])


def collect(case: Case, wanted: int) -> list[Glints]:
    """Collect frames until they hold so many glints."""
    found: list[Glints] = []
    for session in frames(case):
        found.append(glints_of(session))
        if sum(len(frame.angle) for frame in found) >= wanted:
            return found
    raise AssertionError("unreachable")


# Normals ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NormalRow:
    """How the glints' normals of one case stand to the law, with 95 % intervals by bootstrap over frames."""

    glints: int
    frames: int
    ratio: float
    ratio_interval: tuple[float, float]
    distance: float
    distance_interval: tuple[float, float]


def normals(case: Case, wanted: int) -> NormalRow:
    """Compare the glints' angles to the base normal with Rayleigh's law (7.4)."""
    found = collect(case, wanted)
    rng = np.random.default_rng(7)
    samples = [found, *([found[i] for i in rng.integers(0, len(found), len(found))] for _ in range(BOOTSTRAPS))]
    figures = []
    for sample in samples:
        angle = np.sort(np.concatenate([frame.angle for frame in sample]))
        share = laws.relief_error_share(angle, case.slope)
        n = np.arange(len(angle))
        gap = max(np.max((n + 1) / len(angle) - share), np.max(share - n / len(angle)))
        figures.append((angle.mean() / laws.relief_error(case.slope), gap))
    low, high = np.quantile(figures[1:], [0.025, 0.975], axis=0)
    total = sum(len(frame.angle) for frame in found)
    (ratio, gap), ends = figures[0], list(zip(low.tolist(), high.tolist(), strict=True))
    return NormalRow(total, len(found), float(ratio), ends[0], float(gap), ends[1])


def print_normals(scale: float) -> None:
    """Print the table of normals."""
    print("normals: one glint against the base normal (theory.md 7.4); wavelength 0.5 mm, 20 mm")
    print("slope  surface     glints frames  mean/1.25 s            KS distance to Rayleigh")
    for slope, surface in product((2.0, 4.0, 6.0), CURVED):
        row = normals(Case(surface, slope, 0.5), int(WANTED * scale))
        (a, b), (c, d) = row.ratio_interval, row.distance_interval
        print(
            f"{slope:4.0f}   {surface:10s} {row.glints:6d} {row.frames:5d}   {row.ratio:.3f} ({a:.3f} to {b:.3f})"
            f"   {row.distance:.3f} ({c:.3f} to {d:.3f})",
            flush=True,
        )


# Numbers ---------------------------------------------------------------------------------------------------------

COUNTED = (
    (10, 1.0, 2), (10, 1.0, 6), (10, 2.0, 4), (10, 3.0, 6), (20, 1.0, 4), (20, 1.5, 2), (20, 1.5, 6), (20, 3.0, 2),
    (20, 3.0, 6), (40, 1.0, 2), (40, 2.0, 4), (40, 3.0, 2), (40, 3.0, 6), (40, 1.0, 6),
)  # fmt: skip
"""Distance, mm, wavelength, mm, slope, deg."""


def count(case: Case, wanted: int, least_frames: int = 12) -> tuple[float, float, float, int]:
    """Return the mean number of glints, its standard error, the law's, and the number of frames."""
    numbers: list[int] = []
    for session in frames(case):
        numbers.append(len(highlights.find_zeros(session, True)[0]))
        if sum(numbers) >= wanted and len(numbers) >= least_frames:
            break
    expected = laws.glint_count(case.slope, case.wavelength_mm, case.distance_mm, case.gains)
    return float(np.mean(numbers)), float(np.std(numbers, ddof=1) / np.sqrt(len(numbers))), expected, len(numbers)


def print_numbers(scale: float) -> None:
    """Print the table of numbers."""
    print("numbers: glints of a cloud (theory.md 7.2), plane, and cylinders at 20 mm")
    print("distance wavelength slope  surface     frames  mean number    law     ratio")
    cases = [Case("plane", s, w, d) for d, w, s in COUNTED]
    cases += [Case(surface, 4.0, 1.5) for surface in CURVED if surface != "plane"]
    for case in cases:
        mean, error, expected, number = count(case, int(600 * scale))
        where = f"{case.distance_mm:6.0f}  {case.wavelength_mm:8.1f}  {case.slope_deg:6.0f}   {case.surface:10s}"
        counted = f"{number:5d}  {mean:7.2f} +- {error:5.2f} {expected:7.2f}"
        print(f"{where} {counted}  {mean / expected:.3f} +- {error / expected:.3f}", flush=True)


# Clouds ----------------------------------------------------------------------------------------------------------


def cloud(case: Case, wanted: int) -> tuple[Array, Array, float, int]:
    """Return the pooled cloud's centroid from the base's BP, mm, its standard error, its axis ratio, and the glints.

    Positions are in the base's tangent plane; frames, not glints, are independent.
    """
    found = [frame for frame in collect(case, wanted) if len(frame.angle)]
    points = np.concatenate([frame.position for frame in found])
    # Influence of each frame on the ratio of sums.
    mean = points.mean(axis=0)
    parts = np.array([np.sum(frame.position - mean, axis=0) for frame in found])
    error = np.sqrt(np.sum(parts**2, axis=0)) / len(points)
    spread = np.sqrt(np.linalg.eigvalsh(np.cov(points.T)))
    return mean, error, float(spread[0] / spread[1]), len(points)


def print_clouds(scale: float) -> None:
    """Print the table of clouds."""
    print("clouds: centroid from the base's BP and axis ratio (theory.md 7.1); wavelength 0.5 mm, 20 mm")
    print("slope  surface     glints   centroid x, y, standard errors   axis ratio  law    ratio")
    for slope, surface in product((2.0, 4.0), CURVED):
        case = Case(surface, slope, 0.5)
        mean, error, ratio, number = cloud(case, int(POOLED * scale))
        z, law = mean / error, laws.cloud_axis_ratio(case.gains)
        print(
            f"{slope:4.0f}   {surface:10s} {number:6d}   {z[0]:+.2f}, {z[1]:+.2f}     {ratio:.4f}  {law:.4f}"
            f"  {ratio / law:.3f}",
            flush=True,
        )


# Sizes -----------------------------------------------------------------------------------------------------------


def sizes(case: Case, wanted: int, exponent: float = 4000.0) -> tuple[Array, int]:
    """Return the areas' radii of rendered single-glint highlights over those of (7.3), and the number of frames."""
    ratios: list[float] = []
    more = {"reflectance": {"type": "phong", "exponent": exponent}, "render": {"samples_per_pixel": 4}}
    for number, session in enumerate(frames(case, **more), 1):
        view = render_view(session, session.scene)
        for spot in view.visible_highlights:
            if len(spot.glints) == 1 and spot.whole:
                ratios.append(spot.radius_px / view.highlights[spot.glints[0]].radius_px)
        if len(ratios) >= wanted:
            return np.array(ratios), number
    raise AssertionError("unreachable")


def print_sizes(scale: float) -> None:
    """Print the table of sizes."""
    print("sizes: radius of the area above half height of highlights with one glint, over (7.3); Phong, exponent 4000")
    print("slope  wavelength  surface     highlights  median  10 to 90 %")
    for slope, wave, surface in ((2.0, 3.0, "plane"), (4.0, 3.0, "plane"), (6.0, 3.0, "plane"), (4.0, 3.0, "kd = 1")):
        ratios, _ = sizes(Case(surface, slope, wave, 10.0), int(150 * scale))
        low, median, high = np.quantile(ratios, [0.1, 0.5, 0.9])
        figures = f"{median:.3f}   {low:.2f} to {high:.2f}"
        print(f"{slope:4.0f}   {wave:6.1f}      {surface:10s} {len(ratios):7d}     {figures}", flush=True)


# Isolated and visible highlights -----------------------------------------------------------------------------------


def shown(case: Case, wanted: int) -> dict[str, list[float]]:
    """Return angles to the base normal, rad, over 1.25 s: of all glints, of isolated ones, and at visible peaks."""
    angles: dict[str, list[float]] = {"glints": [], "isolated": [], "visible": []}
    more = {
        "reflectance": {"type": "phong", "exponent": 400.0},
        "sensor": {"noise_sigma": 0.01, "point_spread_px": 0.7},
        "render": {"samples_per_pixel": 4},
    }
    law = float(laws.relief_error(case.slope))
    for session in frames(case, **more):
        view = render_view(session, session.scene)
        for glint in view.highlights:
            off = float(np.arccos(np.clip(glint.normal @ glint.normal_base, -1, 1))) / law
            angles["glints"].append(off)
            if glint.isolated:
                angles["isolated"].append(off)
        peaks = [spot.peak_px for spot in view.visible_highlights if spot.peak_snr >= 10]
        if peaks:
            # Someone who takes the sightline of the peak for the normal, as a scanned model would judge it.
            base = session.exact_points(np.array(peaks))
            cosine = -np.sum(base.normal_base * session.camera.unproject(np.array(peaks)), axis=1)
            angles["visible"] += (np.arccos(np.clip(cosine, -1, 1)) / law).tolist()
        if len(angles["isolated"]) >= wanted:
            return angles
    raise AssertionError("unreachable")


def print_shown(scale: float) -> None:
    """Print the table of isolated and visible highlights."""
    print("shown: mean angle to the base normal over 1.25 s; plane, 20 mm, wavelength 1.5 mm, Phong exponent 400")
    print("slope   glints (n)      isolated (n)     visible (n)")
    for slope in (2.0, 4.0, 6.0):
        angles = shown(Case("plane", slope, 1.5), int(60 * scale))
        print(f"{slope:4.0f}   " + "   ".join(f"{np.mean(a):.2f} ({len(a)})" for a in angles.values()), flush=True)


# Search ----------------------------------------------------------------------------------------------------------

SEARCHED: dict[str, dict[str, object]] = {
    "plane": {"type": "plane", "distance_mm": 20, "tilt_deg": 25},
    "cylinder": {"type": "cylinder", "distance_mm": 20, "radius_mm": 40, "side": "inside"},
    "colon": {"type": "anatomy", "path": "colon"},
    "liver": {"type": "anatomy", "path": "liver"},
}
FINER, BLOCK_PX = 10, 40
"""How many times finer the exhaustive grid is along each axis, and the side of the blocks in which it is traced, px."""

SAME_PX = 0.05


def exhaustive(session: Session) -> Array:
    """Return the glints, px, that start from every cell of the finer grid in which the misfit may have a zero."""
    camera = session.camera
    rows, columns = np.mgrid[0 : camera.height : BLOCK_PX, 0 : camera.width : BLOCK_PX]
    blocks = np.stack([columns.ravel(), rows.ravel()], axis=1)
    w = session.tile_misfits(np.zeros(len(blocks), dtype=int), FINER, blocks, BLOCK_PX)
    corners = np.stack([w[..., :-1, :-1], w[..., 1:, :-1], w[..., :-1, 1:], w[..., 1:, 1:]])
    with np.errstate(invalid="ignore"):
        may = ((corners.min(axis=0) <= 0) & (corners.max(axis=0) >= 0)).all(axis=0)
    own, below, right = np.nonzero(may)
    seeds = blocks[own] + np.stack([right, below], axis=1) / FINER
    found, _ = highlights.refine(session, seeds, np.zeros(len(seeds), dtype=np.int64), True)
    found = found[session.camera.contains(found)]
    return found[first_of_each(found, highlights.SAME_PX["fine"])]


def search(name: str, seed: int, slope_deg: float, wavelength_mm: float) -> tuple[int, int, float]:
    """Return the number of exhaustive glints, how many of them the search finds, and its largest misfit, rad."""
    relief = {"bands": [{"slope_deg": slope_deg, "wavelength_mm": wavelength_mm}], "seed": seed}
    camera = {"width": 320, "height": 240, "fx": 300.0, "fy": 300.0, "cx": 160.0, "cy": 120.0}
    session = Session(scene_from_dict({"surface": {**SEARCHED[name], "relief": relief}, "camera": camera}))
    found, whole = highlights.find_zeros(session, True)[0], exhaustive(session)
    if not len(found):
        return len(whole), 0, 0.0
    near = cKDTree(found).query(whole)[0] < SAME_PX if len(whole) else np.empty(0)
    misfit = highlights.exact_misfit(session, found, session.scene.rig.true_mm()[0]).length.max()
    return len(whole), int(np.sum(near)), float(misfit)


def print_search(scale: float) -> None:
    """Print the table of the search."""
    print("search: glints of an exhaustive search, on a grid ten times finer, that the search finds")
    print("surface     exhaustive  found   share    largest abs(tau), rad")
    for name in SEARCHED:
        rows = [
            search(name, seed, slope, wave)
            for seed in range(max(1, int(2 * scale)))
            for slope, wave in ((3.0, 1.0), (5.0, 1.5), (6.0, 0.7))
        ]
        whole, found = sum(r[0] for r in rows), sum(r[1] for r in rows)
        print(f"{name:10s} {whole:8d} {found:8d}   {found / whole:.4f}   {max(r[2] for r in rows):.1e}", flush=True)


PARTS = {
    "normals": print_normals, "numbers": print_numbers, "clouds": print_clouds, "sizes": print_sizes,
    "shown": print_shown, "search": print_search,
}  # fmt: skip


def main(arguments: list[str]) -> None:
    """Print the tables that are asked for."""
    scale = 1.0
    if "--scale" in arguments:
        at = arguments.index("--scale")
        scale = float(arguments[at + 1])
        arguments = arguments[:at] + arguments[at + 2 :]
    for name in arguments or PARTS:
        PARTS[name](scale)


if __name__ == "__main__":
    main(sys.argv[1:])

"""The albedo of tissue at points of a surface: ground, mottling, capillaries and vessels.

    albedo_c = base_c exp(-a_c g - b_c n) V_c(artery) V_c(vein),    V_c = 1 - s_c (1 - exp(-mu_c L))

for each channel c. g is the mottling, a periodic random field of space of unit deviation; n the capillaries' net, from
0 to 1; a_c and b_c follow the root of blood's absorption, as the reflectance of a scattering medium does. L is the
chord through a vessel (Beer and Lambert), mu_c the absorption of its blood, and s_c = exp(-depth / reach_c) the share
of the light that comes back from below the vessel's depth. Red reaches deepest: below, vessels are bluish and blurred.
The kernel lays debris over it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy

from simtest.runtime.arrays import AnyArray, Array, kept
from simtest.spec.reflectance import TissueColour
from simtest.surfaces.model import SurfaceModel, remembered
from simtest.surfaces.relief_field import random_turn, shell_noise
from simtest.surfaces.vessels import (
    NO_VESSELS,
    PatternPatch,
    SegmentTable,
    grow_vessels,
    make_table,
    segments,
    surface_patch,
)

EXTINCTION = (
    # Red, 600 to 650 nm: wavelength, nm; HbO2 and Hb, 1/(cm mol/l)
    ((600, 3200.0, 14677.2), (610, 1506.0, 9443.6), (620, 942.0, 6509.6), (630, 610.0, 5148.8), (640, 442.0, 4345.2),
     (650, 368.0, 3750.12)),
    # Green, 510 to 570 nm
    ((510, 20035.2, 25773.6), (520, 24202.4, 31589.6), (530, 39956.8, 39036.4), (540, 53236.0, 46592.0),
     (550, 43016.0, 53412.0), (560, 32613.2, 53788.0), (570, 44496.0, 45072.0)),
    # Blue, 450 to 490 nm
    ((450, 62816.0, 103292.0), (460, 44480.0, 23388.8), (470, 33209.2, 16156.4), (480, 26629.2, 14550.0),
     (490, 23684.4, 16684.0)),
)  # fmt: skip
"""Molar extinction in the bands of the three channels."""

HAEMOGLOBIN_G_PER_L = 150.0
GRAM_PER_MOL = 64500.0

SOFT_TISSUE = (1.89, 1.3)
"""Reduced scattering a (lambda / 500 nm)^-b of soft tissue: a, 1/mm, and b."""

TISSUE_SATURATION = 0.7
"""Share of oxygenated haemoglobin in the ground: 0.72 in normal colon mucosa (Friedland et al. 2003), 0.67 (Wang et al.
2009); see docs/concepts/tissue.md."""


def blood_absorption(saturation: float) -> Array:
    """Return the absorption coefficient of whole blood, 1/mm, shape (3,), red, green and blue.

    mu_a = ln(10) (S e_HbO2 + (1 - S) e_Hb) c with the molar concentration c of haemoglobin, averaged over each band.
    """
    means = np.array([np.mean(np.array(band)[:, 1:], axis=0) for band in EXTINCTION])
    molar = means @ [saturation, 1 - saturation]
    return np.asarray(math.log(10) * molar * HAEMOGLOBIN_G_PER_L / GRAM_PER_MOL / 10)


def reach(blood: float) -> Array:
    """Return the length, mm, shape (3,), over which the light that comes back from below falls to 1/e.

    Half of the penetration depth 1 / sqrt(3 mu_a (mu_a + mu_s')) of diffuse light, since it goes down and up again.
    `blood` is the share of the tissue's volume that is blood.
    """
    wavelength = np.array([np.mean([row[0] for row in band]) for band in EXTINCTION])
    scattering = SOFT_TISSUE[0] * (wavelength / 500) ** -SOFT_TISSUE[1]
    absorption = blood * blood_absorption(TISSUE_SATURATION)
    return np.asarray(0.5 / np.sqrt(3 * absorption * (absorption + scattering)))


NODES = 64
"""Nodes of a lattice along each side, a power of two; its field repeats after as many."""

MOTTLING_NODES = 10.0
"""Nodes per mean wave of the mottling."""

MOTTLING_WIDTH = 0.6
"""Its relative width of the band of wave numbers: blotches of several sizes."""

MOTTLING_LIMIT = 3.0
"""Deviations beyond which the mottling is cut off."""

MESH_NODES = 8.0
"""Nodes across a mesh of the capillaries' net."""

WALL = 0.1
"""Half-width of a capillary over the width of a mesh."""

RAGGED, EDGE, LUMPS, LUMP_SCALE, BILE = 1.2, 0.15, 0.25, 5.0, np.array([0.12, 0.05, 1.0])
"""Of debris, by eye: power of the wave number by which its short waves are weaker; width of its edges, deviations;
deviation of the absorbance of stool's lumps, and how much smaller than its patches they are; bile's absorbance over
that in blue."""


@dataclass(frozen=True)
class Lattice:
    """A periodic field in space, linear between the nodes of a turned lattice."""

    lattice_from_model: Array  # (3, 3): nodes over mm
    values: Array  # (NODES, NODES, NODES): at the nodes

    def at(self, points: Array) -> Array:
        """Return the field at points, shape (N, 3), model frame, mm."""
        cells = points @ self.lattice_from_model.T
        return np.asarray(scipy.ndimage.map_coordinates(self.values, cells.T, order=1, mode="grid-wrap"))


@dataclass(frozen=True)
class DebrisPattern:
    """What lies on one surface's tissue: stool where a field f is above a level, bile where -f is above another.

    Each covers the share 1/2 + (f - level) / EDGE, from 0 to 1. Bile absorbs; stool hides, with an albedo of
    exp(-LUMPS f(LUMP_SCALE p)) times its colour.
    """

    field: Lattice
    numbers: Array  # (20,): turn, levels, 1 / EDGE, LUMPS, LUMP_SCALE, albedo of stool, absorbance of bile


@dataclass(frozen=True)
class TissuePattern:
    """The albedo of one surface's tissue."""

    base: Array  # (3,): albedo of the ground, linear RGB
    mottling: Lattice
    capillaries: Lattice
    # mottled, netted: (3,): absorbances a_c and b_c for a unit of them
    mottled: Array
    netted: Array
    absorption: Array  # (2, 3): of the blood of arteries and veins, 1/mm
    # share, fall: (3,): s_c = share exp(-fall depth); fall is 0, and share has the depth, where all vessels have one
    share: Array
    fall: Array
    vessels: SegmentTable
    debris: DebrisPattern | None = None

    def albedo(self, points: Array) -> Array:
        """Return the albedo below debris at points, model frame, mm, linear RGB; the kernel's slow reference."""
        field, net = self.mottling.at(points), self.capillaries.at(points)
        value = self.base * np.exp(-field[:, None] * self.mottled - net[:, None] * self.netted)
        chords, depths = self.vessels.seen(points)
        for kind in range(2):
            share = self.share * np.exp(-self.fall * depths[:, kind, None])
            value = value * (1 - share * -np.expm1(-chords[:, kind, None] * self.absorption[kind]))
        return np.asarray(np.clip(value, 0, 1))


_NESTED: dict[str, Any] = {"mottling": Lattice, "capillaries": Lattice, "vessels": SegmentTable}
"""Fields of a pattern that are records themselves."""


def make_pattern(surface: SurfaceModel, spec: TissueColour) -> TissuePattern:
    """Make the pattern of a surface; the last few are cached."""
    # Mottling and capillaries fill space: without visible vessels all surfaces have the same pattern.
    return _make(surface_patch(surface) if spec.vessels.strength else None, spec)


def _debris(spec: TissueColour) -> DebrisPattern:
    """Draw what lies on tissue; of space its shares are exact."""
    assert spec.debris is not None
    told, k0 = spec.debris, 2 * np.pi / MOTTLING_NODES
    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(spec.seed).spawn(4)[3]))
    values = _float32(shell_noise(rng, NODES, lambda k: np.maximum(k / k0, 1) ** -RAGGED))
    shares = ((values, told.stool), (-values, told.bile))
    levels = [np.quantile(field, 1 - share) if share else np.inf for field, share in shares]
    turn = random_turn(rng) * (MOTTLING_NODES / told.size_mm)
    kinds = (*told.stool_colour, *(told.bile_absorbance * BILE))
    return DebrisPattern(Lattice(turn, values), np.array([*turn.flat, *levels, 1 / EDGE, LUMPS, LUMP_SCALE, *kinds]))


@remembered
def _make(patch: PatternPatch | None, spec: TissueColour) -> TissuePattern:
    if spec.debris is not None:
        bare = _make(patch, spec.model_copy(update={"debris": None}))
        return replace(bare, debris=_debris(spec)) if spec.debris.stool or spec.debris.bile else bare
    if patch is None:
        return _pattern(spec, NO_VESSELS)
    return _unpacked(kept("tissue", f"{patch.key} {spec.model_dump_json()}", lambda: _packed(_grown(patch, spec))))


def _packed(pattern: TissuePattern) -> dict[str, AnyArray]:
    """Return a pattern as arrays by name."""
    arrays: dict[str, Any] = {}
    # Debris, the last, is drawn anew.
    for name, value in list(vars(pattern).items())[:-1]:
        arrays |= {f"{name}.{part}": each for part, each in vars(value).items()} if name in _NESTED else {name: value}
    return {name: np.asarray(value) for name, value in arrays.items()}


def _unpacked(arrays: Mapping[str, AnyArray]) -> TissuePattern:
    """Return the pattern of `_packed`."""
    values: dict[str, Any] = {name: array for name, array in arrays.items() if "." not in name}
    for name, kind in _NESTED.items():
        parts = [arrays[f"{name}.{part.name}"] for part in fields(kind)]
        values[name] = kind(*(part if part.ndim else float(part) for part in parts))
    return TissuePattern(**values)


def _grown(patch: PatternPatch, spec: TissueColour) -> TissuePattern:
    """Make the pattern of a patch."""
    grow = np.random.SeedSequence(spec.seed).spawn(3)[2]
    vessels = spec.vessels
    pieces = segments(grow_vessels(patch, vessels, int(grow.generate_state(1)[0])))
    depth: Array | float = vessels.depth_mm
    if vessels.deepest_mm is not None:
        # Large ones lie in the submucosa, twigs in the mucosa above.
        calibre = (2 * pieces.radius - vessels.smallest_mm) / (vessels.largest_mm - vessels.smallest_mm)
        depth = depth + (vessels.deepest_mm - depth) * calibre.clip(0, 1)
    return _pattern(spec, make_table(pieces, depth, np.array(patch.half_mm)))


def _pattern(spec: TissueColour, table: SegmentTable) -> TissuePattern:
    """Make the pattern with the vessels of a table."""
    net, mottle, _ = np.random.SeedSequence(spec.seed).spawn(3)
    blood = blood_absorption(TISSUE_SATURATION)
    # Relative to green
    root = np.sqrt(blood / blood[1])
    vessels, depth_reach = spec.vessels, reach(spec.blood)
    at_one_depth = vessels.deepest_mm is None
    saturation = (vessels.arterial_saturation, vessels.venous_saturation)
    return TissuePattern(
        base=np.array(spec.base),
        mottling=_mottling(spec.mottling.wavelength_mm, np.random.Generator(np.random.SFC64(mottle))),
        capillaries=_net(spec.capillaries.spacing_mm, np.random.Generator(np.random.SFC64(net))),
        mottled=spec.mottling.amplitude * root,
        netted=spec.capillaries.strength * root,
        absorption=vessels.strength * np.stack([blood_absorption(s) for s in saturation]),
        share=np.exp(-vessels.depth_mm / depth_reach) if at_one_depth else np.ones(3),
        fall=np.zeros(3) if at_one_depth else 1 / depth_reach,
        vessels=table,
    )


def _mottling(wavelength: float, rng: np.random.Generator) -> Lattice:
    """Draw a gaussian field of unit deviation, with power on a shell of wave numbers."""
    k0 = 2 * np.pi / MOTTLING_NODES
    field = shell_noise(rng, NODES, lambda k: np.exp(-(((k / k0 - 1) / MOTTLING_WIDTH) ** 2) / 4))
    field = np.clip(field, -MOTTLING_LIMIT, MOTTLING_LIMIT)
    return Lattice(random_turn(rng) * (MOTTLING_NODES / wavelength), _float32(field))


def _net(spacing: float, rng: np.random.Generator) -> Lattice:
    """Make walls between the cells about random points of space; a surface cuts them in a net of polygons."""
    side = NODES / MESH_NODES
    centres = _apart(rng, side)
    grid = np.stack(np.meshgrid(*[np.arange(NODES) / MESH_NODES] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, nearest = scipy.spatial.cKDTree(centres, boxsize=side).query(grid, k=2)
    apart = centres[nearest[:, 0]] - centres[nearest[:, 1]]
    apart -= side * np.round(apart / side)
    # Distance to the plane halfway between the two nearest centres
    to_wall = (distance[:, 1] ** 2 - distance[:, 0] ** 2) / (2 * np.linalg.norm(apart, axis=1))
    wall = np.exp(-((to_wall / WALL) ** 2)).reshape((NODES,) * 3)
    return Lattice(random_turn(rng) * (MESH_NODES / spacing), _float32(wall))


def _apart(rng: np.random.Generator, side: float) -> Array:
    """Draw points of a periodic box, about one in a unit volume, that keep apart."""
    centres = rng.uniform(0, side, (round(side**3), 3))
    for _ in range(8):
        # Each moves away from its nearest neighbour.
        distance, other = scipy.spatial.cKDTree(centres, boxsize=side).query(centres, k=2)
        gap = centres - centres[other[:, 1]]
        gap -= side * np.round(gap / side)
        push = np.clip(0.9 - distance[:, 1], 0, None) / (2 * distance[:, 1])
        centres = (centres + push[:, None] * gap) % side
    return centres


def _float32(values: Array) -> Array:
    """Round to single precision, in which the renderer holds them."""
    return np.asarray(values.astype(np.float32), dtype=np.float64)

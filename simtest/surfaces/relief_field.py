"""The relief of a surface: a random height field in space, with exact gradient and Hessian (theory.md section 7).

Each band is a periodic cubic B-spline on a turned lattice. A cubic B-spline has continuous second derivatives, so the
normal and the curvature of the relief are closed forms everywhere, and a renderer can gather the same coefficients.
The lattice fills space, so the field has no seams on any surface, and is stationary on all of them.

The relief turns the normal and leaves the position: the fine normal at the base point P is N - grad h, normalised, with
the gradient along the surface. A film may fill the valleys up to a level: pools are smooth, crests keep their relief.
The level itself may be such a field, of long waves: patches of deep film, and of dry ground where it is low.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from simtest.geometry.vectors import projector, tangent_basis, unit
from simtest.runtime.arrays import AnyArray, Array, kept
from simtest.spec.reflectance import Patches
from simtest.spec.surfaces import Relief, ReliefBand
from simtest.surfaces.jets import Jet
from simtest.surfaces.model import SurfacePoints, in_rows, outer, principal, remembered, shape_operator

NODES = 96
"""Nodes of the lattice along each side; the field repeats after as many."""

NODES_PER_WAVE = 6.0
"""Nodes per mean wave: the spline then follows the field to about 1 %, and its own moments are measured."""

PROBES = 100_000
"""Random points at which slope, wavelength and height of a field are measured."""

POINTS = 2**12
"""Points whose jets are computed together, so that the processor's cache holds them."""

RIDGE_ROUNDING = 0.35
"""Half-width of a rounded crest, in standard deviations of the field: -sqrt(g^2 + rounding^2)."""

PIT_THRESHOLD = 0.6
"""Height above which the field becomes a pit, in its standard deviations: -max(g - threshold, 0)^2."""

KIND_SMOOTHING = 0.08
"""Smoothing of ridged and pitted fields, waves: their crests must be wider than a cell of the lattice."""

UNSEEN = 0.01
"""A diffused field below this share of the whole field's deviation is left out: less than 0.1 deg of 6."""

FELT = 0.1
"""A band of less than this share of the whole slope hardly moves a glint: the search need not resolve its waves."""

MENISCUS = 0.1
"""Width of a pool's rim, where the film's surface bends from the pool to the crest, in deviations of the height."""

DRYING = 0.5
"""Width of the rim of dry ground, where its roughness changes to the film's, in deviations of the height."""

PATCH_WIDTH = 0.5
"""Relative width of the band of wave numbers of the film's level: patches of many sizes."""

PATCH_BRANCH = 4
"""Of the relief's seed: its bands, at most four, have the branches before."""


@dataclass(frozen=True)
class BandField:
    """One band: a periodic cubic B-spline."""

    lattice_from_model: Array  # (3, 3): lattice cells over mm
    coefficients: Array  # (NODES, NODES, NODES): of the B-splines, mm
    diffused: Array  # (NODES, NODES, NODES): those of the field that diffuse light sees

    @cached_property
    def is_seen_diffusely(self) -> bool:
        """Whether diffuse light sees anything of the band."""
        return bool(self.diffused.any())

    def jets(self, points: Array, diffused: bool = False) -> Jet:
        """Compute the height, mm, and its derivatives at points, shape (N, 3), model frame, mm."""
        A = self.lattice_from_model
        cells = np.ascontiguousarray((points @ A.T).T)
        first = np.floor(cells)
        weights = _spline_weights(cells - first)
        index = (first.astype(np.int64)[:, None] + np.arange(-1, 3)[:, None]) % NODES
        nodes = (index[0][:, None, None] * NODES + index[1][:, None]) * NODES + index[2]
        values = (self.diffused if diffused else self.coefficients).ravel()[nodes]
        # Contract along z, y, x, for all orders of derivatives that are needed.
        along_z = [_contracted(values, weights[k][:, 2]) for k in range(3)]
        pairs = {(j, k): _contracted(along_z[k], weights[j][:, 1]) for j in range(3) for k in range(3 - j)}

        def derivative(i: int, j: int, k: int) -> Array:
            return _contracted(pairs[j, k], weights[i][:, 0])

        gradient = np.stack([derivative(1, 0, 0), derivative(0, 1, 0), derivative(0, 0, 1)], axis=1)
        xy, xz, yz = derivative(1, 1, 0), derivative(1, 0, 1), derivative(0, 1, 1)
        xx, yy, zz = derivative(2, 0, 0), derivative(0, 2, 0), derivative(0, 0, 2)
        hessian = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        # Chain rule to the model frame.
        return Jet(derivative(0, 0, 0), gradient @ A, A.T @ hessian @ A)


def _contracted(values: Array, weights: Array) -> Array:
    """Sum values, shape (..., 4, N), by the weights of four nodes, shape (4, N), in the order in which einsum does."""
    parts = values * weights
    return np.asarray((parts[..., 0, :] + parts[..., 2, :]) + (parts[..., 1, :] + parts[..., 3, :]))


def _spline_weights(t: Array) -> Array:
    """Return value, first and second derivative of the four cubic B-splines at shares t of a cell, (3, 4, *t.shape)."""
    one = 1 - t
    value = [one**3 / 6, 2 / 3 - t**2 + t**3 / 2, 2 / 3 - one**2 + one**3 / 2, t**3 / 6]
    first = [-(one**2) / 2, -2 * t + 1.5 * t**2, 2 * one - 1.5 * one**2, t**2 / 2]
    second = [one, 3 * t - 2, 3 * one - 2, t]
    return np.array([value, first, second])


@dataclass(frozen=True)
class ReliefField:
    """The relief of one surface."""

    bands: tuple[BandField, ...]  # Their heights add up
    deviation: float  # Standard deviation of the height, mm
    finest_wave: float  # Least wavelength of the bands that hold a share of the slope above `FELT`, mm
    level: float | None = None  # Height up to which a film fills the valleys, mm; None: it follows the relief
    patches: BandField | None = None  # What the level gains from place to place, mm; None: nothing
    dry_level: float = -np.inf  # Ground is dry where the level is below this, mm

    @property
    def meniscus(self) -> float:
        """Width of a pool's rim in height, mm."""
        return MENISCUS * self.deviation

    def tissue_jets(self, points: Array, diffused: bool = False) -> Jet:
        """Compute the jets of the tissue below the film at points, shape (N, 3), model frame, mm."""
        return self._summed(self.bands, points, diffused)

    def patch_jets(self, points: Array) -> Jet | None:
        """Compute the jets of what the film's level gains at points, shape (N, 3), mm; None where it is constant."""
        return None if self.patches is None else self._summed((self.patches,), points)

    @property
    def wetting(self) -> tuple[float, float]:
        """What the film's level gains where ground is half wet, mm, and over which width it dries."""
        assert self.level is not None
        return self.dry_level - self.level, DRYING * self.deviation

    def wet(self, points: Array) -> Array:
        """Compute the share by which ground is wet at points, shape (N, 3), model frame, mm."""
        patches = self.patch_jets(points)
        if patches is None:
            return np.ones(len(points))
        level, width = self.wetting
        return np.asarray(1 / (1 + np.exp((level - patches.value) / width)))

    def _summed(self, bands: tuple[BandField, ...], points: Array, diffused: bool = False) -> Jet:
        """Compute the jets of the sum of bands."""
        parts = [
            reduce(Jet.__add__, [band.jets(some, diffused) for band in bands])
            for some in np.split(points, range(POINTS, len(points), POINTS))
        ]
        return Jet(*(np.concatenate(blocks) for blocks in zip(*(jet.parts for jet in parts), strict=True)))

    def jets(self, points: Array) -> Jet:
        """Compute the jets of the surface that the film's reflection sees, at points, shape (N, 3), model frame, mm."""
        return self.fill(self.tissue_jets(points), self.patch_jets(points))

    def fill(self, tissue: Jet, patches: Jet | None = None) -> Jet:
        """Fill valleys: phi(h) = level + w log(1 + exp((h - level)/w)), with w the meniscus; and its derivatives.

        With patches the level is that of the field and what these gain on it.
        """
        if self.level is None:
            return tissue
        above = tissue if patches is None else tissue + patches.affine(-1.0)
        x = (above.value - self.level) / self.meniscus
        share = 1 / (1 + np.exp(-np.clip(x, -60.0, 60.0)))
        bend = share * (1 - share) / self.meniscus
        filled = above.chain(self.level + self.meniscus * np.logaddexp(0.0, x), share, bend)
        return filled if patches is None else filled + patches

    def apply(self, points: SurfacePoints) -> SurfacePoints:
        """Turn the normals and curvatures of base points, model frame, to those of the fine surface.

        The fine normal is n = m/|m| with m = N - (I - N N^T) G, G the gradient of the height; its derivative along a
        base tangent t is ((1 + N.G) S + N (G^T S + N^T H) - H) t / |m|, across n, with the base's S and the height's
        Hessian H. Curvatures are eigenvalues of its symmetric part on the surface that the relief makes.
        """
        valid = np.flatnonzero(points.valid)
        if not len(valid):
            return points
        position = points.position[valid]
        tissue, patches = self.tissue_jets(position), self.patch_jets(position)
        fine = fine_curvatures(points.normal[valid], shape_operator(points)[valid], self.fill(tissue, patches))
        names = ("normal", "k_min", "k_max", "direction_min", "direction_max")
        changed: dict[str, Any] = dict(zip(names, in_rows(len(points.valid), valid, *fine), strict=True))
        pool = np.zeros(len(points.valid), dtype=bool)
        if self.level is not None:
            pool[valid] = (tissue if patches is None else tissue + patches.affine(-1.0)).value < self.level
        return replace(points, **changed, pool=pool)


def normal_derivative(N: Array, S: Array, jets: Jet) -> tuple[Array, Array]:
    """Return fine normals and their derivative along the base's tangents (see `ReliefField.apply`)."""
    G, H = jets.gradient, jets.hessian
    along = np.sum(N * G, axis=1)
    m = N - G + N * along[:, None]
    length = np.linalg.norm(m, axis=1)
    normal = m / length[:, None]
    rest = np.einsum("ni,nij->nj", G, S) + np.einsum("ni,nij->nj", N, H)
    derivative = (1 + along)[:, None, None] * S + outer(N, rest) - H
    across = projector(normal)
    return normal, across @ derivative / length[:, None, None]


def fine_curvatures(N: Array, S: Array, jets: Jet) -> tuple[Array, ...]:
    """Return fine normals, principal curvatures k_min and k_max, and their unit directions."""
    normal, derivative = normal_derivative(N, S, jets)
    # A tangent f of the fine surface stands over the base's tangent f - N (N.f).
    tangents = tangent_basis(normal)
    below = [f - N * np.sum(N * f, axis=1, keepdims=True) for f in tangents]
    form = [[np.einsum("ni,nij,nj->n", f, derivative, t) for t in below] for f in tangents]
    mixed = (form[0][1] + form[1][0]) / 2
    mean, half, *directions = principal(form[0][0], mixed, form[1][1], tangents)
    return normal, mean - half, mean + half, *directions


# Making the field ------------------------------------------------------------------------------------------------


def make_relief(spec: Relief, level: float | None = None, patches: Patches | None = None) -> ReliefField:
    """Make the relief of a description; a film fills its valleys up to `level` deviations of the height.

    With patches the level varies about that.
    """
    field = _make_field(spec)
    if level is None:
        return field
    field = replace(field, level=level * field.deviation)
    if patches is None:
        return field
    # A relief of its own, of any slope: it is scaled to the deviation.
    seed = int(np.random.SeedSequence(spec.seed, spawn_key=(PATCH_BRANCH,)).generate_state(1)[0])
    slope = min(1.0, 15.0 / patches.wavelength_mm)  # long waves of 1 deg would be higher than a relief may be
    waves = ReliefBand(slope_deg=slope, wavelength_mm=patches.wavelength_mm, width=PATCH_WIDTH)
    own = _make_field(Relief(bands=(waves,), seed=seed))
    scale = patches.amplitude * field.deviation / own.deviation
    return replace(
        field,
        patches=replace(own.bands[0], coefficients=scale * own.bands[0].coefficients),
        dry_level=patches.dry_level * field.deviation,
        finest_wave=min(field.finest_wave, own.finest_wave),
    )


@remembered
def _make_field(spec: Relief) -> ReliefField:
    """Make the relief without a film, or read it."""
    arrays = kept("relief", spec.model_dump_json(), lambda: _packed(_drawn(spec)))
    parts = (arrays[part.name] for part in fields(BandField))
    bands = tuple(BandField(*band) for band in zip(*parts, strict=True))
    return ReliefField(bands, float(arrays["deviation"]), float(arrays["finest_wave"]))


def _packed(field: ReliefField) -> dict[str, AnyArray]:
    """Return a relief as arrays by name."""
    names = [part.name for part in fields(BandField)]
    bands = {name: np.stack([getattr(band, name) for band in field.bands]) for name in names}
    return {**bands, "deviation": np.array(field.deviation), "finest_wave": np.array(field.finest_wave)}


def _drawn(spec: Relief) -> ReliefField:
    """Draw the bands of a relief."""
    branches = np.random.SeedSequence(spec.seed).spawn(len(spec.bands))
    pairs = zip(spec.bands, branches, strict=True)
    bands = tuple(_make_band(band, branch, spec.diffusion_mm) for band, branch in pairs)
    # Bands are independent, and each has mean 0.
    deviation = float(np.sqrt(sum(np.var(_node_values(band.coefficients)) for band in bands)))
    whole = sum(band.slope_deg**2 for band in spec.bands)
    felt = [band.wavelength_mm for band in spec.bands if band.slope_deg**2 >= FELT**2 * whole]
    return ReliefField(bands, deviation, min(felt))


@remembered
def _unscaled(kind: str, width: float, entropy: int, spawn_key: tuple[int, ...]) -> tuple[Array, Array, float, float]:
    """Draw a band from a branch of the relief's seed; reliefs of one seed differ in their scales alone.

    Returns the turn of its lattice, the coefficients of its B-splines, and its slope and wavelength in cells.
    """
    # Imported here: slow to load, and smooth scenes have no relief.
    from scipy import ndimage

    rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy, spawn_key=spawn_key)))
    turn = random_turn(rng)
    # The shell's radius, for which sections have about NODES_PER_WAVE nodes a wave.
    w = width
    k0 = 2 * np.pi / NODES_PER_WAVE * np.sqrt(1.25 * (1 + w**2) / (1 + 6 * w**2 + 3 * w**4))
    nodes = shell_noise(rng, NODES, lambda k: np.exp(-(((k - k0) / (w * k0)) ** 2) / 4))
    if kind != "gaussian":
        # Crests and grooves, or pits
        rounded = (
            np.sqrt(nodes**2 + RIDGE_ROUNDING**2) if kind == "ridged" else np.maximum(nodes - PIT_THRESHOLD, 0) ** 2
        )
        nodes = ndimage.gaussian_filter(-rounded, KIND_SMOOTHING * NODES_PER_WAVE, mode="wrap")
        nodes = nodes - nodes.mean()
    coefficients = ndimage.spline_filter(nodes, order=3, mode="grid-wrap")
    # The spline's own slope and wavelength on a plane, in lattice cells.
    return turn, coefficients, *_plane_statistics(BandField(np.eye(3), coefficients, coefficients), rng)


def _make_band(spec: ReliefBand, branch: np.random.SeedSequence, diffusion_mm: float) -> BandField:
    """Scale a band to the slope and wavelength that are asked for."""
    assert isinstance(branch.entropy, int)
    key = tuple(branch.spawn_key)
    turn, unscaled, slope, wave = _unscaled(spec.kind, spec.width, branch.entropy, key)
    # Stretch along the direction, so that the wavelength there is longer and the slope lower.
    axis = np.array(spec.direction) / np.linalg.norm(spec.direction)
    stretch = np.eye(3) + (1 / spec.anisotropy - 1) * np.outer(axis, axis)
    lattice_from_model = (wave / spec.wavelength_mm) * turn @ stretch
    height = np.radians(spec.slope_deg) / slope * (spec.wavelength_mm / wave)
    coefficients = unscaled * height
    return BandField(lattice_from_model, coefficients, _diffused(coefficients, lattice_from_model, diffusion_mm))


def random_turn(rng: np.random.Generator) -> Array:
    """Draw a uniformly random rotation, shape (3, 3)."""
    from scipy.spatial.transform import Rotation

    # From a quaternion, as scipy changed the name of its generator's argument.
    return np.asarray(Rotation.from_quat(rng.standard_normal(4)).as_matrix())


def _wave_numbers(nodes: int) -> list[Array]:
    """Return the wave numbers of a periodic lattice, rad per cell, along its three axes, for `numpy.fft.rfftn`."""
    full: Array = np.asarray(2 * np.pi * np.fft.fftfreq(nodes), dtype=float)
    half: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(nodes), dtype=float)
    return [full[:, None, None], full[None, :, None], half[None, None, :]]


def shell_noise(rng: np.random.Generator, nodes: int, shell: Callable[[Array], Array]) -> Array:
    """Draw a gaussian field of unit deviation at the nodes of a periodic lattice.

    Its amplitude at a wave number k, rad per cell, is `shell` over k.
    """
    kx, ky, kz = _wave_numbers(nodes)
    k = np.sqrt(kx**2 + ky**2 + kz**2)
    with np.errstate(divide="ignore"):
        amplitude = np.where(k > 0, shell(k) / k, 0.0)
    noise = np.fft.rfftn(rng.standard_normal((nodes,) * 3))
    field = np.fft.irfftn(noise * amplitude, s=(nodes,) * 3, axes=(0, 1, 2))
    return np.asarray(field / field.std())


def _plane_statistics(field: BandField, rng: np.random.Generator) -> tuple[float, float]:
    """Measure the slope along one direction and the wavelength 2 pi sqrt(m2/m4) of a field's plane sections, cells.

    On sections of an isotropic field m2 = 2/3 E|grad h|^2 and m4 = 8/15 E(laplace h)^2; the slope is sqrt(m2/2).
    """
    relief = ReliefField((field,), 1.0, 1.0)
    jets = relief.tissue_jets(rng.uniform(0, NODES, (PROBES, 3)))
    normal = unit(rng.standard_normal((PROBES, 3)))
    # Not of the whole space: a shaped field is isotropic, but its sections' moments follow no closed form.
    along = np.einsum("ni,nij,nj->n", normal, jets.hessian, normal)
    laplace = np.trace(jets.hessian, axis1=1, axis2=2) - along
    gradient = jets.gradient - normal * np.sum(normal * jets.gradient, axis=1, keepdims=True)
    m2, m4 = np.mean(np.sum(gradient**2, axis=1)), np.mean(laplace**2)
    return float(np.sqrt(m2 / 2)), float(2 * np.pi * np.sqrt(m2 / m4))


def _diffused(coefficients: Array, lattice_from_model: Array, length: float) -> Array:
    """Smooth a field by a Gaussian of standard deviation `length`, mm, in the model frame."""
    kx, ky, kz = _wave_numbers(NODES)
    A = lattice_from_model
    # Wave numbers in the model frame are A^T k.
    squared = sum((A[0, i] * kx + A[1, i] * ky + A[2, i] * kz) ** 2 for i in range(3))
    damping = np.exp(-squared * length**2 / 2)
    smooth = np.fft.irfftn(np.fft.rfftn(coefficients) * damping, s=coefficients.shape, axes=(0, 1, 2))
    return np.asarray(smooth if smooth.std() > UNSEEN * coefficients.std() else np.zeros_like(smooth))


def _node_values(coefficients: Array) -> Array:
    """Return a spline's values at its nodes."""
    # Imported here: slow to load, and smooth scenes have no relief.
    from scipy import ndimage

    for axis in range(3):
        coefficients = ndimage.convolve1d(coefficients, [1 / 6, 4 / 6, 1 / 6], axis=axis, mode="wrap")
    return coefficients

"""Laws of wet tissue: relief, translucency and the law of glints, against statistics and formulas taken anew."""

import math
from typing import Any

import numpy as np

from simtest.geometry import Camera
from simtest.rendering import Session
from simtest.rendering.subsurface import spread, transfer
from simtest.runtime.arrays import Array, Mask
from simtest.simulation.frame import make_frame
from simtest.spec import scene_from_dict
from simtest.spec.reflectance import Translucency
from simtest.spec.surfaces import Relief
from simtest.surfaces import make_surface
from simtest.surfaces.relief_field import make_relief
from simtest.surfaces.tissue_pattern import make_pattern
from simtest.validation.laws import cloud_covariance, glint_count, relief_error
from tests.laws import by_hand
from tests.laws.law import Law, law

SLOPE_DEG, WAVE_MM = 5.0, 1.5
RELIEF: dict[str, Any] = {"bands": [{"slope_deg": SLOPE_DEG, "wavelength_mm": WAVE_MM}], "seed": 3}
POINTS = 12_000


def relief(session: Session) -> list[Law]:
    """Measure slope and wavelength of reliefs by differences of their heights, and the fine normals that one makes."""
    slope, wave = _section(RELIEF)
    # Bands are independent, so that their squared slopes add.
    both, _ = _section({**RELIEF, "bands": [*RELIEF["bands"], {"slope_deg": 4.0, "wavelength_mm": 3.0}]})
    about = "differences of heights on planes of all orientations; of a field of 16 waves a side"
    return [
        law("relief", "slope", "x", slope / SLOPE_DEG, 1.04, 0.96, POINTS, about),
        law("relief", "wavelength", "x", wave / WAVE_MM, 1.04, 0.96, POINTS, about),
        law("relief", "slope_of_two", "x", both / math.hypot(SLOPE_DEG, 4.0), 1.04, 0.96, POINTS, about),
        _fine_normals(session, "normal_off", {}),
        _fine_normals(session, "patches_normal_off", {"level": -0.5, "patches": {"wavelength_mm": 4.0}}),
    ]


def _section(described: dict[str, Any]) -> tuple[float, float]:
    """Measure a relief's slope along one direction, deg, and its wavelength 2 pi sqrt(m2/m4), mm, on planes."""
    field = make_relief(Relief.model_validate(described))
    rng = np.random.default_rng(50)
    points = rng.uniform(-20, 20, (POINTS, 3))
    # A plane through each point, of random orientation
    normal = rng.standard_normal((POINTS, 3))
    normal /= np.sqrt((normal**2).sum(axis=1, keepdims=True))
    first = np.cross(normal, np.roll(normal, 1, axis=1))
    first /= np.sqrt((first**2).sum(axis=1, keepdims=True))
    second = np.cross(normal, first)
    step = 0.02 * WAVE_MM

    def height(offset: Array) -> Array:
        return field.jets(points + offset).value

    here, sides = height(np.zeros(3)), [(height(step * axis), height(-step * axis)) for axis in (first, second)]
    slopes = [(a - b) / (2 * step) for a, b in sides]
    laplace = sum((a + b - 2 * here) / step**2 for a, b in sides)
    m2, m4 = float(np.mean(slopes[0] ** 2 + slopes[1] ** 2)), float(np.mean(laplace**2))
    return math.degrees(math.atan(math.sqrt(m2 / 2))), 2 * math.pi * math.sqrt(m2 / m4)


def _fine_normals(session: Session, quantity: str, film: dict[str, Any]) -> Law:
    """Compare the true fine normals of a plane with differences of the height along it, that of the film in pools."""
    camera = {"width": 40, "height": 40, "fx": 60.0, "fy": 60.0, "cx": 20.0, "cy": 20.0}
    surface = {"type": "plane", "distance_mm": 10.0, "relief": RELIEF}
    wet = {"type": "tissue", "film": {"index": 1.34, **film}}
    session.update(scene_from_dict({"surface": surface, "camera": camera, "reflectance": wet}, "law"))
    spec = session.scene
    truth, field = session.truth(), make_relief(Relief.model_validate(RELIEF), spec.film_level, spec.film_patches)
    points = truth.position[truth.mask]
    step = 2e-4

    def slope(axis: Array) -> Array:
        return (field.jets(session.to_model(points + step * axis)).value
                - field.jets(session.to_model(points - step * axis)).value) / (2 * step)  # fmt: skip

    x, y = slope(np.array([1.0, 0, 0])), slope(np.array([0, 1.0, 0]))
    # Height counts towards the camera, along -z: where it rises the normal leans back.
    normal = np.stack([-x, -y, -np.ones_like(x)], axis=-1)
    off = by_hand.angle_deg(truth.normal[truth.mask], normal).max()
    about = "a rise of the height turns the normal away from it; differences of 2e-4 mm"
    return law("relief", quantity, "deg", float(off), 1e-3, n=len(points), about=about)


def debris() -> list[Law]:
    """Compare what lies on the tissue of a plane with its field at the true points, and the light off it with Beer."""
    camera = {"width": 120, "height": 90, "fx": 90.0, "fy": 90.0}
    albedo: dict[str, Any] = {"vessels": {"strength": 0.0}, "seed": 4}
    lying = {"stool": 0.2, "bile": 0.3, "bile_absorbance": 1.2, "size_mm": 3.0}
    frames = {}
    for name, more in (("clean", {}), ("covered", {"debris": lying})):
        reflectance = {"type": "phong", "exponent": 4.0, "specular": 0.3, "albedo": albedo | more}
        described = {"surface": {"type": "plane", "distance_mm": 20.0}, "camera": camera, "reflectance": reflectance}
        frames[name] = make_frame(scene_from_dict(described, "law"))
    clean, covered = frames["clean"], frames["covered"]
    assert covered.covering is not None
    told = make_pattern(make_surface(covered.scene.surface), covered.scene.albedo).debris  # type: ignore[arg-type]
    assert told is not None
    # The field at the true points, by the lattice's own interpolation.
    pose = covered.world_from_camera
    points = covered.truth.position.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    field, (high, low) = told.field.at(points).reshape(covered.covering.shape), told.numbers[9:11]
    expected = np.where(field > high, 1, np.where(-field > low, 2, 0))
    wrong = float(np.mean(covered.covering != expected))
    # A control: one tenth of a millimetre aside the map is another.
    aside = told.field.at(points + np.array([0.1, 0.0, 0.0])).reshape(field.shape)
    seen_aside = np.mean((aside > high) != (field > high))
    # Beyond the edges: stool has no lobe, bile takes its share of the base's light, and clean tissue stays.
    inner = [field > high + 0.2, -field > low + 0.2, (field < high - 0.2) & (-field < low - 0.2)]
    off = [
        np.abs(covered.radiance.specular[inner[0]]).max() / clean.radiance.specular.max(),
        np.abs(covered.radiance.specular / clean.radiance.specular - 1)[~inner[0] & (field < high - 0.2)].max(),
        np.abs(covered.radiance.diffuse / clean.radiance.diffuse / np.exp([-0.144, -0.06, -1.2]) - 1)[inner[1]].max(),
        np.abs(covered.radiance.diffuse / clean.radiance.diffuse - 1)[inner[2]].max(),
    ]
    moved = max(np.abs(getattr(covered.truth, own) - getattr(clean.truth, own)).max() for own in ("normal", "k_max"))
    hidden = [point.hidden and not point.lit for point in covered.highlights]
    below = [covered.covering[int(point.bp_px[1]), int(point.bp_px[0])] == 1 for point in covered.highlights]
    return [
        law("debris", "covering_off", "", wrong, 2e-3, n=field.size, about="single precision decides at edges"),
        law(
            "debris",
            "aside",
            "",
            float(seen_aside),
            0.2,
            0.005,
            field.size,
            "a control: 0.1 mm aside the map is another",
        ),
        law(
            "debris", "stool_share", "x", float(np.mean(covered.covering == 1)) / 0.2, 1.5, 0.5, about="of a part of it"
        ),
        law("debris", "light_off", "", float(max(off)), 1e-4, n=field.size, about="no lobe on stool, exp(-a) on bile"),
        law("debris", "truth_moved", "", float(moved), 0.0, n=field.size, about="debris has no thickness"),
        law("debris", "hidden_off", "", float(np.mean(np.not_equal(hidden, below))), 0.0, n=len(below)),
    ]


def translucency() -> list[Law]:
    """Compare the spread of stripes below a plane with the diffusion approximation, written down by hand."""
    spec = Translucency.model_validate({"index": 1.0})
    waves = np.array([0.1, 0.4, 1.0, 3.0])
    off = max(
        np.abs(transfer(waves, s, a, n) - _transfer(waves, s, a, n)).max()
        for n in (1.0, 1.37) for s, a in zip(spec.scattering_per_mm, spec.absorption_per_mm, strict=True)
    )  # fmt: skip
    # Stripes across a plane that faces the camera, 20 px/mm in its middle
    size, distance, focal = 160, 20.0, 400.0
    camera = Camera(size, size, focal, focal, size / 2, size / 2)
    x, y = np.meshgrid(np.arange(size) + 0.5 - size / 2, np.arange(size) + 0.5 - size / 2)
    ray = np.sqrt(1 + (x / focal) ** 2 + (y / focal) ** 2)
    normal = np.broadcast_to([0.0, 0.0, -1.0], (size, size, 3))
    wave = 2 * math.pi / 2.0
    stripes = 1 + 0.5 * np.cos(wave * x * distance / focal)
    image = np.repeat(stripes[..., None], 3, axis=2).astype(np.float32)
    seen = spread(image, distance * ray, normal, camera, spec)
    middle = np.s_[40:120, 40:120]
    made = []
    for channel, name in enumerate(("red", "green", "blue")):
        contrast = 2 * np.mean((seen[..., channel] - 1) * np.cos(wave * x * distance / focal), where=_within(x, y))
        wanted = float(
            _transfer(np.array([wave]), spec.scattering_per_mm[channel], spec.absorption_per_mm[channel], 1.0)[0]
        )
        about = "contrast left to stripes of 2 mm; a sum of fitted Gaussians leaves 7 %"
        made.append(law("translucency", f"{name}_contrast", "x", 2 * float(contrast) / wanted, 1.12, 0.88, about=about))
    mean = float(seen[middle].mean() / image[middle].mean())
    return [
        law("translucency", "transfer_off", "", float(off), 1e-9, n=24, about="Cuccia 2009, by hand"),
        law("translucency", "mean", "x", mean, 1.01, 0.99, about="light spreads, none is lost"),
        *made,
    ]


def _within(x: Array, y: Array) -> Mask:
    """Return the middle two thirds, whose width is a whole number of stripes of 40 px."""
    return np.asarray((np.abs(x) < 40) & (np.abs(y) < 40))


def _transfer(wave: Array, scattering: float, absorption: float, index: float) -> Array:
    """Compute what is left of a wave in light scattered once, and in light that diffused [Cuccia 2009, eq. 8]."""
    total = scattering + absorption

    def diffused(k: Array | float, n: float) -> Array:
        inside = 0.0636 * n + 0.668 + 0.710 / n - 1.440 / n**2 if n > 1 else 0.0
        ratio = np.sqrt(3 * absorption * total + np.square(k)) / total
        a = (1 - inside) / (2 * (1 + inside))
        return np.asarray(3 * a * scattering / total / ((ratio + 1) * (ratio + 3 * a)))

    # Chandrasekhar's H at 1 of isotropic scattering, by Hapke
    single = ((1 + 2 * math.sqrt(absorption / total)) / 3) ** 2
    share = min(1.0, single * float(diffused(0.0, 1.0) / diffused(0.0, index)) / index**2)
    return np.asarray(share + (1 - share) * diffused(wave, index) / diffused(0.0, index))


def glints() -> list[Law]:
    """Compare the laws of glints with draws of a Gaussian relief's second derivatives and slopes."""
    slope, wave, distance, count = math.radians(4.0), 1.5, 20.0, 200_000
    rng = np.random.default_rng(51)
    m4 = 2 * slope**2 * (2 * math.pi / wave) ** 2
    # Second derivatives of an isotropic field: variances 3/8, 3/8 and 1/8 of m4, the first two correlated by 1/3.
    common, apart, mixed = rng.standard_normal((3, count))
    xx = math.sqrt(m4 / 4) * common + math.sqrt(m4 / 8) * apart
    yy = math.sqrt(m4 / 4) * common - math.sqrt(m4 / 8) * apart
    xy = math.sqrt(m4 / 8) * mixed
    made = []
    for name, gains in (("plane", (1.0, 1.0)), ("curved", (0.5, 2.0))):
        determinant = np.abs((gains[0] / distance - xx) * (gains[1] / distance - yy) - xy**2)
        drawn = float(determinant.mean()) * distance**2 / (gains[0] * gains[1])
        error = float(determinant.std()) / math.sqrt(count) / float(determinant.mean())
        about = "E abs det(M/d - H) d^2 / det M by draws; 5 standard errors"
        ratio = glint_count(slope, wave, distance, gains) / drawn
        made.append(law("glints", f"{name}_count", "x", ratio, 1 + 5 * error, 1 - 5 * error, count, about))
    slopes = slope * rng.standard_normal((2, count))
    mean = float(np.sqrt((slopes**2).sum(axis=0)).mean())
    wide = np.cov(distance * slopes / np.array([[0.5], [2.0]]))
    spread_off = np.abs(np.diag(cloud_covariance(slope, distance, (0.5, 2.0))) / np.diag(wide) - 1).max()
    return [
        *made,
        law(
            "glints", "mean_slope", "x", float(relief_error(slope)) / mean, 1.01, 0.99, count, "mean length of a slope"
        ),
        law("glints", "cloud_off", "", float(spread_off), 0.02, n=count, about="d^2 M^-1 Sigma M^-T by draws"),
    ]

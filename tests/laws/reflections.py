"""Laws of reflectances, lights and bounces: every pixel of a plane, or of a closed sphere, against closed forms."""

import math
from typing import Any

import numpy as np

from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.spec import scene_from_dict
from simtest.spec.reflectance import (
    PhongReflectance,
    RoughConductorReflectance,
    RoughPlasticReflectance,
    TissueReflectance,
)
from simtest.spec.scene import Effort
from tests.laws import by_hand
from tests.laws.law import Law, law

DISTANCE_MM, TILT_DEG, AZIMUTH_DEG = 10.0, 14.0, 130.0
CAMERA = {"width": 80, "height": 64, "fx": 75.0, "fy": 75.0, "cx": 41.5, "cy": 30.5}
"""Half of `by_hand.CAMERA` in each direction."""

ALPHA, INDEX, ALBEDO = 0.1, 1.4, 0.6
GRAZING_DEG = 85.0
LIGHT_MM = (3.0, -4.0, 0.0)
"""Far enough aside that Fresnel's reflectance differs over the plane."""

AIR = 1.000277
"""Index of the air that Mitsuba has outside its own plastic."""

MARGIN = 1 / 40
"""Share of the light through the film that is given up per unit of alpha (docs/concepts/tissue.md)."""


def lobes(session: Session) -> list[Law]:
    """Compare lobes of GGX and Beckmann facets with D G F / (4 cos), and the base below the film with its series."""
    facets = _Facets(np.array(LIGHT_MM))
    conductor = {"type": "rough_conductor", "alpha": 0.2}
    plastic = {"type": "rough_plastic", "alpha": 0.2, "diffuse": 0.0}
    made = []
    for name, reflectance, index in (("conductor", conductor, None), ("plastic", plastic, 1.49 / AIR)):
        expected = facets.lobe(0.2, index, ggx=True)
        about = "D G F / (4 cos_o) over squared distance"
        made.append(_residual("ggx_lobe", name, _rendered(session, reflectance).specular, expected, about))
    for name, ggx in (("ggx", True), ("beckmann", False)):
        film = {"index": INDEX, "alpha": ALPHA, "distribution": name}
        seen = _rendered(session, {"type": "tissue", "film": film, "diffuse": ALBEDO})
        about = f"D G F / (4 cos_o), {name}, index {INDEX:g}, absolute"
        made.append(_residual("film", f"{name}_lobe", seen.specular, facets.lobe(ALPHA, INDEX, ggx), about))
        about = "T T / index^2 albedo/pi / (1 - albedo r), with r by quadrature"
        made.append(_residual("film", f"{name}_base", seen.diffuse, facets.base_below(ALPHA, INDEX, ALBEDO), about))
    return [*made, _grazing(session), *_widths()]


def _grazing(session: Session) -> Law:
    """Compare a film's lobe at grazing light and view, where facets hide each other, with D G F / (4 cos_o)."""
    normal, view = by_hand.anchor_normal(GRAZING_DEG, AZIMUTH_DEG), np.array([0.0, 0.0, -1.0])
    # In the mirror direction from the anchor, as far as the camera
    light = np.array([0.0, 0.0, DISTANCE_MM]) + DISTANCE_MM * (2 * (normal @ view) * normal - view)
    facets = _Facets(light, GRAZING_DEG)
    film = {"index": INDEX, "alpha": ALPHA, "distribution": "beckmann"}
    seen = _rendered(session, {"type": "tissue", "film": film}, {"position_mm": light.tolist()}, GRAZING_DEG).specular
    lobe = facets.lobe(ALPHA, INDEX, ggx=False)
    row, column = int(CAMERA["cy"]), int(CAMERA["cx"])
    near = np.s_[row - 2 : row + 3, column - 2 : column + 3]
    off = float(np.abs(seen[near] / lobe[near] - 1).max())
    about = f"25 pixels about an anchor tilted by {GRAZING_DEG:g} deg; single precision"
    return law("film", "grazing_off", "", off, 2e-3, n=25, about=about)


def emission(session: Session) -> list[Law]:
    """Compare a matt plane under a cosine, a tabled and a spot light, each turned aside, with the closed form."""
    facets, axis = _Facets(np.array(LIGHT_MM)), np.array([-0.2, 0.3, 1.0])
    cosine = -(facets.to_light @ axis) / math.sqrt(axis @ axis)
    angle = np.arccos(np.clip(cosine, -1, 1)) * 180 / math.pi
    matt = ALBEDO / math.pi * facets.cos_light / facets.squared
    angles, shares = [0.0, 30.0, 70.0], [1.0, 0.7, 0.1]
    table = {"type": "table", "angle_deg": angles, "value": shares}
    lights: dict[str, tuple[dict[str, Any], Array]] = {
        "cosine": ({"profile": {"type": "cosine", "power": 3.0}}, cosine**3),
        "table": ({"profile": table}, np.interp(angle, angles, shares)),
        "spot": ({"spot_deg": 40.0, "soft_edge_deg": 8.0}, np.clip((20.0 - angle) / 8.0, 0, 1)),
    }
    made = []
    for name, (more, factor) in lights.items():
        light = {"position_mm": list(LIGHT_MM), "direction": axis.tolist(), "power": 2.0, **more}
        seen = _rendered(session, {"type": "phong", "specular": 0.0, "diffuse": ALBEDO}, light)
        off = np.abs(seen.diffuse - 2.0 * factor * matt).max() / (2.0 * matt.max())
        about = f"albedo/pi cos over squared distance, a {name} light of power 2; single precision"
        made.append(law("emission", f"{name}_off", "", float(off), 2e-5, n=angle.size, about=about))
    # The normalised lobe: (n + 2)/(2 pi) cos^n(beta) cos(theta).
    shape = {"type": "phong", "exponent": 20.0, "specular": 0.4, "normalised": True}
    mirrored = 2 * facets.cos_light[..., None] * facets.normal - facets.to_light
    beta = np.maximum((mirrored * facets.to_camera).sum(axis=-1), 0)
    expected = 0.4 * 22 / (2 * math.pi) * beta**20 * facets.cos_light / facets.squared
    found = _rendered(session, shape).specular
    return [*made, _residual("phong_lobe", "normalised", found, expected, "(n + 2)/(2 pi) cos^n(beta) cos(theta)")]


def bounces() -> list[Law]:
    """Render an integrating sphere: after k bounces the irradiance is albedo^k I / R^2 everywhere.

    With the light at the centre each path brings exactly that, so that the series is met to rounding at every depth.
    With the light aside the first bounce is uneven, and the second is even all the same: every point of a sphere sees
    every other by the same factor. That is known up to the noise of the paths. Radiosity, as an estimate without
    paths, comes near the whole series.
    """
    radius, albedo = 8.0, 0.55
    unit = albedo / math.pi / radius**2
    session, made = None, []
    # At the centre, then 3 mm away from it: the camera stands there, and the light with it.
    for name, distance, depth, samples in (
        ("centre_depth_3", radius, 3, 1), ("centre_depth_5", radius, 5, 1), ("aside", 5.0, 3, 16),
    ):  # fmt: skip
        scene = scene_from_dict(
            {
                "surface": {"type": "sphere", "radius_mm": radius, "side": "inside", "distance_mm": distance},
                "camera": {"width": 48, "height": 48, "fx": 30.0, "fy": 30.0, "cx": 24.0, "cy": 24.0},
                "reflectance": {"type": "phong", "specular": 0.0, "diffuse": albedo},
                "render": {"path_depth": depth, "samples_per_pixel": samples},
            },
            "law",
        )
        session = session or Session(scene)
        session.update(scene)
        seen = session.radiance()
        expected = unit * sum(albedo**k for k in range(1, depth - 1))
        share = seen.indirect.astype(float) / expected
        if name == "aside":
            gap = 5 * float(share.std()) / math.sqrt(share.size)
            about = "mean of the second bounce over albedo^2 I / (pi R^2); 5 standard errors"
            made.append(law("bounces", name, "x", float(share.mean()), 1 + gap, 1 - gap, share.size, about))
            continue
        off = float(np.abs(share - 1).max())
        about = "every pixel over the series of albedo^k; single precision"
        made.append(law("bounces", f"{name}_off", "", off, 1e-4, n=share.size, about=about))
        direct = float(np.abs(seen.diffuse / unit - 1).max())
        made.append(law("bounces", f"{name}_direct_off", "", direct, 1e-4, n=share.size, about="albedo I / (pi R^2)"))
    plain = scene.model_copy(update={"render": Effort()})
    session.update(plain)
    direct = session.radiance().diffuse.astype(float)
    session.update(plain.model_copy(update={"render": Effort(ambient=True)}))
    share = (session.radiance().diffuse - direct) / (unit * albedo / (1 - albedo))
    about = "mean of the radiosity over albedo^2 / (1 - albedo) I / (pi R^2)"
    made.append(law("bounces", "ambient", "x", float(share.mean()), 1.04, 0.96, share.size, about))
    return made


class _Facets:
    """A tilted plane under a light aside, pixel by pixel: directions, cosines, and what facets reflect."""

    def __init__(self, light: Array, tilt_deg: float = TILT_DEG) -> None:
        x, y = np.meshgrid(np.arange(CAMERA["width"]) + 0.5, np.arange(CAMERA["height"]) + 0.5)
        rays = np.stack(
            [(x - CAMERA["cx"]) / CAMERA["fx"], (y - CAMERA["cy"]) / CAMERA["fy"], np.ones_like(x)], axis=-1
        )
        rays /= np.sqrt((rays**2).sum(axis=-1, keepdims=True))
        self.normal = by_hand.anchor_normal(tilt_deg, AZIMUTH_DEG)
        points = rays * (DISTANCE_MM * self.normal[2] / (rays @ self.normal))[..., None]
        towards = light - points
        self.squared = (towards**2).sum(axis=-1)
        self.to_light, self.to_camera = towards / np.sqrt(self.squared)[..., None], -rays
        self.cos_light, self.cos_camera = self.to_light @ self.normal, self.to_camera @ self.normal
        middle = self.to_light + self.to_camera
        middle /= np.sqrt((middle**2).sum(axis=-1, keepdims=True))
        self.cos_facet, self.cos_incidence = middle @ self.normal, (middle * self.to_light).sum(axis=-1)

    def lobe(self, alpha: float, index: float | None, ggx: bool) -> Array:
        """Compute D G F / (4 cos_o) over the squared distance; without an index all is reflected."""
        squared = self.cos_facet**2
        tangent = (1 - squared) / squared
        if ggx:
            density = alpha**2 / (math.pi * squared**2 * (alpha**2 + tangent) ** 2)
        else:
            density = np.exp(-tangent / alpha**2) / (math.pi * alpha**2 * squared**2)
        seen = _smith(self.cos_light, alpha, ggx) * _smith(self.cos_camera, alpha, ggx)
        reflected = 1.0 if index is None else _fresnel(self.cos_incidence, index)
        return np.asarray(density * seen * reflected / (4 * self.cos_camera) / self.squared)

    def base_below(self, alpha: float, index: float, albedo: float) -> Array:
        """Compute the light that passes a film, is reflected by a matt base, to and fro, and passes the film again."""
        # Reflectance of the film for diffuse light: from outside by quadrature, from within by reciprocity.
        nodes, weights = np.polynomial.legendre.leggauss(400)
        mu = (nodes + 1) / 2
        outside = float((weights * _fresnel(mu, index) * mu).sum())
        within = 1 - (1 - outside) / index**2
        passed = (1 - _fresnel(self.cos_light, index)) * (1 - _fresnel(self.cos_camera, index)) * (1 - MARGIN * alpha)
        share = passed / index**2 * albedo / math.pi / (1 - albedo * within)
        return np.asarray(share * self.cos_light / self.squared)


def _smith(cosine: Array, alpha: float, ggx: bool) -> Array:
    """Compute Smith's share of facets that are seen at a cosine from the normal [Walter 2007, eqs. 28 and 34]."""
    tangent = np.sqrt(1 - cosine**2) / cosine
    if ggx:
        return np.asarray(2 / (1 + np.sqrt(1 + alpha**2 * tangent**2)))
    a = 1 / (alpha * tangent)
    erf = np.vectorize(math.erf)(a)
    return np.asarray(2 / (1 + erf + np.exp(-(a**2)) / (a * math.sqrt(math.pi))))


def _fresnel(cosine: Array, index: float) -> Array:
    """Compute Fresnel's reflectance of unpolarised light at the surface of a denser medium."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    parallel = (index * cosine - inside) / (index * cosine + inside)
    across = (cosine - index * inside) / (cosine + index * inside)
    return np.asarray((parallel**2 + across**2) / 2)


def _widths() -> list[Law]:
    """Compare the half-widths and curvatures that reflectances state with those of densities written down by hand."""

    def ggx(t: Array, alpha: float) -> Array:
        return np.asarray((1 + t**2 / alpha**2) ** -2.0)

    def half(shape: Any) -> float:
        """Find by bisection where a falling function of the angle is half of that at 0."""
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (
                (middle, high) if float(shape(np.array(middle))) > 0.5 * float(shape(np.array(0.0))) else (low, middle)
            )
        return low

    film = {"index": INDEX, "alpha": 0.05}
    stated: dict[str, tuple[Any, float]] = {
        "phong": (PhongReflectance(exponent=40.0), half(lambda a: np.cos(2 * a) ** 40)),
        "plastic": (RoughPlasticReflectance(alpha=0.2), half(lambda a: ggx(np.tan(a), 0.2))),
        "conductor": (RoughConductorReflectance(alpha=0.3), half(lambda a: ggx(np.tan(a), 0.3))),
        "beckmann": (
            TissueReflectance.model_validate({"film": film}),
            half(lambda a: np.exp(-(np.tan(a) ** 2) / 0.05**2)),
        ),
    }
    made = []
    for name, (reflectance, width) in stated.items():
        ratio = reflectance.half_width / width
        about = "half-angle over the density's own, by bisection"
        made.append(law("lobe_width", name, "x", ratio, 1 + 1e-9, 1 - 1e-9, about=about))
    # Second derivative of -log f at 0, by differences; Beckmann's f cos(theta) is exp(-tan^2/alpha^2) / cos^5.
    step = 1e-3
    phong = -40 * 2 * math.log(math.cos(2 * step)) / step**2
    beckmann = 2 * (math.tan(step) ** 2 / 0.05**2 + 5 * math.log(math.cos(step))) / step**2
    wet = TissueReflectance.model_validate({"film": film}).lobe_curvature
    for name, found, wanted in (
        ("phong_curvature", PhongReflectance(exponent=40.0).lobe_curvature, phong),
        ("beckmann_curvature", wet or math.nan, beckmann),
    ):
        about = "second derivative of the lobe's logarithm, by differences of 1e-3 rad"
        made.append(law("lobe_width", name, "x", found / wanted, 1 + 1e-4, 1 - 1e-4, about=about))
    return made


def _rendered(
    session: Session, reflectance: dict[str, Any], light: dict[str, Any] | None = None, tilt_deg: float = TILT_DEG
) -> Any:
    scene = {
        "surface": {"type": "plane", "distance_mm": DISTANCE_MM, "tilt_deg": tilt_deg, "azimuth_deg": AZIMUTH_DEG},
        "camera": CAMERA,
        "rig": {"lights": [light or {"position_mm": list(LIGHT_MM)}]},
        "reflectance": reflectance,
    }
    session.update(scene_from_dict(scene, "law"))
    return session.radiance()


def _residual(name: str, quantity: str, found: Any, expected: Array, about: str) -> Law:
    bright = expected > 1e-3 * expected.max()
    off = float(np.abs(found.astype(float)[bright] / expected[bright] - 1).max())
    return law(name, f"{quantity}_off", "", off, 3e-4, n=int(bright.sum()), about=f"{about}; single precision")

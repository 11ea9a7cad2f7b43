"""The features whose corners are tried, and the scene of a row of levels; pairs that the package refuses.

A row's scene is drawn several times: levels stay, and angles, distances, viewpoints and the noise's seed differ.
"""

import functools
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import SimtestError
from simtest.spec import Scene
from simtest.spec.scene import scene_from_dict
from studies.corners.design import Pair, Row, covering_array, pairs_of

FACTORS: dict[str, tuple[str, ...]] = {
    "lens": ("pinhole", "brown_conrady", "fisheye"),
    "centre": ("middle", "off"),
    "pixels": ("square", "oblong"),
    "light": ("at_camera", "beside", "beside_not_given", "two", "disc"),
    "emission": ("none", "known", "not_known"),
    "vignetting": ("none", "known", "not_known"),
    "reflectance": ("phong", "ggx_film", "principled"),
    "surface": ("plane", "cylinder", "saddle", "colon", "liver", "mesh"),
    "relief": ("none", "resolved", "not_resolved"),
    "sensor": ("ideal", "shot_and_read", "processed"),
    "bits": ("none", "8", "12"),
    "clipping": ("no", "yes"),
    "instruments": ("none", "shaft"),
    "roi": ("frame", "box"),
    "size": ("1", "2"),
    "pose": ("given", "moved"),
}
"""Levels by feature; the size is that of a pixel's division, 2 for twice as many along each side."""

ARRAY_SEED, LEAST_ROWS = 51, 60

MESH = Path(__file__).absolute().parents[3] / "shared" / "data" / "meshes" / "colon_edingca_00090.ply"
"""A user's mesh, beside the checkout."""

VIGNETTING_POWER, EMISSION_POWER = 2.5, 1.5
"""Of the cosine; together they lie in the prior on a falloff that is not given, 0 to 4."""

SMOOTH = ("plane", "cylinder", "saddle")
"""Surfaces whose points, normals and curvatures are closed forms."""

WIDTH, HEIGHT = 160, 120

DEFAULTS = {name: levels[0] for name, levels in FACTORS.items()}


def settings(row: Row, draw: int = 0) -> dict[str, Any]:
    """Return the tables of the scene of a row of levels, in one of its draws; levels that are left out are the first.

    A processed picture has 8 bits where its row says nothing of them.
    """
    level = {**DEFAULTS, **({"bits": "8"} if row.get("sensor") == "processed" else {}), **row}
    rng = np.random.default_rng([ARRAY_SEED, zlib.crc32(repr(level).encode()), draw])
    surface = _surface(level, rng)
    # A liver is seen from four times as far as a lumen's wall: lights and relief scale with the distance.
    far = 4.0 if level["surface"] == "liver" else 1.0
    if level["relief"] != "none":
        # Higher than 0.3 mm it would be no relief.
        wave = {"resolved": 2.0, "not_resolved": 0.08}[level["relief"]] * min(far, 2.4)
        band = {"slope_deg": 4.0 if level["relief"] == "resolved" else 2.0, "wavelength_mm": wave}
        surface["relief"] = {"bands": [band], "seed": int(rng.integers(2**31))}
    tables: dict[str, Any] = {
        "name": "corner",
        "surface": surface,
        "reflectance": {
            "phong": {"type": "phong", "exponent": 150.0, "diffuse": 0.2},
            "ggx_film": {
                "type": "tissue", "film": {"index": 1.38, "alpha": 0.06, "distribution": "ggx"}, "diffuse": 0.4,
            },
            "principled": {"type": "principled", "roughness": 0.25, "diffuse": 0.3},
        }[level["reflectance"]],
        "rig": _rig(level, rng, far),
        "camera": _camera(level, rng),
        "sensor": _sensor(level, rng),
        "known": {"lights": level["light"] != "beside_not_given"},
        # Relief that is smaller than a pixel is averaged over it.
        "render": {"samples_per_pixel": 16 if level["relief"] == "not_resolved" else 1},
    }  # fmt: skip
    if level["surface"] == "liver":
        # It may lie beyond the prior on a distance that is not given, 5 to 80 mm.
        tables["known"] |= {"distance_error": float(rng.normal(0.0, 0.1)), "distance_sd": 0.1}
    if level["instruments"] == "shaft":
        corner = rng.choice([0.1, 0.9], size=2)
        out = float(np.degrees(np.arctan2(corner[1] - 0.5, corner[0] - 0.5)))
        # Beside a liver there may be no surface at the tip, of whose distance a share could be taken.
        depth = {"depth_mm": 30.0} if level["surface"] == "liver" else {"depth_share": 0.8}
        tip = (0.5 + 0.55 * (corner - 0.5)).tolist()
        tables["instruments"] = [{"tip": tip, "azimuth_deg": out, "diameter_mm": min(2.0 * far, 5.0), **depth}]
    return tables


def scene_of(row: Row, draw: int = 0) -> Scene:
    """Return the scene of a row of levels, in one of its draws; raise `InputError` where the package refuses it."""
    return scene_from_dict(settings(row, draw))


def _surface(level: Row, rng: np.random.Generator) -> dict[str, Any]:
    kind = level["surface"]
    if kind in SMOOTH:
        tables: dict[str, Any] = {
            "distance_mm": float(rng.uniform(14.0, 24.0)),
            "tilt_deg": float(rng.uniform(2.0, 16.0)),
            "azimuth_deg": float(rng.uniform(-180.0, 180.0)),
            "spin_deg": float(rng.uniform(-90.0, 90.0)),
        }
        if kind == "plane":
            return {"type": "plane", **tables}
        if kind == "cylinder":
            return {"type": "cylinder", "radius_mm": float(rng.uniform(10.0, 40.0)), **tables}
        return {"type": "quadric", "k1_per_mm": float(rng.uniform(0.01, 0.05)),
                "k2_per_mm": float(rng.uniform(-0.02, -0.005)), **tables}  # fmt: skip
    path = str(MESH) if kind == "mesh" else kind
    tables = {"type": "anatomy", "path": path, "viewpoint": int(rng.integers(1000))}
    return tables | ({"edge_mm": 3.0} if kind == "mesh" else {})


def _rig(level: Row, rng: np.random.Generator, far: float) -> dict[str, Any]:
    angle = float(rng.uniform(-180.0, 180.0))
    lights: list[dict[str, Any]] = [{}]
    if level["light"] in ("beside", "beside_not_given", "two"):
        # Within the prior on a light that is not given, 0 to 6 mm.
        lights = [{"offset_mm": 2.5 * min(far, 1.6), "azimuth_deg": angle}]
    if level["light"] == "two":
        lights.append({"offset_mm": 3.5 * min(far, 1.6), "azimuth_deg": angle - 150.0 if angle > 0 else angle + 150.0})
    for light in lights:
        if level["light"] == "disc":
            light["source"] = {"type": "disc", "radius_mm": 1.0}
        if level["emission"] != "none":
            light["profile"] = {"type": "cosine", "power": EMISSION_POWER}
    return {"lights": lights, "emission_known": level["emission"] != "not_known"}


def _camera(level: Row, rng: np.random.Generator) -> dict[str, Any]:
    finer = int(level["size"])
    focal = {"pinhole": 140.0, "brown_conrady": 135.0, "fisheye": 95.0}[level["lens"]] * finer
    width, height = WIDTH * finer, HEIGHT * finer
    off = rng.uniform(-0.1, 0.1, 2) if level["centre"] == "off" else np.zeros(2)
    camera: dict[str, Any] = {
        "width": width, "height": height, "fx": focal, "fy": focal * (1.12 if level["pixels"] == "oblong" else 1.0),
        "cx": float(width * (0.5 + off[0])), "cy": float(height * (0.5 + off[1])),
    }  # fmt: skip
    if level["lens"] == "brown_conrady":
        k1, p1, p2 = rng.uniform([-0.25, -0.004, -0.004], [-0.1, 0.004, 0.004]).tolist()
        camera["distortion"] = {"type": "brown_conrady", "k1": k1, "k2": 0.03, "p1": p1, "p2": p2}
    if level["lens"] == "fisheye":
        k1 = float(rng.uniform(-0.05, 0.02))
        camera["distortion"] = {"type": "kannala_brandt", "k1": k1, "k2": 0.002}
    if level["pose"] == "moved":
        camera["moved"] = {
            "translation_mm": rng.uniform(-0.8, 0.8, 3).tolist(),
            "rotation_deg": (rng.uniform(-1, 1, 3) * [5.0, 5.0, 60.0]).tolist(),
        }
    return camera


def _sensor(level: Row, rng: np.random.Generator) -> dict[str, Any]:
    sensor: dict[str, Any] = {
        "exposure": {"gain": 2.5 if level["clipping"] == "yes" else 0.8},
        "saturation": level["clipping"] == "yes",
        "seed": int(rng.integers(2**31)),
    }
    if level["sensor"] != "ideal":
        sensor |= {"full_well": 8000.0, "read_noise": 10.0}
    if level["sensor"] == "processed":
        sensor |= {
            "mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"}, "response": {"type": "srgb"},
            "sharpening": {"radius_px": 1.5, "amount": 0.6}, "coding": {"type": "jpeg", "quality": 92},
        }  # fmt: skip
    if level["bits"] != "none":
        sensor["bits"] = int(level["bits"])
    if level["vignetting"] != "none":
        sensor["vignetting"] = {"type": "cosine", "power": VIGNETTING_POWER}
        sensor["vignetting_known"] = level["vignetting"] == "known"
    return sensor


@functools.cache
def refusals() -> dict[Pair, str]:
    """Return the pairs of levels that the package refuses, with the line by which it does."""
    found: dict[Pair, str] = {}
    for pair in pairs_of(FACTORS):
        # A mesh that is not there is a row that is left out, and no refused pair.
        if ("surface", "mesh") in pair and not MESH.is_file():
            continue
        try:
            scene_of(dict(pair))
        except SimtestError as error:
            found[pair] = str(error)
    return found


@functools.cache
def rows() -> Sequence[Row]:
    """Return the covering array of all features."""
    refused = refusals()
    return covering_array(FACTORS, lambda pair: pair not in refused, LEAST_ROWS, ARRAY_SEED)

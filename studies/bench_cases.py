"""Freezes a version of the benchmark: writes its scenes with every default spelled out, and the pinned hashes.

``python -m studies.bench_cases v2`` writes scenes/bench/v2 from the definitions below. A released version is never
written again: a folder that holds hashes is refused.
"""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.bench.suite import HASHES, SUITE, FrozenCase, read_suite
from simtest.errors import InputError
from simtest.runtime.files import write_json
from simtest.runtime.resources import data_root
from simtest.spec import AnatomySurface, Scene, load_scene, scene_from_dict
from simtest.spec.toml_files import toml_tables, toml_value
from simtest.surfaces.recipe import load_recipe

Tables = dict[str, Any]

SEED = 22
"""Public; drawn by nobody, so it says nothing of the cases."""

PARTS = (
    ("smooth", "Smooth laws", "highlights",
     "Planes, cylinders, spheres and saddles with white noise; lights, lobe and camera are known."),
    ("tissue", "Tissue", "highlights",
     "Colon, stomach, liver and gallbladder with fine relief, a liquid film and vessels; lights and camera are known, "
     "the picture is linear."),
    ("hard", "Hard", "highlights",
     "Tissue through a whole camera chain, with a light that nobody told and a vignetting that nobody told."),
    ("real-chain", "Real chain", "highlights",
     "One stage of the camera chain at a time: mosaic, sharpening, codec, clipping, enlargement; lights are known."),
    ("dense", "Dense maps", "maps",
     "Normal or depth of every pixel of smooth and tissue frames, at highlights, around them and elsewhere."),
)  # fmt: skip

U, LOG, INT, NORMAL = "uniform", "log_uniform", "integer", "normal"


def draw(kind: str, low: float, high: float) -> Tables:
    """Return a distribution as it stands in suite.toml."""
    return {"kind": kind, "low": low, "high": high}


TURNED = {"surface.tilt_deg": draw(U, 0.0, 15.0), "surface.azimuth_deg": draw(U, 0.0, 360.0)}
TURNED_ABOUT = TURNED | {"surface.spin_deg": draw(U, 0.0, 180.0)}
LOBE = {"reflectance.exponent": draw(LOG, 50.0, 300.0)}
NEAR = {"surface.distance_mm": draw(LOG, 8.0, 30.0)}
BESIDE = {
    "rig.lights.0.offset_mm": draw(U, 0.0, 4.0), "rig.lights.0.azimuth_deg": draw(U, 0.0, 360.0),
    "known.distance_error": draw(NORMAL, 0.0, 0.05),
}  # fmt: skip
CLEAN: Tables = {"sensor.noise_sigma": 0.03, "known.distance_sd": 0.0}
SMALL: Tables = {"camera.width": 320, "camera.height": 320, "camera.fx": 320.0, "camera.fy": 320.0}
AT_CAMERA: Tables = {"rig": {"lights": [{}]}}

TISSUE: Tables = {
    "camera.width": 480, "camera.height": 360, "render.samples_per_pixel": 4,
    "sensor": {"point_spread_px": 0.8, "noise_sigma": 0.01, "exposure": {"gain": 0.8}},
}  # fmt: skip
PICTURE: Tables = {
    "response": {"type": "srgb"}, "bits": 8, "full_well": 8000, "read_noise": 6.0, "point_spread_px": 0.8,
    "exposure": {"gain": 0.8},
}  # fmt: skip
FOCAL = {"colon": 300.0, "stomach": 300.0, "liver": 360.0, "gallbladder": 360.0}
RELIEF = {
    "surface.relief.bands.0.slope_deg": draw(U, 0.2, 2.0),
    "surface.relief.bands.0.wavelength_mm": draw(LOG, 2.0, 4.0),
    "reflectance.film.alpha": draw(LOG, 0.025, 0.045),
}
GAUSSIAN = [{"slope_deg": 2.0, "wavelength_mm": 3.0}]
# Making an anatomy takes longer than a frame of it.
SEEDS = {"surface.seed": draw(INT, 0, 1_000_000) | {"blocks": 3}}
VIEWS: dict[str, Tables] = {
    # A light near the camera shines back from the wall that the camera faces.
    "colon": SEEDS | {"surface.path_share": draw(U, 0.1, 0.9), "surface.around_deg": draw(U, 0.0, 360.0)},
    "liver": SEEDS | {"surface.viewpoint": draw(INT, 0, 100_000)},
}
WALL: Tables = {"surface.view": "wall"}
BODY = {
    "surface.distance_mm": draw(U, 20.0, 50.0), "surface.tilt_deg": draw(U, 0.0, 15.0),
    "surface.azimuth_deg": draw(U, 0.0, 360.0), "surface.spin_deg": draw(U, 0.0, 180.0),
}  # fmt: skip
VIEWS |= {"stomach": VIEWS["colon"], "gallbladder": BODY}
UNTOLD = {
    "rig.lights.0.offset_mm": draw(U, 0.0, 6.0), "rig.lights.0.azimuth_deg": draw(U, 0.0, 360.0),
    "sensor.vignetting.power": draw(U, 0.0, 4.0), "sensor.sharpening.amount": draw(U, 0.0, 1.2),
    "sensor.coding.quality": draw(INT, 60, 95),
}  # fmt: skip


def smooth() -> list[Tables]:
    """Return the smooth cases: base scene, its changes, drawn values, scenes and frames of each."""
    how = {"part": "smooth", "draws": 32, "realisations": 4, "isolated": False}
    bent = CLEAN | SMALL | {"surface.distance_mm": 10.0}
    cylinder = TURNED_ABOUT | LOBE
    return [
        {"name": "plane", "base": "plane", "set": CLEAN | SMALL, "draw": NEAR | TURNED | LOBE} | how,
        {"name": "cylinder", "base": "cylinder", "set": bent,
         "draw": cylinder | {"surface.radius_mm": draw(LOG, 3.0, 60.0)}} | how,
        {"name": "cylinder_inside", "base": "cylinder", "set": bent | {"surface.side": "inside",
         "surface.radius_mm": 30.0}, "draw": cylinder | {"surface.radius_mm": draw(LOG, 16.0, 100.0)}} | how,
        {"name": "sphere", "base": "sphere", "set": bent,
         "draw": TURNED | LOBE | {"surface.radius_mm": draw(LOG, 3.0, 60.0)}} | how,
        {"name": "sphere_inside", "base": "sphere", "set": bent | {"surface.side": "inside",
         "surface.radius_mm": 30.0}, "draw": TURNED | LOBE | {"surface.radius_mm": draw(LOG, 16.0, 100.0)}} | how,
        {"name": "saddle", "base": "saddle", "set": bent, "draw": TURNED_ABOUT | LOBE | {
            "surface.k1_per_mm": draw(U, 0.01, 0.08), "surface.k2_per_mm": draw(U, -0.06, -0.01)}} | how,
        {"name": "plane_light_beside", "base": "plane",
         "set": CLEAN | SMALL | {"known.distance_sd": 0.05, "known.distance_error": 0.0},
         "draw": NEAR | TURNED | LOBE | BESIDE} | how,
        {"name": "cylinder_light_beside", "base": "cylinder",
         "set": bent | {"known.distance_sd": 0.05, "known.distance_error": 0.0},
         "draw": cylinder | BESIDE | {"surface.radius_mm": draw(LOG, 5.0, 60.0)}} | how,
    ]  # fmt: skip


def tissue_base(organ: str, sensor: Tables) -> Tables:
    """Return the changes that make a benchmark scene of a shipped tissue scene."""
    focal = {"camera.fx": FOCAL[organ], "camera.fy": FOCAL[organ], "surface.relief": {"bands": GAUSSIAN}}
    view = WALL if VIEWS[organ] is VIEWS["colon"] else {}
    told = {"known.distance_sd": 0.05, "known.distance_error": 0.0}
    return TISSUE | focal | AT_CAMERA | view | told | {"sensor": sensor}


def tissue() -> list[Tables]:
    """Return the tissue cases."""
    how = {"part": "tissue", "draws": 60, "realisations": 1, "isolated": True}
    return [
        {"name": organ, "base": f"tissue_{organ}", "set": tissue_base(organ, TISSUE["sensor"]),
         "draw": RELIEF | BESIDE | VIEWS[organ]} | how
        for organ in FOCAL
    ]  # fmt: skip


def hard() -> list[Tables]:
    """Return the hard cases."""
    how = {"part": "hard", "draws": 36, "realisations": 1, "isolated": True}
    chain = PICTURE | {
        "vignetting": {"type": "cosine", "power": 2.0}, "vignetting_known": False,
        "sharpening": {"radius_px": 1.3, "amount": 0.6}, "coding": {"type": "jpeg", "quality": 80},
        "mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"},
    }  # fmt: skip
    return [
        {"name": organ, "base": f"tissue_{organ}", "set": tissue_base(organ, chain) | {"known": {"lights": False}},
         "draw": RELIEF | UNTOLD | VIEWS[organ]} | how
        for organ in FOCAL
    ]  # fmt: skip


def real_chain() -> list[Tables]:
    """Return the cases of the camera chain's stages."""
    how = {"part": "real-chain", "draws": 24, "realisations": 1, "isolated": True}
    stages: dict[str, Tables] = {
        "mosaic": {"mosaic": {"pattern": "rggb", "demosaicing": "edge_aware"}},
        "sharpening": {"sharpening": {"radius_px": 1.3, "amount": 0.9}},
        "jpeg_95": {"coding": {"type": "jpeg", "quality": 95}},
        "jpeg_80": {"coding": {"type": "jpeg", "quality": 80}},
        "clipping": {"saturation": True, "exposure": {"gain": 2.5}},
        "enlarged": {"scaling": {"factor": 0.6, "method": "linear"}},
    }
    organs = ("colon", "gallbladder", "stomach", "gallbladder", "liver", "gallbladder")
    return [
        {"name": name, "base": f"tissue_{organ}", "set": tissue_base(organ, PICTURE | stage),
         "draw": RELIEF | BESIDE | VIEWS[organ]} | how
        for (name, stage), organ in zip(stages.items(), organs, strict=True)
    ]  # fmt: skip


def dense() -> list[Tables]:
    """Return the cases whose every pixel is scored."""
    how = {"part": "dense", "draws": 3, "realisations": 1, "isolated": False}
    chosen = {"smooth": ("cylinder", "saddle"), "tissue": ("colon", "gallbladder"), "hard": ("stomach",)}
    made = [case for case in (*smooth(), *tissue(), *hard()) if case["name"] in chosen[case["part"]]]
    return [case | how | {"name": f"{case['part']}_{case['name']}"} for case in made]


def resolved_tables(scene: Scene) -> dict[str, Any]:
    """Return a scene's tables with every default written out, and every preset and recipe replaced by its numbers.

    Keys without a value are left out: TOML has none.
    """
    tables: dict[str, Any] = scene.model_dump(mode="json", exclude_none=True)
    if scene.rig.preset is not None:
        lights = [light.model_dump(mode="json", exclude_none=True) for light in scene.rig.lights]
        lights = [
            {key: value for key, value in light.items() if key not in ("offset_mm", "azimuth_deg")} for light in lights
        ]
        tables["rig"] = {"lights": lights, "seed": scene.rig.seed, "emission_known": scene.rig.emission_known}
    tables["sensor"].pop("preset", None)
    tables["reflectance"].get("albedo", {}).pop("preset", None)
    if isinstance(scene.surface, AnatomySurface) and (file := scene.surface.file()).suffix == ".toml":
        recipe = load_recipe(file, scene.surface.recipe_values)
        # The type says which file it is read with, and the seed is the surface's own.
        tables["surface"]["recipe"] = recipe.model_dump(mode="json", exclude_none=True, exclude={"type", "seed"})
        tables["surface"]["seed"] = recipe.seed
    return tables


def unfrozen_keys(case: FrozenCase) -> list[str]:
    """Return the key paths whose values the frozen file does not state: defaults that were added after the freeze.

    Raises `InputError` if the file's scene resolves to another one than it states.
    """
    now = _flat(resolved_tables(scene_from_dict(case.scene, str(case.file))))
    frozen = _flat(case.scene)
    for path, value in frozen.items():
        if now.get(path) != value:
            raise InputError(f"{case.file}: {path} = {value!r} is read as {now.get(path)!r}")
    return sorted(now.keys() - frozen.keys())


def _flat(value: Any, above: str = "") -> dict[str, Any]:
    """Return the leaves of nested tables and lists by key path; empty tables and lists are leaves."""
    items = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    flat: dict[str, Any] = {}
    for key, item in items:
        flat |= _flat(item, f"{above}.{key}" if above else str(key))
    return flat or ({above: value} if above else {})


def freeze(version: str) -> Path:
    """Write a version's folder and return it; raise `InputError` where it is released already."""
    folder = data_root("scenes") / "bench" / version
    if (folder / HASHES).exists():
        raise InputError(f"{folder}: is frozen; a changed case must be a new version")
    cases = [*smooth(), *tissue(), *hard(), *real_chain(), *dense()]
    entries = []
    for case in cases:
        tables = resolved_tables(load_scene(case["base"], case["set"]))
        tables["name"] = f"{case['part']}_{case['name']}"
        file = folder / case["part"] / f"{case['name']}.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        name = tables.pop("name")
        file.write_text(f"name = {toml_value(name)}\n\n{toml_tables(tables)}", encoding="utf-8")
        entries.append({key: case[key] for key in ("part", "name", "draws", "realisations", "isolated", "draw")})
    head = {
        "name": "simtest-bench", "title": f"simtest-bench {version}", "format": 1, "seed": SEED,
        "description": "Frozen cases for methods that reconstruct surface normals from specular highlights.",
    }  # fmt: skip
    text = "# Frozen: a changed case is a new version (docs/howto/bench.md). Written by studies/bench_cases.py.\n"
    text += "".join(f"{key} = {toml_value(value)}\n" for key, value in head.items())
    for part, title, kind, about in PARTS:
        text += f"\n[[parts]]\nname = {toml_value(part)}\ntitle = {toml_value(title)}\nkind = {toml_value(kind)}\n"
        text += f"description = {toml_value(about)}\n"
    for entry in entries:
        drawn = entry.pop("draw")
        text += "\n[[cases]]\n" + "".join(f"{key} = {toml_value(value)}\n" for key, value in entry.items())
        text += "[cases.draw]\n" + "".join(f'"{key}" = {toml_value(value)}\n' for key, value in drawn.items())
    (folder / SUITE).write_text(text, encoding="utf-8")
    suite = read_suite(folder)
    write_json(folder / HASHES, {"suite": suite.digest, "cases": suite.hashes})
    return folder


if __name__ == "__main__":
    try:
        print(freeze(sys.argv[1] if len(sys.argv) > 1 else "v1"))
    except InputError as error:
        sys.exit(f"bench_cases: {error}")

"""Malformed reliefs are refused with one line that names the key, the value and what is allowed."""

import tomllib
from pathlib import Path

import pytest

from simtest.spec import scene_from_dict
from simtest.spec.surfaces import Relief
from simtest.surfaces import make_surface
from tests.refusals import refused

MESH = Path(__file__).resolve().parents[2] / "meshes" / "colon_40mm.ply"

PLANE = '[surface]\ntype = "plane"\n'
RELIEF = PLANE + "[surface.relief]\n"
BAND = "[[surface.relief.bands]]\n"
GOOD = BAND + "slope_deg = 4\nwavelength_mm = 1.5\n"
KEY = "surface.relief.bands.0."

CASES = {
    "slope 60": (BAND + "slope_deg = 60\nwavelength_mm = 1", KEY + "slope_deg = 60: must be less than or equal to 20"),
    "slope 0": (BAND + "slope_deg = 0\nwavelength_mm = 1", KEY + "slope_deg = 0: must be greater than 0"),
    "slope negative": (BAND + "slope_deg = -4\nwavelength_mm = 1", KEY + "slope_deg = -4: must be greater than 0"),
    "slope NaN": (BAND + "slope_deg = nan\nwavelength_mm = 1", KEY + "slope_deg = nan: must be a finite number"),
    "no slope": (BAND + "wavelength_mm = 1", KEY + "slope_deg: missing; it must be given"),
    "text": (BAND + 'slope_deg = "four"\nwavelength_mm = 1', KEY + "slope_deg = 'four': must be a number"),
    "true": (BAND + "slope_deg = true\nwavelength_mm = 1", KEY + "slope_deg = True: must be a number"),
    "wavelength tiny": (BAND + "slope_deg = 4\nwavelength_mm = 0.001", KEY + "wavelength_mm = 0.001: must be greater"),
    "wavelength infinite": (BAND + "slope_deg = 4\nwavelength_mm = inf", KEY + "wavelength_mm = inf: must be a finite"),
    "wavelength in deg": (BAND + "slope_deg = 4\nwavelength_deg = 1", KEY + "wavelength"),
    "too high": (BAND + "slope_deg = 10\nwavelength_mm = 5", "a relief of about 0.72 mm", "must stay below 0.3 mm"),
    "too high together": (BAND + "slope_deg = 6\nwavelength_mm = 3.2\n" + GOOD * 3, "must stay below 0.3 mm"),
    "pits too deep": (GOOD.replace("4", "6") + 'kind = "pits"', "a relief of about 0.38 mm"),
    "width 2": (GOOD + "width = 2", KEY + "width = 2: must be less than or equal to 0.5"),
    "anisotropy 9": (GOOD + "anisotropy = 9", KEY + "anisotropy = 9: must be less than or equal to 5"),
    "anisotropy below 1": (GOOD + "anisotropy = 0.5", KEY + "anisotropy = 0.5: must be greater than or equal to 1"),
    "zero direction": (GOOD + "direction = [0, 0, 0]", "bands.0: direction = [0.0, 0.0, 0.0]: must have a length"),
    "direction of two": (GOOD + "direction = [1, 0]", KEY + "direction.2: missing"),
    "unknown kind": (GOOD + 'kind = "bumps"', KEY + "kind = 'bumps': must be 'gaussian', 'ridged' or 'pits'"),
    "unknown key": (GOOD + "height_mm = 1", KEY + "height_mm = 1: unknown key; allowed: "),
}  # fmt: skip

RELIEFS = {
    "no bands": (RELIEF + "bands = []", "surface.relief.bands = []: must have at least 1 item"),
    "bands left out": (RELIEF + "seed = 1", "surface.relief.bands: missing"),
    "5 bands": (PLANE + GOOD * 5, "surface.relief.bands = ", "must have at most 4 items"),
    "bands a number": (RELIEF + "bands = 4", "surface.relief.bands = 4: must be a list"),
    "negative seed": (RELIEF + "seed = -1\n" + GOOD, "surface.relief.seed = -1: must be greater than or equal to 0"),
    "diffusion 50": (RELIEF + "diffusion_mm = 50\n" + GOOD, "surface.relief.diffusion_mm = 50: must be less than"),
    "diffusion negative": (RELIEF + "diffusion_mm = -1\n" + GOOD, "diffusion_mm = -1: must be greater than or"),
    "relief a number": (PLANE + "relief = 3", "surface.relief = 3: must be a table"),
}


@pytest.mark.parametrize("name", [*CASES, *RELIEFS])
def test_one_line(name):
    text, *fragments = {**{k: (PLANE + v[0], *v[1:]) for k, v in CASES.items()}, **RELIEFS}[name]
    refused(lambda: scene_from_dict(tomllib.loads(text), "my.toml"), "my.toml: ", *fragments)


def test_the_tables_good_band_is_accepted():
    assert isinstance(scene_from_dict(tomllib.loads(PLANE + GOOD)).surface.relief, Relief)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*inside out")
def test_waves_that_a_mesh_holds_itself():
    def surface(wavelength, **values):
        relief = {"bands": [{"slope_deg": 1, "wavelength_mm": 1.0}, {"slope_deg": 1, "wavelength_mm": wavelength}]}
        return {"type": "anatomy", "path": str(MESH), "relief": relief, **values}

    def make(**values):
        return make_surface(scene_from_dict({"surface": surface(**values)}).surface)

    refused(
        lambda: make(wavelength=5.0),
        "surface.relief.bands.1.wavelength_mm = 5: ",
        "colon_40mm.ply holds waves from 2.4 mm on itself (two of its median edges, or smoothing_mm)",
    )
    # Waves below the mesh's own lie in the normal alone and need no triangles; smoothing makes room for longer ones.
    assert make(wavelength=0.1).relief is not None
    assert make(wavelength=5.0, smoothing_mm=6.0).relief is not None

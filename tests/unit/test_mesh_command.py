"""`simtest mesh`: the same bytes for the same seed, the shipped meshes' hashes, verdicts and exit codes."""

import hashlib
import importlib.metadata
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from simtest.surfaces.factory import make_mesh
from simtest.surfaces.mesh_file import read_mesh
from simtest.surfaces.recipe import load_anatomy

ROOT = Path(__file__).resolve().parents[2]
SUMS = (ROOT / "meshes" / "SHA256SUMS").read_text().splitlines()


@pytest.mark.slow
def test_same_seed_same_bytes_in_two_processes_and_another_for_another(tmp_path):
    size = ("--set", "length_mm=40", "--edge-mm", 1.5, "--curvature")
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        command = ["colon", "--seed", seed, *size, "--out", tmp_path / f"{name}.ply"]
        code = "from simtest.cli.main import main; main()"
        done = subprocess.run([sys.executable, "-c", code, "mesh", *map(str, command)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert "faces" in done.stdout
    a, b, c = ((tmp_path / f"{name}.ply").read_bytes() for name in "abc")
    assert a == b != c


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl"])
def test_what_is_written_is_read_again(here, tmp_path, suffix):
    path = tmp_path / f"liver.{suffix}"
    assert here("mesh", "liver", "--edge-mm", 8, "--set", "seed=2", "--out", path)[::2] == (0, [])
    vertices, faces, repairs = read_mesh(path)
    made, _, _ = make_mesh(load_anatomy("liver", seed=2), 8.0)
    np.testing.assert_allclose(vertices[faces], made.vertices[made.faces], atol=1e-4)
    assert not list(repairs.sentences())


def test_ply_holds_normals_and_curvatures(here, tmp_path):
    path = tmp_path / "colon.ply"
    assert here("mesh", "colon", "--edge-mm", 2, "--curvature", "--out", path)[0] == 0
    loaded = trimesh.load(path, process=False)
    made, k_min, k_max = make_mesh(load_anatomy("colon"), 2.0)
    np.testing.assert_allclose(loaded.vertex_normals, made.normals, atol=1e-6)
    data = loaded.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(data["k_min"].ravel(), k_min, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(data["k_max"].ravel(), k_max, rtol=1e-5, atol=1e-8)


def test_a_recipe_of_ones_own(here, tmp_path):
    recipe = tmp_path / "mine.toml"
    recipe.write_text(
        'type = "colon"\nlength_mm = 40.0\nrelief_mm = 0.01\n[[polyps]]\nalong_mm = 20.0\naround_deg = 90.0\n'
    )
    assert here("mesh", "colon", "--recipe", recipe, "--edge-mm", 2, "--out", "mine.ply")[::2] == (0, [])
    code, _, errors = here("mesh", "liver", "--recipe", recipe, "--out", "mine.ply")
    assert code == 2
    assert "type = 'colon'; simtest mesh liver needs 'liver'" in errors[0]


BAD = {
    "suffix": (("colon", "--out", "x.xyz"), "suffix '.xyz'; allowed: .ply, .obj, .stl"),
    "folder": (("colon", "--out", "nowhere/x.ply"), "no such folder nowhere"),
    "edge": (("colon", "--edge-mm", 0, "--out", "x.ply"), "edge_mm = 0: must be 0.01 to 20"),
    "many": (("colon", "--edge-mm", 0.02, "--out", "x.ply"), "at most 5000000 are allowed"),
    "cells": (("liver", "--edge-mm", 0.1, "--out", "x.ply"), "make the lobes smaller or the edges longer"),
    "seed": (("colon", "--seed", -1, "--out", "x.ply"), "-1 is no seed"),
    "key": (("colon", "--set", "radius=3", "--out", "x.ply"), "unknown key"),
    "curvature": (("colon", "--curvature", "--out", "x.stl"), "--curvature: .stl files hold none"),
    "missing": (("check", "none.ply"), "none.ply: no such file"),
    "distance": (("check", "none.ply", "--distance", 0), "--distance 0"),
    "lobes": (("check", "none.ply", "--exponent", 5, "--roughness", 0.1), "only one of them"),
}


def test_bad_use_is_one_line_and_exit_2(here):
    for name, (arguments, message) in BAD.items():
        code, output, errors = here("mesh", *arguments)
        assert (code, output, len(errors)) == (2, "", 1), name
        assert message in errors[0], name


def test_verdicts_and_exit_codes(here, tmp_path):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(4, radius=40.0).export(path)
    code, output, _ = here("mesh", "check", path, "--distance", 50, "--exponent", 1, "--json")
    verdict = json.loads(output)
    assert (code, verdict["usable"], verdict["condition"]["watertight"]) == (0, True, True)
    code, output, _ = here("mesh", "check", path, "--distance", 20, "--roughness", 0.1)
    assert code == 1
    assert re.search(r"verdict +too coarse: edges of [\d.]+ mm are needed", output)


@pytest.mark.parametrize("name", [line.split()[1] for line in SUMS if not line.startswith("#")])
def test_shipped_meshes_are_what_their_recipes_make(here, name, tmp_path):
    expected = next(line.split()[0] for line in SUMS if line.endswith(f"  {name}"))
    shipped = ROOT / "meshes" / name
    assert hashlib.sha256(shipped.read_bytes()).hexdigest() == expected
    assert shipped.stat().st_size < 1_500_000
    for package, version in re.findall(r"([\w-]+) (\d[\w.]*)", SUMS[0]):
        if (found := importlib.metadata.version(package)) != version:
            pytest.skip(f"the hashes are those of {package} {version}; this is {found}")
    command = next(line.partition(f"{name}: simtest mesh ")[2] for line in SUMS if line.startswith(f"# {name}:"))
    arguments = command.split()
    arguments[-1] = str(tmp_path / name)
    assert here("mesh", *arguments)[0] == 0
    assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == expected


def test_a_segment_of_100_mm_takes_less_than_1_gb():
    """In a child process, so that its own peak is measured.

    Not by getrusage, whose peak a child inherits from its parent. The time of generation is no test's business.
    """
    code = (
        "from simtest.surfaces.recipe import load_anatomy\nfrom simtest.surfaces.colon import build\n"
        "recipe = load_anatomy('colon', settings={'length_mm': 100.0})\n"
        "faces = len(build(recipe).mesh.faces)\n"
        "peak = next(line for line in open('/proc/self/status') if line.startswith('VmHWM'))\n"
        "print(faces, 1024 * int(peak.split()[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    faces, peak = map(float, done.stdout.split())
    assert faces > 190_000
    assert peak < 1e9

"""The example cores in other languages: each answers as the one in Python does, on the same requests."""

import ast
import subprocess
import sys
from pathlib import Path

import core_driver
import numpy as np
import pytest

import simtest
from simtest.errors import Reason
from simtest.estimators.isophotes import fit_isophotes

CORES = Path(__file__).resolve().parents[2] / "examples" / "cores"
PYTHON = [sys.executable, str(CORES / "python" / "core.py")]
REQUESTS = 60
CLOSE = 1e-9

pytestmark = pytest.mark.skipif(not CORES.is_dir(), reason="the checkout's examples folder is not there")


@pytest.fixture(scope="module")
def asked():
    """Sixty requests of random patches."""
    rng, cameras = np.random.default_rng(20261123), core_driver.random_cameras()
    pairs = [(core_driver.random_patch(rng, cameras[i % 3]), cameras[i % 3]) for i in range(REQUESTS)]
    return [(*core_driver.isophote_request(i, *pair), *pair) for i, pair in enumerate(pairs)]


def answers_of(command, asked, folder):
    with core_driver.CoreDriver(command, folder) as core:
        answers = [core.ask(header, arrays) for header, arrays, *_ in asked]
    assert core.code == 0
    return core.hello, answers


@pytest.fixture(scope="module")
def of_python(asked, tmp_path_factory):
    return answers_of(PYTHON, asked, tmp_path_factory.mktemp("python"))[1]


def test_the_python_core_states_the_cone_axis(asked, of_python):
    assert [answer["id"] for answer in of_python] == list(range(REQUESTS))
    for answer, (_, _, patch, camera) in zip(of_python, asked, strict=True):
        axis, ratio = np.array(answer["look_ray"]), answer["axis_ratio"]
        assert answer["normal"] == [-x for x in answer["look_ray"]]
        assert np.linalg.norm(axis) == pytest.approx(1, abs=1e-12)
        (ours,), _ = fit_isophotes(patch, camera, [0.5])
        pose = ours.pose()
        # Two ways to fit an ellipse to points with noise.
        assert np.degrees(np.arccos(min(pose.axis @ axis, 1.0))) < 0.1
        assert ratio == pytest.approx(pose.axis_ratio, abs=0.02)


def bad_requests():
    """No isophote; too few points; a hyperbola; points on a line."""
    t = np.linspace(-1, 1, 12)
    branch = 0.1 * np.stack(
        [np.concatenate([3 * np.cosh(t), -3 * np.cosh(t)]), np.concatenate([np.sinh(t)] * 2)], axis=1
    )
    line = np.stack([np.linspace(-0.1, 0.1, 12), np.zeros(12)], axis=1)
    yield "no_closed_isophote", None
    yield "too_few_points", branch[:5]
    yield "not_an_ellipse", branch
    yield "", line


def check_refusals(command, folder):
    """Check that a core refuses what has no answer, with a reason that is known."""
    with core_driver.CoreDriver(command, folder) as core:
        for number, (reason, points) in enumerate(bad_requests()):
            name = "isophote_rays_0.5"
            header = {"type": "patch", "id": number}
            if points is None:
                answer = core.ask({**header, "missing": {name: "no_closed_isophote: none"}}, {})
            else:
                rays = np.column_stack([points, np.ones(len(points))])
                answer = core.ask(header, {name: rays / np.linalg.norm(rays, axis=1, keepdims=True)})
            assert answer["type"] == "failure"
            assert answer["id"] == number
            assert answer["reason"] == (reason or answer["reason"])
            assert answer["reason"] in {known.value for known in Reason}


def test_a_refusal_states_its_reason(tmp_path):
    check_refusals(PYTHON, tmp_path)


def test_the_frame_core_finds_highlights_itself(tmp_path):
    camera = simtest.Camera.from_fov(70.0, 160, 120)
    rays = camera.unproject(camera.pixel_centres())
    normals = -camera.unproject([[40.0, 40.0], [120.5, 70.25]])
    light = sum(np.clip(-rays @ normal, 0, 1) ** 800 for normal in normals)
    with core_driver.CoreDriver([sys.executable, str(CORES / "python" / "frame_core.py")], tmp_path) as core:
        answer = core.ask({"type": "frame", "id": 3}, {"smoothed": light.astype("<f4"), "rays": rays})
        dark = core.ask({"type": "frame", "id": 4}, {"smoothed": np.zeros((120, 160), "<f4"), "rays": rays})
    assert answer["type"] == "estimates"
    assert answer["id"] == 3
    got = np.array([estimate["normal"] for estimate in answer["estimates"]])
    looks = np.array([estimate["look_px"] for estimate in answer["estimates"]])
    assert len(got) == 2
    order = np.argsort(looks[:, 0])
    np.testing.assert_allclose(looks[order], [[40.0, 40.0], [120.5, 70.25]], atol=0.1)
    assert np.degrees(np.arccos(np.clip(np.sum(got[order] * normals, axis=1), -1, 1))).max() < 0.05
    assert (dark["type"], dark["reason"]) == ("failure", "no_estimate")


STAND_IN = """
import no_such_package

print("the main part runs")

def fit_ellipse_lstsq(contour):
    print("a stray print")
    return contour.mean(axis=0)

def dual_conic(): pass
def sorted_eigen(): pass
def plane_normal(): pass

def Zisserman_method(a, K, case="non-synthetic"):
    ray = np.linalg.inv(K) @ [a[0], a[1], 1.0]
    return (ray, ray) if case == "synthetic" else (ray + [0.5, 0, 0], -ray + [0.5, 0, 0])

def normal_disambiguiting(N1, N2, I):
    return N2

raise SystemExit("the main part runs")
"""


def ask_script(folder, text, *options, distortion=None):
    """Ask the core of the published scripts, with a script of this text, about a square isophote."""
    script = folder / "script.py"
    script.write_text(text)
    camera = {"K": [[100.0, 0, 50], [0, 100.0, 50], [0, 0, 1]], "distortion": distortion}
    turns = np.linspace(0, 2 * np.pi, 13)
    contour = np.stack([60 + 5 * np.cos(turns), 40 + 5 * np.sin(turns)], axis=1)
    contour[-1] = contour[0]
    command = [sys.executable, str(CORES / "authors" / "core.py"), str(script), *options]
    with core_driver.CoreDriver(command, folder) as core:
        return core.ask({"type": "patch", "id": 5, "camera": camera, "missing": {}}, {"isophote_0.5": contour})


def test_the_scripts_functions_run_without_their_main_part(tmp_path):
    answer = ask_script(tmp_path, STAND_IN)
    assert (answer["type"], answer["id"], answer["flags"]) == ("estimate", 5, [])
    ray = np.array([0.1, -0.1, 1.0])
    expected = np.array([[0.4, 0.1, -1.0], [-0.6, 0.1, -1.0]])
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    # The chosen one first, each turned so that it faces the camera.
    np.testing.assert_allclose(answer["candidates"], expected, atol=1e-12)
    np.testing.assert_allclose(answer["normal"], expected[0], atol=1e-12)
    np.testing.assert_allclose(answer["look_ray"], ray / np.linalg.norm(ray), atol=1e-12)


def test_one_vector_for_both_normals_is_flagged(tmp_path):
    answer = ask_script(tmp_path, STAND_IN, "--branch", "eigenvector")
    assert answer["flags"] == ["one_normal"]
    assert len(answer["candidates"]) == 1


def test_a_lens_that_the_script_does_not_know_is_refused(tmp_path):
    answer = ask_script(tmp_path, STAND_IN, distortion={"model": "brown_conrady", "k1": -0.1})
    assert (answer["type"], answer["reason"]) == ("failure", "not_known")


def test_a_script_without_the_functions_is_told_which(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("def Zisserman_method(): pass\n")
    command = [sys.executable, str(CORES / "authors" / "core.py"), str(script)]
    done = subprocess.run(command, input="", capture_output=True, text=True, timeout=30)
    assert done.returncode == 1
    assert "defines no function dual_conic, fit_ellipse_lstsq, normal_disambiguiting" in done.stderr


@pytest.mark.parametrize(
    "script", sorted(CORES.glob("*/*.py")), ids=lambda script: script.relative_to(CORES).as_posix()
)
def test_the_python_cores_need_numpy_alone(script):
    tree = ast.parse((CORES / script).read_text(encoding="utf-8"), feature_version=(3, 9))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert {name.partition(".")[0] for name in imported} <= {*sys.stdlib_module_names, "numpy"}

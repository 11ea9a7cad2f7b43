"""A labelled frame beside Blender's Cycles, frame by frame in turns: same mesh, lens, light, samples and labels.

Cycles runs in a child, in an interpreter of its own: its package bpy (GPL) needs a NumPy older than ours. `make
bench-cycles` installs it; the variable SIMTEST_CYCLES_PYTHON names another interpreter. Both keep the scene from frame
to frame, trace direct light alone on all cores, and leave their arrays in memory. Cycles gives depth, position, normal
and object, not curvatures; its lobe is a microfacet lobe as wide as our Phong lobe.
"""

import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from benchmarks.measuring import Figure
from simtest.rendering import Session
from simtest.spec import scene_from_dict

ROUNDS = 5
INTERPRETER = "SIMTEST_CYCLES_PYTHON"
DEFAULT_INTERPRETER = Path(__file__).parents[1] / ".venv-cycles" / "bin" / "python"
CHILD = Path(__file__).with_name("blender_child.py")
"""Run with -P: beside this file lie modules that Blender would take for its own."""
EXPONENT, DIFFUSE, OFFSET_MM = 50.0, 0.3, 3.0

SAME_DEPTH, SAME_NORMAL_DEG, SAME_SHADOWS = 1e-3, 1.0, 0.97
"""How far depth, relative, and normal may differ in the median, and the share of pixels whose shadows agree: a frame of
the same scene, and not of another."""


def figures() -> list[Figure]:
    """Render in turns, with labels and without; first compare the labels, pixel by pixel."""
    python = interpreter()
    shown: list[Figure] = []
    for samples in (16, 1):
        session = _session(samples)
        if not shown:
            shown += _same_scene(python, session)
        for labelled in (True, False):
            ours = session.frame if labelled else session.radiance
            with _child(python, session, labelled) as child:
                ours()
                child.render()
                both = [(_timed(ours), child.render()) for _ in range(ROUNDS)]
            shown.append(_figure(samples, labelled, both))
    return shown


def interpreter() -> str:
    """Return the interpreter that has bpy; without one the benchmark fails, since no figure would stand for it."""
    python = os.environ.get(INTERPRETER) or str(DEFAULT_INTERPRETER)
    tried = None
    if Path(python).is_file():
        tried = subprocess.run([python, "-c", "import bpy"], capture_output=True, text=True, check=False)
    if tried is None or tried.returncode:
        raise SystemExit(
            f"benchmark blender: no bpy in {python}; `make bench-cycles` installs it, or set {INTERPRETER}"
        )
    return python


def _session(samples: int) -> Session:
    scene = {
        "surface": {"type": "anatomy", "path": "colon"},
        "reflectance": {"type": "phong", "exponent": EXPONENT, "diffuse": DIFFUSE},
        "rig": {"lights": [{"offset_mm": OFFSET_MM}]},
        "camera": {"width": 640, "height": 480, "fx": 400.0, "fy": 400.0},
        "render": {"samples_per_pixel": samples},
    }
    return Session(scene_from_dict(scene), labelled=True)


@dataclass
class _Cycles:
    """A child that renders whenever it is asked to."""

    stdin: IO[str]
    stdout: IO[str]

    def answer(self) -> str:
        """Return the next line of the child that is its own; Blender prints lines of progress too."""
        for line in self.stdout:
            if line.startswith(("[", "ready")):
                return line
        raise SystemExit("benchmark blender: the child ended")

    def render(self) -> tuple[float, float]:
        """Return processor and wall time of one frame, s."""
        print(file=self.stdin, flush=True)
        processor, wall = json.loads(self.answer())
        return processor, wall


@contextmanager
def _child(python: str, session: Session, labelled: bool) -> Iterator[_Cycles]:
    """Start Cycles on a session's scene, and end it afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        path = _write(session, Path(folder), labelled)
        command = [python, "-P", str(CHILD), str(path)]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            child = _Cycles(process.stdin, process.stdout)
            child.answer()
            yield child
            process.stdin.close()


def _write(session: Session, folder: Path, labelled: bool) -> Path:
    """Write what Cycles needs of a session's scene."""
    mesh, camera, scene = session.surface.shape().mesh, session.camera, session.scene
    assert mesh is not None
    path = folder / "scene.npz"
    np.savez(
        path, vertices=mesh.vertices, faces=mesh.faces, normals=mesh.normals, pose=session.surface.model_from_camera,
        light=session.to_model(scene.rig.true_mm())[0], fov=2 * np.arctan(camera.width / 2 / camera.fx),
        width=camera.width, height=camera.height, samples=scene.render.samples_per_pixel, exponent=EXPONENT,
        diffuse=DIFFUSE, threads=os.cpu_count() or 1, labelled=labelled,
    )  # fmt: skip
    return path


def _timed(function: object) -> tuple[float, float]:
    """Return processor and wall time of a call, s."""
    assert callable(function)
    processor, wall = time.process_time(), time.perf_counter()
    function()
    return time.process_time() - processor, time.perf_counter() - wall


def _figure(samples: int, labelled: bool, both: list[tuple[tuple[float, float], tuple[float, float]]]) -> Figure:
    """Return the median over rounds of Cycles' processor time over ours."""
    ratios = [theirs[0] / ours[0] for ours, theirs in both]
    ours, theirs = (np.median([pair[i] for pair in both], axis=0) for i in (0, 1))
    about = f"processor {1e3 * ours[0]:.0f} ms against {1e3 * theirs[0]:.0f} ms, "
    about += f"clock {1e3 * ours[1]:.0f} ms against {1e3 * theirs[1]:.0f} ms"
    what = "labelled frame" if labelled else "radiance alone"
    name = f"{what}, {samples} sample{'s' * (samples > 1)}, over Cycles"
    limit = 30.0 if (samples, labelled) == (16, True) else None
    return Figure(name, statistics.median(ratios), limit, True, "x", about)


def _same_scene(python: str, session: Session) -> list[Figure]:
    """Compare depth and normal of both, so that both are known to render the same."""
    frame = session.frame()
    labels = frame.labels
    with tempfile.TemporaryDirectory() as folder:
        path = _write(session, Path(folder), True)
        picture = Path(folder) / "labels.exr"
        subprocess.run([python, "-P", str(CHILD), str(path), str(picture)], check=True, capture_output=True)
        layers = {name.rsplit(".", 1)[-1]: np.array(bitmap)
                  for name, bitmap in session.mi.Bitmap(str(picture)).split()}  # fmt: skip
    depth = layers["Depth"].reshape(labels.depth.shape)
    normal = layers["Normal"] @ session.surface.model_from_camera[:3, :3]
    seen = labels.mask & (np.abs(depth) < 1e4)
    same = (layers["Combined"][..., :3].max(axis=-1) > 0) == (frame.radiance.intensity > 0)
    off = np.abs(depth / labels.position[..., 2] - 1)[seen]
    angle = np.degrees(np.arccos(np.clip(np.sum(normal * labels.normal, axis=-1)[seen], -1, 1)))
    return [
        Figure("pixels that both see", float(seen.mean()), 0.95, True, "of all"),
        Figure("pixels that are lit in both or dark in both", float(same.mean()), SAME_SHADOWS, True, "of all"),
        Figure("difference of the depths, median", float(np.median(off)), SAME_DEPTH, unit="relative"),
        Figure("angle between the normals, median", float(np.median(angle)), SAME_NORMAL_DEG, unit="deg"),
    ]

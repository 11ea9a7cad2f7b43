"""Frames do not depend on the number of rendering threads, down to light that single precision barely holds."""

import json
import os
import subprocess
import sys

import pytest

CODE = """
import hashlib, json
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import load_scene
settings = {"camera.width": 96, "camera.height": 80, "camera.fx": 90.0, "camera.fy": 90.0, "surface.radius_mm": 11.731,
            "surface.tilt_deg": 5.4321, "sensor.noise_sigma": 0.0, "sensor.full_well": 8000.0}
scene = load_scene("sphere", settings)
view = render_view(Session(scene), scene)
light = view.light
dark = float(light[light > 0].min())
hashes = [hashlib.sha256(image.tobytes()).hexdigest() for image in (light, view.frame(1))]
print(json.dumps([*hashes, dark]))
"""


def rendered(threads):
    environment = {**os.environ, "SIMTEST_THREADS": str(threads)}
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=environment)
    return json.loads(done.stdout)


@pytest.mark.slow
def test_light_and_noise_are_the_same_with_one_thread_and_with_two():
    one, two = rendered(1), rendered(2)
    assert one == two
    # The scene holds light so faint that it matters.
    assert two[2] < 1e-37

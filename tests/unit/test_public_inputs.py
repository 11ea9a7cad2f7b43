"""Public functions of Python given what the commands refuse: an `InputError` of one line, whatever the value."""

import numpy as np
import pytest

import simtest
from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.geometry import Camera

CAMERA = Camera.from_fov(60.0, 96, 72)
FRAME = np.full((72, 96), 0.5)

ARRAYS = [np.zeros(0), np.zeros((3, 3)), np.full((72, 96), np.nan), np.zeros((72, 96), complex), np.array("x")]
OBJECTS = [True, -1, 3.5, float("nan"), b"x", [1], [[1, 2], [3]], object(), lambda x: x, 10**400]
NO_PATH = [None, *OBJECTS, *ARRAYS, "\0"]
NO_TABLE = [*OBJECTS, *ARRAYS, "zz", "", ["a"], {1: 2}]
NO_PICTURE = [
    None, *OBJECTS, *ARRAYS, "zz", np.zeros((1, 1)), -np.ones((72, 96)), -np.ones((72, 96, 3)),
    np.full((72, 96), 1e300), np.zeros((72, 96, 0)), np.zeros((72, 96, 2), np.uint8), np.zeros((72, 96, 5), np.uint8),
]  # fmt: skip
NO_NAME = [*OBJECTS, *ARRAYS, "", "zz", {}]

CALLS = {
    "load_scene": (simtest.load_scene, [*NO_PATH, "", "zz"]),
    "load_experiment": (simtest.load_experiment, [*NO_PATH, "", "zz"]),
    "load_camera": (simtest.load_camera, [*NO_PATH, "", "zz"]),
    "load_calibration": (simtest.load_calibration, [*NO_PATH, "", "zz"]),
    "save_camera": (lambda value: simtest.save_camera(CAMERA, value), [*NO_PATH, ""]),
    "save_calibration": (lambda value: simtest.save_calibration(Calibration(CAMERA), value), [*NO_PATH, ""]),
    "render": (simtest.render, [*NO_PATH, "", "zz"]),
    "a key of render": (lambda value: simtest.render("plane", samples_per_pixel=value), [*NO_NAME, 0]),
    "export": (lambda value: simtest.export("plane", value), NO_PATH),
    "validate": (lambda value: simtest.validate(value, "out"), [*NO_PATH, "", "zz"]),
    "settings": (lambda value: simtest.load_scene("plane", value), NO_TABLE),
    "a setting": (lambda value: simtest.load_scene("plane", {"surface.distance_mm": value}), [True, *ARRAYS, "zz", {}]),
    "reconstruct": (lambda value: simtest.reconstruct(value, CAMERA), NO_PICTURE),
    "a picture's channels": (
        lambda value: simtest.reconstruct(np.full((72, 96, value), 0.5), CAMERA, encoding="srgb"), [2, 4, 5]
    ),
    "camera": (lambda value: simtest.reconstruct(FRAME, value), [None, True, -1, "zz", [1], *ARRAYS]),
    "estimators": (lambda value: simtest.reconstruct(FRAME, CAMERA, value), [*OBJECTS, *ARRAYS, "zz", ["zz"]]),
    "roi": (lambda value: simtest.reconstruct(FRAME, CAMERA, roi=value), [*OBJECTS, *ARRAYS, "zz", (1, 2, 3)]),
    "smoothing_px": (lambda value: simtest.reconstruct(FRAME, CAMERA, smoothing_px=value), [True, -1, b"x", *ARRAYS]),
    "isolated": (lambda value: simtest.reconstruct(FRAME, CAMERA, isolated=value), [None, -1, "zz", [], *ARRAYS]),
    "detector": (lambda value: simtest.reconstruct(FRAME, CAMERA, detector=value), NO_NAME),
    "target": (lambda value: simtest.reconstruct(FRAME, CAMERA, target=value), [None, *NO_NAME]),
    "encoding": (lambda value: simtest.reconstruct(FRAME, CAMERA, encoding=value), NO_NAME),
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_what_no_command_takes_no_function_takes(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, values = CALLS[name]
    wrong = []
    for value in values:
        try:
            call(value)
        except InputError as error:
            said = str(error)
            if not said.isprintable() or len(said) > 900:
                wrong.append((value, said))
        except Exception as error:
            wrong.append((value, repr(error)))
        else:
            wrong.append((value, "taken"))
    assert wrong == []
    assert list(tmp_path.iterdir()) == []

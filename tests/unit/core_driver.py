"""A plain driver of cores for tests: it speaks the process protocol without the package's own code."""

import contextlib
import json
import subprocess
from pathlib import Path

import numpy as np

import simtest

LEVEL = 0.5


class CoreDriver:
    """One core process; `ask` sends a request and returns its answer."""

    def __init__(self, command, folder):
        self.folder = Path(folder)
        self.child = subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        try:
            self.hello = self._exchange({"type": "hello", "protocol": 1, "simtest": "0"})
        except BaseException:
            self.__exit__()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        with contextlib.suppress(BrokenPipeError):
            self.child.stdin.close()
        try:
            self.code = self.child.wait(10)
        finally:
            self.child.kill()
            self.child.wait()
            self.child.stdout.close()

    def ask(self, header, arrays):
        described = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in arrays.items()]
        header = {**header, "arrays": described} if described else header
        if self.hello.get("transport") != "files":
            return self._exchange(header, b"".join(np.ascontiguousarray(a).tobytes() for a in arrays.values()))
        room = self.folder / f"request_{header['id']}"
        room.mkdir()
        (room / "request.json").write_text(json.dumps(header))
        for name, values in arrays.items():
            np.save(room / f"{name}.npy", values)
        done = self._exchange({"type": header["type"], "id": header["id"], "folder": str(room)})
        assert done == {"type": "done", "id": header["id"]}
        return json.loads((room / "answer.json").read_text())

    def _exchange(self, message, content=b""):
        self.child.stdin.write(json.dumps(message).encode() + b"\n" + content)
        self.child.stdin.flush()
        return json.loads(self.child.stdout.readline())


def random_cameras():
    """Return a pinhole, a lens with barrel distortion and a fisheye."""
    return (
        simtest.Camera.from_fov(70.0, 640, 480),
        simtest.Camera(640, 480, 420.0, 415.0, 322.0, 236.0, distortion=simtest.BrownConrady(k1=-0.1, p1=1e-3)),
        simtest.Camera(640, 480, 250.0, 250.0, 320.0, 240.0, distortion=simtest.KannalaBrandt(k1=-0.02)),
    )


def random_patch(rng, camera):
    """Return a patch of an oblong lobe with noise, anywhere in the view."""
    size = 80
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    turn, wide, long = rng.uniform(0, np.pi), *np.sort(rng.uniform(5, 14, 2))
    middle = size / 2 + rng.uniform(-3, 3, 2)
    u = (x - middle[0]) * np.cos(turn) + (y - middle[1]) * np.sin(turn)
    v = (y - middle[1]) * np.cos(turn) - (x - middle[0]) * np.sin(turn)
    lobe = np.exp(-0.5 * ((u / long) ** 2 + (v / wide) ** 2)) + rng.normal(0, 0.002, x.shape)
    corner = (int(rng.integers(0, camera.width - size)), int(rng.integers(0, camera.height - size)))
    patch = simtest.Patch.cut(lobe, (0, 0, size, size), origin_px=corner)
    assert isinstance(patch, simtest.Patch)
    return patch


def isophote_request(number, patch, camera):
    """Return the header and the arrays of a request for the rays of one isophote; none where it does not close."""
    contour = patch.isophote(LEVEL)
    header = {"type": "patch", "id": number, "camera": {"width": camera.width}, "priors": {}, "patch": {}}
    name = f"isophote_rays_{LEVEL:g}"
    if isinstance(contour, simtest.Failure):
        return {**header, "missing": {name: str(contour)}}, {}
    return header, {name: np.ascontiguousarray(camera.unproject(contour), "<f8")}

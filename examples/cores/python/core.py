"""A reconstruction core as a command: the axis of the cone of sightlines through the isophote at half of the peak.

It needs Python 3.9 or later and NumPy, in any environment; it does not import simtest. Try it with

    simtest core check "python examples/cores/python/core.py"
    simtest validate curvature --realisations 2 --estimator "command: python examples/cores/python/core.py"

To make your own, keep `main` and replace `estimate`. docs/reference/cores.md describes the protocol.
"""

import json
import sys

import numpy as np

ISOPHOTE = "isophote_rays_0.5"
HELLO = {
    "type": "hello", "protocol": 1, "name": "cone_axis_python", "version": "1.0", "kind": "patch",
    "arrays": [ISOPHOTE], "isophotes": [0.5],
}  # fmt: skip
LEAST_POINTS = 6
FLATTEST = 1e-9


def estimate(request, arrays):
    """Return the fields of an answer to one request.

    Parameters
    ----------
    request : dict
        The request's header: camera, priors, patch.
    arrays : dict of str to ndarray
        The arrays that `HELLO` asks for.

    Returns
    -------
    dict
        An estimate or a failure, without its id.
    """
    if ISOPHOTE not in arrays:
        return failure("no_closed_isophote", "the isophote was not sent")
    rays = arrays[ISOPHOTE]
    if (rays[0] == rays[-1]).all():
        rays = rays[:-1]  # the polygon is closed; its first point counts once
    if len(rays) < LEAST_POINTS:
        return failure("too_few_points", f"{len(rays)} points; at least {LEAST_POINTS} are needed")

    # a gnomonic plane across the middle of the rays, centred and scaled so that the fit is well conditioned
    middle = rays.sum(axis=0)
    middle /= np.sqrt(middle @ middle)
    frame = np.stack([*across(middle), middle])
    x, y, z = frame @ rays.T
    x, y = x / z, y / z
    cx, cy = x.mean(), y.mean()
    x, y = x - cx, y - cy
    scale = np.sqrt((x * x + y * y).mean())
    x, y = x / scale, y / scale
    if (x * x).mean() * (y * y).mean() - (x * y).mean() ** 2 < FLATTEST:
        return failure("degenerate_conic", "the points lie on a line")

    # the ellipse (1 + p) x^2 + 2 q x y + (1 - p) y^2 + d x + e y + f = 0, by least squares
    matrix = np.stack([x * x - y * y, 2 * x * y, x, y, np.ones_like(x)], axis=1)
    p, q, d, e, f = np.linalg.solve(matrix.T @ matrix, -matrix.T @ (x * x + y * y))
    if p * p + q * q >= 1:
        return failure("not_an_ellipse", f"the fitted conic is no ellipse: p^2 + q^2 = {p * p + q * q:.3g}")
    conic = np.array([[1 + p, q, d / 2], [q, 1 - p, e / 2], [d / 2, e / 2, f]])

    # the cone w^T C w = 0 of camera directions w, and its axis: the eigenvector of the one negative eigenvalue
    plane = np.array([[1 / scale, 0, -cx / scale], [0, 1 / scale, -cy / scale], [0, 0, 1]]) @ frame
    values, vectors = np.linalg.eigh(plane.T @ conic @ plane)
    if not values[0] < 0 < values[1]:
        return failure("degenerate_conic", f"eigenvalues {values[0]:.3g}, {values[1]:.3g}, {values[2]:.3g}")
    axis = vectors[:, 0] if vectors[:, 0] @ middle > 0 else -vectors[:, 0]
    # A light at the camera: where the normal points back along the sightline, the reflection is brightest.
    return {
        "type": "estimate", "normal": (-axis).tolist(), "look_ray": axis.tolist(),
        "axis_ratio": float(np.sqrt(values[1] / values[2])),
    }  # fmt: skip


def across(direction):
    """Return two unit vectors that are perpendicular to a unit vector and to each other."""
    x, y, z = direction
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([1 + sign * x * x * a, sign * b, -sign * x]), np.array([b, sign + y * y * a, -y])


def failure(reason, detail):
    """Return an answer that there is no normal, and why."""
    return {"type": "failure", "reason": reason, "detail": detail}


def main():
    """Greet, then answer each request until standard input closes."""
    requests, answers = sys.stdin.buffer, sys.stdout.buffer

    def send(message):
        answers.write(json.dumps(message).encode() + b"\n")
        answers.flush()

    sys.stdout = sys.stderr  # a stray print must not get between the answers
    for line in iter(requests.readline, b""):
        header = json.loads(line)
        if header["type"] == "hello":
            send(HELLO)
            continue
        arrays = {}
        for entry in header.get("arrays", []):
            dtype = np.dtype(entry["dtype"])
            content = requests.read(dtype.itemsize * int(np.prod(entry["shape"])))
            arrays[entry["name"]] = np.frombuffer(content, dtype).reshape(entry["shape"])
        send({**estimate(header, arrays), "id": header["id"]})


if __name__ == "__main__":
    main()

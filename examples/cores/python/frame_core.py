"""A core of the frame kind: it finds the highlights itself, and takes the reverse of their sightlines as normals.

A highlight is a connected set of pixels above half of the frame's largest value. Its arrays come as files in a folder,
which suits programs that cannot read binary data from standard input. It needs Python 3.9 or later and NumPy.

    simtest core check "python examples/cores/python/frame_core.py"

docs/reference/cores.md describes the protocol.
"""

import json
import sys
from pathlib import Path

import numpy as np

HELLO = {
    "type": "hello", "protocol": 1, "name": "centroid_frame", "version": "1.0", "kind": "frame", "transport": "files",
    "arrays": ["smoothed", "rays"],
}  # fmt: skip
SHARE = 0.5
LEAST_PIXELS = 12


def estimates(light, rays):
    """Return an estimate for each highlight.

    Parameters
    ----------
    light : ndarray, shape (H, W)
        Linear light, smoothed.
    rays : ndarray, shape (H, W, 3)
        Unit sightlines of the pixels' centres, camera frame.
    """
    found = []
    for pixels in connected(light > SHARE * light.max()):
        rows, columns = pixels.T
        inside = (rows > 0).all() and (columns > 0).all()
        inside &= (rows < light.shape[0] - 1).all() and (columns < light.shape[1] - 1).all()
        if len(pixels) < LEAST_PIXELS or not inside:
            continue
        weights = light[rows, columns] / light[rows, columns].sum()
        ray = weights @ rays[rows, columns]
        ray /= np.sqrt(ray @ ray)
        # pixel centres lie at + 0.5
        look = [float(weights @ columns + 0.5), float(weights @ rows + 0.5)]
        found.append({"normal": (-ray).tolist(), "look_px": look})
    return found


def connected(mask):
    """Return the connected sets of a mask's pixels, each as rows and columns, shape (N, 2)."""
    left = set(map(tuple, np.argwhere(mask).tolist()))
    sets = []
    while left:
        border = [left.pop()]
        pixels = list(border)
        while border:
            row, column = border.pop()
            near = {(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)} & left
            left -= near
            border.extend(near)
            pixels.extend(near)
        sets.append(np.array(pixels))
    return sets


def main():
    """Greet, then answer each request in its folder until standard input closes."""
    answers, sys.stdout = sys.stdout, sys.stderr  # a stray print must not get between the answers
    for line in sys.stdin:
        request = json.loads(line)
        if request["type"] == "hello":
            print(json.dumps(HELLO), file=answers, flush=True)
            continue
        folder = Path(request["folder"])
        found = estimates(np.load(folder / "smoothed.npy"), np.load(folder / "rays.npy"))
        if found:
            answer = {"type": "estimates", "id": request["id"], "estimates": found}
        else:
            answer = {"type": "failure", "id": request["id"], "reason": "no_estimate", "detail": "no highlight found"}
        (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")
        print(json.dumps({"type": "done", "id": request["id"]}), file=answers, flush=True)


if __name__ == "__main__":
    main()

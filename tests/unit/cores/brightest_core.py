"""A core of frames that states the reversed sightline of the brightest pixel of the smoothed frame."""

import json
import sys

import numpy as np


def main():
    read, write = sys.stdin.buffer, sys.stdout.buffer
    while line := read.readline():
        asked, arrays = json.loads(line), {}
        if asked["type"] == "hello":
            answer = {
                "type": "hello", "protocol": 1, "name": "brightest", "kind": "frame", "arrays": ["smoothed", "rays"],
            }  # fmt: skip
        else:
            for entry in asked["arrays"]:
                dtype = np.dtype(entry["dtype"])
                content = read.read(dtype.itemsize * int(np.prod(entry["shape"])))
                arrays[entry["name"]] = np.frombuffer(content, dtype).reshape(entry["shape"])
            row, column = np.unravel_index(arrays["smoothed"].argmax(), arrays["smoothed"].shape)
            normal = -arrays["rays"][row, column]
            estimate = {"normal": normal.tolist(), "look_px": [column + 0.5, row + 0.5]}
            answer = {"type": "estimates", "id": asked["id"], "estimates": [estimate]}
        write.write(json.dumps(answer).encode() + b"\n")
        write.flush()


main()

"""A core that writes all it can see of its surroundings, and every byte that it reads, to the file of its argument."""

import json
import os
import struct
import sys

SIZES = {"<f8": 8, "<f4": 4, "<u2": 2, "|u1": 1, "<i4": 4, "|b1": 1}


KIND = "frame" if "--frame" in sys.argv else "patch"
ARRAYS = {
    "patch": ["values", "raw", "noise", "saturated", "seen", "rays", "isophote_0.5"],
    "frame": ["encoded", "channels", "intensity", "smoothed", "noise", "clipped", "seen", "rays"],
}


def main():
    with open(sys.argv[1], "ab") as file:
        tree = [[folder, names, held] for folder, names, held in os.walk(".")]
        # Its own file and the listing's descriptor aside.
        opened = [f for f in os.listdir("/proc/self/fd") if int(f) not in (file.fileno(),)]
        links = {f: os.readlink(f"/proc/self/fd/{f}") for f in opened if os.path.exists(f"/proc/self/fd/{f}")}
        seen = {"argv": sys.argv, "cwd": os.getcwd(), "tree": tree, "environment": dict(os.environ), "open": links}
        file.write(b"SURROUNDINGS " + json.dumps(seen).encode() + b"\n")
        file.flush()
        while line := sys.stdin.buffer.readline():
            file.write(line)
            header = json.loads(line)
            for entry in header.get("arrays", []):
                count = SIZES[entry["dtype"]]
                for length in entry["shape"]:
                    count *= length
                file.write(sys.stdin.buffer.read(count))
            file.flush()
            if header["type"] == "hello":
                answer = {
                    "type": "hello", "protocol": 1, "name": "spy", "version": "1", "kind": KIND, "arrays": ARRAYS[KIND],
                    "isophotes": [0.5] if KIND == "patch" else [],
                }  # fmt: skip
                sys.stdout.buffer.write(json.dumps(answer).encode() + b"\n")
            elif KIND == "frame":
                estimates = [{"normal": [0, 0, -1], "look_px": [100, 75]}]
                told = {"type": "estimates", "id": header["id"], "estimates": estimates}
                sys.stdout.buffer.write(json.dumps(told).encode() + b"\n")
            else:
                normal = struct.pack("<3d", 0, 0, -1)
                listed = [{"name": "normal", "dtype": "<f8", "shape": [3]}]
                told = {"type": "estimate", "id": header["id"], "look_px": header["patch"]["peak_px"], "arrays": listed}
                sys.stdout.buffer.write(json.dumps(told).encode() + b"\n" + normal)
            sys.stdout.buffer.flush()


main()

"""Measure the distances that the page of a run quotes, and write them where it reads them.

    python -m studies.realism_table --frames 24 SCENE=REAL,REAL,... ...

Each SCENE is a shipped one; REAL are the frames, films or folders that it is compared with. Distances of other scenes
stay as they are.
"""

import argparse
import json
from pathlib import Path

from simtest.realism.comparison import compare
from simtest.realism.frame_sets import open_frames, open_generated
from simtest.runtime.files import write_json
from simtest.spec import load_scene
from simtest.validation.situations import MEASURED, MeasuredDistance, look_of


def main() -> None:
    """Measure each scene that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--frames", type=int, default=24, help="frames rendered of each scene")
    options = parser.parse_args()
    held = json.loads(MEASURED.read_text(encoding="utf-8")) if MEASURED.is_file() else {"scenes": []}
    entries: dict[str, MeasuredDistance] = {entry["scene"]: entry for entry in held["scenes"]}
    for text in options.scenes:
        name, _, real = text.partition("=")
        entries[name] = measured(name, [Path(path) for path in real.split(",")], options.frames)
        print(f"{name}: {entries[name]['verdict']}", flush=True)
        write_json(MEASURED, {"scenes": [entries[key] for key in sorted(entries)]})


def measured(name: str, real: list[Path], frames: int) -> MeasuredDistance:
    """Return the entry of a scene."""
    opened = open_frames(real)
    found = compare(opened, open_generated(name, frames))
    judged = [d for d in found.distances if d.verdict != "too few scenes"]
    rows = {d.statistic.name: {"distance": round(d.distance, 2), "verdict": d.verdict} for d in judged}
    return {
        "scene": name,
        "look": look_of(load_scene(name)),
        "real": [frame.name for frame in opened],
        "frames": found.generated.frames,
        "verdict": found.verdict,
        "near": sum(d.verdict == "near" for d in judged),
        "judged": len(judged),
        "statistics": rows,
    }


if __name__ == "__main__":
    main()

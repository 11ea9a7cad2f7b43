"""Print the table of clouds: python -m studies.clouds [--frames FOLDER] [--tuning] [--only GROUP] [--most N].

With `--tuning` the frames that the estimator's constants were set on, else others: of other seeds and viewpoints.
Frames are rendered once, into the folder. `--tissue` takes colons and livers from another seed on, `--most` takes only
so many frames of each group.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from simtest.errors import Failure
from studies.clouds.frames import PICTURE_TABLE, Case, curved, load, plane, tissue
from studies.clouds.scores import MANY, Answer, answers, header, line

TUNING, FIGURES = 1000, 20000
"""Where the seeds begin."""

TUNED_TISSUE, FIGURE_TISSUE = 5500, 21000
"""Where the seeds of colons and livers begin."""

SLOPES, WAVES = (4.0, 5.0, 3.0, 6.0), (1.5, 2.0)


def tuned_tissue() -> dict[str, list[Case]]:
    """Return the tissue that earlier versions were set on, by organ."""
    return {
        "colon": [tissue("colon", TUNED_TISSUE + i) for i in range(70)],
        "liver": [tissue("liver", TUNED_TISSUE + i) for i in range(32)],
    }


def groups(tuning: bool, tissue_first: int = FIGURE_TISSUE) -> dict[str, list[Case]]:
    """Return the cases by group."""
    first, many = (TUNING, 12) if tuning else (FIGURES, 24)
    planes = {f"plane {s:g} deg, {w:g} mm": [plane(s, w, first + i) for i in range(many)] for s, w in PICTURE_TABLE}
    cylinders = [
        curved("cylinder", (0.5, 1.0, -0.3, -0.5)[i % 4], SLOPES[i // 4 % 4], WAVES[i // 2 % 2], first + 100 + i)
        for i in range(16 if tuning else 32)
    ]
    spheres = [
        curved("sphere", (0.3, 0.7, -0.3)[i % 3], SLOPES[i // 3 % 4], WAVES[i // 2 % 2], first + 300 + i)
        for i in range(many)
    ]
    simple = {**planes, "cylinder": cylinders, "sphere": spheres}
    if tuning:
        return {**simple, **tuned_tissue()}
    return {
        **simple,
        "colon": [tissue("colon", tissue_first + i) for i in range(50)],
        "liver": [tissue("liver", tissue_first + i) for i in range(24)],
        "colon, two lights told": [tissue("colon", tissue_first + i, two_lights=True) for i in range(10)],
    }


def judge(cases: Sequence[Case], folder: Path) -> list[list[Answer] | Failure]:
    """Return the answers on each case's frame."""
    made, session = [], None
    for case in cases:
        frame, session = load(case, folder, session)
        made.append(answers(frame))
    return made


def print_table(judged: Mapping[str, Sequence[list[Answer] | Failure]]) -> None:
    """Print the summary: all groups together, and why frames got no answer."""
    every = [made for group in judged.values() for made in group]
    print(line("all", every))
    refused = [made for made in every if isinstance(made, Failure)]
    print(f"{len(refused)} of {len(every)} frames without an answer; the first: {refused[0] if refused else 'none'}")


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.clouds")
    parser.add_argument("--frames", type=Path, default=Path("reports/studies/clouds"))
    parser.add_argument("--tuning", action="store_true")
    parser.add_argument("--tissue", type=int, default=FIGURE_TISSUE, help="where the seeds of colons and livers begin")
    parser.add_argument("--only", default="", help="groups whose name begins so")
    parser.add_argument("--most", type=int, default=None)
    given = parser.parse_args()
    print(f"estimator cloud: answers of clouds with {MANY} spots or more")
    print(header())
    judged = {}
    started, frames = time.process_time(), 0
    chosen = {name: cases for name, cases in groups(given.tuning, given.tissue).items() if name.startswith(given.only)}
    for name, cases in chosen.items():
        judged[name] = judge(cases[: given.most], given.frames)
        frames += len(judged[name])
        print(line(name, judged[name]), flush=True)
    print_table(judged)
    print(f"{(time.process_time() - started) / max(frames, 1):.2f} s of processor a frame, frames read or rendered")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How well `simtest advise` predicts: its mean errors against separate validations of rigs that it was not made with.

    python -m studies.advice studies/advice_rigs.toml OUT [--frames N] [--blocks B] [--rig NAME]... [--seed S]
        [--again-seed S]

Each rig is asked about once, with the default number of frames or N, and again in B blocks of `BLOCK` frames, each
with a seed of its own; the first block of all rigs comes before the second. Both figures are of the method that the
advice calls best. Break-points are left out. OUT/advice.json grows by a rig at a time, and finished runs are kept.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from simtest.advice.advise import MAIN
from simtest.advice.answers import MeanError, read_results
from simtest.advice.plan import DISTANCES, Question, main_experiment, write_experiment
from simtest.advice.scope import read_scope
from simtest.runtime.files import write_json
from simtest.spec.toml_files import read_toml, toml_tables
from simtest.validation.runner import run_experiment

AGREES = 0.15
"""The figures agree where they differ by at most this share of the validation's."""

SEED = 1
"""Default seed of the predictions."""

AGAIN_SEED = 20261123
"""Default seed of the first block of the validations; those of further ones follow."""

BLOCK = 32
"""Frames of a block."""

Asked = tuple[pl.DataFrame, int]
"""Rows of results, and the frames that they are of."""

NUMBERS = 1_000_000
"""Frames of different blocks have numbers so far apart."""


def ask(name: str, rig: dict[str, Any], out: Path, frames: int | None, seed: int) -> Asked:
    """Render the frames of one rig's advice; return their rows and number."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{name}.toml"
    tables: dict[str, Any] = {key: rig[key] for key in ("camera", "rig", "sensor", "relief") if key in rig}
    file.write_text(toml_tables(tables), encoding="utf-8")
    near, far = rig["distances_mm"]
    question = Question(read_scope(str(file)), rig["organ"], (near, far), frames=frames, seed=seed)
    planned = write_experiment(main_experiment(question), out / MAIN)
    return run_experiment(planned, out / "run").results, question.per_distance * DISTANCES


def timed(record: dict[str, Any], key: str, run: Callable[[], Asked]) -> Asked:
    """Return what a run gives; keep in the record the processor time that it took when it was rendered."""
    clock = time.process_time()
    made = run()
    record["process_time_s"].setdefault(key, round(time.process_time() - clock, 1))
    return made


def compare(record: dict[str, Any], asked: Asked, again: list[Asked]) -> None:
    """Write into a rig's record both figures of the best methods."""
    blocks = [rows.with_columns(pl.col("realisation") + NUMBERS * block) for block, (rows, _) in enumerate(again)]
    answer, seen = read_results(*asked), read_results(pl.concat(blocks), sum(frames for _, frames in again))
    record["frames"] = {"predicted": answer.frames, "validated": seen.frames}
    record["figures"] = []
    for choice in answer.choices:
        if choice.best is None:
            continue
        told, measured = answer.method(choice.best).own, seen.method(choice.best).own
        record["figures"].append({
            "target": choice.target, "method": choice.best, "predicted": vars(told), "validated": vars(measured),
            **_compared(told, measured),
        })  # fmt: skip


def _compared(told: MeanError, measured: MeanError) -> dict[str, Any]:
    """Return the prediction over the validation with its 95 % interval, from the widths of both logarithms."""
    if told.mean_deg is None or measured.mean_deg is None:
        return {"ratio": None, "ratio_interval": (None, None), "agrees": None}
    ratio = told.mean_deg / measured.mean_deg
    widths = [told.reach, measured.reach]
    interval: tuple[float | None, float | None] = (None, None)
    if None not in widths:
        factor = math.exp(math.hypot(*[math.log1p(width) for width in widths if width is not None]))
        interval = ratio / factor, ratio * factor
    return {"ratio": ratio, "ratio_interval": interval, "agrees": abs(ratio - 1) <= AGREES}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("rigs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--blocks", type=int, default=2)
    parser.add_argument("--rig", action="append", dest="names")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--again-seed", type=int, default=AGAIN_SEED)
    told = parser.parse_args()
    rigs = read_toml(told.rigs)
    file = told.out / "advice.json"
    done = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    # Each rig's prediction and a first block; then a further block of each rig after the other.
    for blocks in range(1, told.blocks + 1):
        for name in told.names or rigs:
            record = done.setdefault(name, {"process_time_s": {}})
            one = partial(ask, name, rigs[name])
            rows = timed(record, "predicted", partial(one, told.out / name, told.frames, told.seed))
            again = [
                timed(record, f"again_{b}", partial(one, told.out / name / f"again_{b}", BLOCK, told.again_seed + b))
                for b in range(blocks)
            ]
            compare(record, rows, again)
            write_json(file, done)
            print(_text(name, record), flush=True)


def _text(name: str, record: dict[str, Any]) -> str:
    """Return a rig's figures as rows of a table."""
    spent = record["process_time_s"]
    again = sum(seconds for key, seconds in spent.items() if key != "predicted")
    lines = []
    for row in record["figures"]:
        ratio = "–" if row["ratio"] is None else f"{row['ratio']:.2f} {_interval(row['ratio_interval'])}"
        lines.append(
            f"| `{name}` | {row['target']} | `{row['method']}` | {_figure(row['predicted'])} | "
            f"{_figure(row['validated'])} | {ratio} | {spent['predicted']:.0f} / {again:.0f} |"
        )
    return "\n".join(lines) or f"| `{name}` | no method answered |"


def _figure(figure: dict[str, Any]) -> str:
    if figure["mean_deg"] is None:
        return "–"
    return f"{figure['mean_deg']:.3g} {_interval(figure['interval_deg'])}, {figure['answers']} / {figure['frames']}"


def _interval(ends: tuple[float | None, float | None]) -> str:
    low, high = ends
    return "" if low is None or high is None else f"({low:.3g} to {high:.3g})"


if __name__ == "__main__":
    main()

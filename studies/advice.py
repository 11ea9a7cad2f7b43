"""How well `simtest advise` predicts: its mean errors against separate validations of rigs that it was not made with.

    python -m studies.advice studies/advice_rigs.toml OUT [--frames N] [--again M] [--rig NAME]...

Each rig is asked about once with N frames; then its experiment runs again with another seed and M frames. Both figures
are of the method that the advice calls best. OUT/advice.json grows by a rig at a time; what stands there is kept.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from simtest.advice.advise import MAIN, advise
from simtest.advice.figures import MeanError, read_results
from simtest.advice.plan import DISTANCES, Question
from simtest.advice.scope import read_scope
from simtest.runtime.files import write_json
from simtest.spec import load_experiment
from simtest.spec.toml_files import read_toml, toml_tables
from simtest.validation.runner import run_experiment

AGREES = 0.15
"""The figures agree where they differ by at most this share of the validation's."""

AGAIN_SEED = 20261123


def study(name: str, rig: dict[str, Any], out: Path, frames: int, again: int) -> dict[str, Any]:
    """Ask about one rig and validate the answer; return both figures."""
    out.mkdir(parents=True, exist_ok=True)
    tables = {key: rig[key] for key in ("camera", "rig", "sensor", "relief") if key in rig}
    file = out / f"{name}.toml"
    file.write_text(toml_tables(tables), encoding="utf-8")
    near, far = rig["distances_mm"]
    question = Question(read_scope(str(file)), rig["organ"], (near, far), frames=frames, seed=rig.get("seed", 1))
    clock = time.process_time()
    answer = advise(question, out / "advice").found
    spent = time.process_time() - clock
    # The same experiment, other seed, more frames.
    changed = {"seed": AGAIN_SEED, "realisations": max(1, again // DISTANCES)}
    run = run_experiment(load_experiment(out / "advice" / MAIN, changed), out / "again")
    seen = read_results(run.results, again // DISTANCES * DISTANCES)
    rows = []
    for choice in answer.choices:
        if choice.best is None:
            continue
        told, measured = answer.method(choice.best).own, seen.method(choice.best).own
        rows.append({"target": choice.target, "method": choice.best, "predicted": vars(told),
                     "validated": vars(measured), **_compared(told, measured)})  # fmt: skip
    return {"rig": name, "process_time_s": round(spent, 1), "figures": rows}


def _compared(told: MeanError, measured: MeanError) -> dict[str, float | bool | None]:
    """Return by how much the prediction is off, as a share of the validation, and whether their intervals meet."""
    if told.mean_deg is None or measured.mean_deg is None:
        return {"off": None, "agrees": None, "intervals_meet": None}
    off = told.mean_deg / measured.mean_deg - 1
    ends = [end for each in (told, measured) for end in each.interval_deg]
    meet = None
    if all(end is not None for end in ends):
        (low, high), (low_again, high_again) = told.interval_deg, measured.interval_deg
        meet = low <= high_again and low_again <= high  # type: ignore[operator]
    return {"off": off, "agrees": abs(off) <= AGREES, "intervals_meet": meet}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("rigs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--again", type=int, default=96)
    parser.add_argument("--rig", action="append", dest="names")
    told = parser.parse_args()
    rigs = read_toml(told.rigs)
    record = told.out / "advice.json"
    done = json.loads(record.read_text(encoding="utf-8")) if record.is_file() else []
    for name in told.names or rigs:
        if any(each["rig"] == name for each in done):
            continue
        made = study(name, rigs[name], told.out / name, told.frames, told.again)
        done.append(made)
        write_json(record, done)
        for row in made["figures"]:
            print(name, row["target"], row["method"], "predicted", _text(row["predicted"]), "validated",
                  _text(row["validated"]), "off", row["off"], flush=True)  # fmt: skip


def _text(figure: dict[str, Any]) -> str:
    low, high = figure["interval_deg"]
    interval = "" if low is None else f" ({low:.3g} to {high:.3g})"
    return "–" if figure["mean_deg"] is None else f"{figure['mean_deg']:.3g}{interval}, n = {figure['answers']}"


if __name__ == "__main__":
    main()

"""What is written of a fit: the recipe as TOML, and the report as JSON."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.fit import FittedRecipe
from simtest.realism.fitting.parameters import KNOWN
from simtest.realism.fitting.summaries import NAMES
from simtest.runtime.files import Json, write_atomically, write_json
from simtest.spec.recipes import Dataset
from simtest.spec.toml_files import toml_value

UNITS = {kind: unit for kind, _, unit in KNOWN}


def write_fit(found: FittedRecipe, path: Path) -> tuple[Path, Path]:
    """Write the recipe, and the report beside it with the suffix .json; return both paths."""
    report = path.with_suffix(".json")
    write_atomically(path, lambda part: part.write_text(recipe_toml(found.recipe), encoding="utf-8"))
    write_json(report, report_json(found))
    return path, report


def check_out(path: Path) -> None:
    """Raise `InputError` if a recipe cannot be written there: before the fit, which takes long."""
    if path.suffix != ".toml" or path.is_dir():
        raise InputError(f"--out {path}: must be a file whose name ends in .toml")


def recipe_toml(dataset: Dataset) -> str:
    """Return a recipe as a TOML file that `load_dataset` reads back to the same."""
    dumped = dataset.model_dump(mode="json", exclude_none=True, exclude_defaults=True, exclude={"name"})
    families, shared = dumped.pop("families"), dumped.pop("per_sample", {})
    parts = ["".join(f"{key} = {toml_value(value)}\n" for key, value in dumped.items())]
    for family in families:
        tables = {name: family.pop(name) for name in ("set", "per_anatomy", "per_sample") if name in family}
        parts.append("[[families]]\n" + _lines(family))
        parts += [f"[families.{name}]\n{_lines(table)}" for name, table in tables.items() if table]
    if shared:
        parts.append(f"[per_sample]\n{_lines(shared)}")
    return "\n".join(parts)


def _lines(table: Mapping[str, Any]) -> str:
    return "".join(f"{json.dumps(key)} = {toml_value(value)}\n" for key, value in table.items())


def report_json(found: FittedRecipe) -> dict[str, Json]:
    """Return the fit's figures: parameters with intervals, summaries of both sides, and what limits it."""
    return {
        "parameters": [parameter_json(found, number) for number in range(len(found.parameters))],
        "not_told": [p.key for p, told in zip(found.parameters, found.fitted.told, strict=True) if not told],
        "summaries": _summaries(found),
        "gap": found.fitted.gap,
        "notes": found.notes(),
        "scenes": len(found.scenes),
        "bank": {"radiances": len(np.unique(found.bank.radiance)), "pictures": len(found.bank.radiance)},
        "left_out": dict(found.left_out),
    }


def parameter_json(found: FittedRecipe, number: int) -> dict[str, Json]:
    """Return one parameter's centre, spread and 95 % interval, in its own unit."""
    parameter, fitted = found.parameters[number], found.fitted
    centre, low, high = (float(v) for v in parameter.from_unit(
        np.array([fitted.centre[number], *fitted.interval[number]])))  # fmt: skip
    spread = fitted.spread[number] * (parameter.ends[1] - parameter.ends[0])
    return {
        "key": parameter.key,
        "kind": parameter.kind,
        "unit": UNITS[parameter.kind],
        "centre": centre,
        "ci95": [low, high],
        "spread": float(spread),
        "spread_of_logarithm": parameter.prior.log,
        "spread_ci95_shares": [float(v) for v in np.quantile(fitted.spreads[:, number], [0.025, 0.975])],
        "interval_share_of_range": float(np.diff(fitted.interval[number])[0]),
        "told": bool(fitted.told[number]),
        "range_before": [float(end) for end in parameter.prior.ends],
    }


def _summaries(found: FittedRecipe) -> list[Json]:
    """Return of each summary the mean over scenes, what the fitted recipe shows, and the bank's ends."""
    emulator, fitted = found.emulator, found.fitted
    values = np.array(list(found.scenes.values()))
    shown_mean = emulator.mean(fitted.centre)[0] * emulator.scale + emulator.centre
    low, high = found.bank.ends()
    rows: list[Json] = []
    for s, name in enumerate(NAMES):
        told = values[np.isfinite(values[:, s]), s]
        ends = [_plain(low[s]), _plain(high[s])]
        rows.append(
            {
                "name": name,
                "real": _plain(told.mean()) if len(told) else None,
                "fitted": _plain(shown_mean[s]),
                "bank": ends,
                "used": bool(fitted.summaries[s]),
                "in_reach": name not in found.out_of_reach,
            }
        )
    return rows


def _plain(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None

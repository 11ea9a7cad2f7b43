"""Fits a recipe to frames: measures them, makes the bank, infers, narrows the recipe's ranges, and writes it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.realism.compare import Progress, plain
from simtest.realism.fitting.bank import (
    KNOWN,
    Bank,
    RecipeParameter,
    fitted_parameters,
    make_bank,
    missing_kinds,
    narrowed,
)
from simtest.realism.fitting.inference import REPEATS, Emulator, Fitted, infer, learn
from simtest.realism.frames import NamedFrame
from simtest.reconstruction.statistics import NAMES, measure, summarise
from simtest.runtime.arrays import Array
from simtest.runtime.files import Json, write_atomically, write_json, written_together
from simtest.runtime.seeds import from_integer
from simtest.spec import load_scene
from simtest.spec.recipes import Dataset
from simtest.spec.toml_files import toml_value

LEAST_SCENES = 3
"""Of fewer scenes neither a spread nor an interval can be said."""

LEAST_WIDTH = 0.02
"""A fitted range keeps at least this half width, share of the recipe's."""


Seen = tuple[dict[str, Array], set[tuple[int, int]], dict[str, str]]
"""Mean summaries by scene, sizes of frames, and reasons by frame that was left out."""


@dataclass(frozen=True)
class FittedRecipe:
    """What a fit found."""

    recipe: Dataset  # with its ranges narrowed to the fitted distribution
    parameters: list[RecipeParameter]  # what was fitted, with the ranges before
    fitted: Fitted  # as shares of these
    emulator: Emulator
    bank: Bank  # frames over the whole ranges
    scenes: dict[str, Array]  # summaries by scene, shape (S,), the mean over its frames
    sizes: set[tuple[int, int]]  # width and height of the frames, px
    left_out: dict[str, str]  # reason by frame that could not be measured

    @property
    def out_of_reach(self) -> list[str]:
        """Summaries of which most scenes lie outside of all frames of the bank."""
        values = np.array(list(self.scenes.values()))
        low, high = self.bank.ends()
        outside = ((values < low) | (values > high)).mean(axis=0)
        return [name for name, share in zip(NAMES, outside, strict=True) if share > 0.5]

    def notes(self) -> list[str]:
        """Return what limits the fit, a sentence each."""
        notes = []
        if absent := missing_kinds(self.parameters):
            notes.append(f"the recipe draws none of: {', '.join(absent)}; these are not fitted")
        if silent := [name for name, told in zip(NAMES, self.fitted.summaries, strict=True) if not told]:
            notes.append(f"the frames do not tell: {', '.join(silent)}")
        if self.out_of_reach:
            notes.append(f"no frame of the recipe reaches: {', '.join(self.out_of_reach)}")
        family = self.recipe.families[0]
        camera = load_scene(family.scene, family.set).camera
        if self.sizes != {(camera.width, camera.height)}:
            sizes = ", ".join(f"{width} x {height}" for width, height in sorted(self.sizes))
            notes.append(
                f"frames of {sizes} px, the recipe's of {camera.width} x {camera.height}: what is measured in pixels "
                "(halos, noise, spectrum) differs with the size"
            )
        return notes


def summarise_scenes(frames: Sequence[NamedFrame], progress: Progress | None = None) -> Seen:
    """Return the mean summaries of each scene, the sizes of frames, and why frames were left out."""
    held: dict[str, list[Array]] = {}
    sizes, left_out = set(), {}
    for number, frame in enumerate(frames):
        try:
            picture = frame.read()
            summaries = summarise(measure(picture))
            held.setdefault(frame.scene, []).append(summaries)
            sizes.add((picture.shape[1], picture.shape[0]))
        except InputError as error:
            left_out[frame.name] = str(error)
        if progress:
            progress(number + 1, len(frames), f"measuring {frame.name}")
    if len(held) < LEAST_SCENES:
        why = "".join(f"; left out: {name}: {reason}" for name, reason in list(left_out.items())[:1])
        raise InputError(
            f"frames of {len(held)} scene{'s' * (len(held) != 1)}: a fit needs at least {LEAST_SCENES}, and a film is "
            f"one scene{why}"
        )
    return {scene: _mean(np.array(rows)) for scene, rows in held.items()}, sizes, left_out


def _mean(rows: Array) -> Array:
    """Return the mean of each column's known values; NaN where there are none."""
    known = np.isfinite(rows)
    totals = np.where(known, rows, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), totals / np.maximum(known.sum(axis=0), 1), np.nan)


def fit(
    frames: Sequence[NamedFrame],
    dataset: Dataset,
    folder: Path,
    size: int,
    seed: int = 0,
    progress: Progress | None = None,
    repeats: int = REPEATS,
) -> FittedRecipe:
    """Fit a recipe of one family to real frames of at least three scenes, inside the recipe's ranges.

    `folder` is that of the bank of `size` radiances, which is kept: a stopped fit goes on, and another fit of the same
    recipe uses it again. `seed` is that of the inference; the bank's is the recipe's. The intervals are those of
    `repeats` repeated fits.
    """
    parameters = fitted_parameters(dataset)
    seen = summarise_scenes(frames, progress)
    bank = make_bank(dataset, parameters, folder, size, progress=progress)
    return fit_to_bank(seen, dataset, parameters, bank, seed, progress, repeats)


def fit_to_bank(
    seen: Seen,
    dataset: Dataset,
    parameters: list[RecipeParameter],
    bank: Bank,
    seed: int = 0,
    progress: Progress | None = None,
    repeats: int = REPEATS,
) -> FittedRecipe:
    """Fit a recipe to scenes that were measured, with a bank that was made (parameters as in `fit`)."""
    scenes, sizes, left_out = seen
    rng = from_integer(seed)
    emulator = learn(bank, rng, repeats)
    step = None if progress is None else (lambda done, total: progress(done, total, "repeating the fit"))
    fitted = infer(emulator, np.array(list(scenes.values())), rng, repeats, step)
    low, high = ranges(fitted)
    recipe = narrowed(dataset, parameters, low, high)
    return FittedRecipe(recipe, parameters, fitted, emulator, bank, scenes, sizes, left_out)


def ranges(fitted: Fitted) -> tuple[Array, Array]:
    """Return both ends of the fitted ranges, shape (P,), shares of the recipe's.

    They have the fitted mean and deviation; a parameter that the frames do not tell keeps its whole interval.
    """
    half = np.maximum(np.sqrt(3) * fitted.spread, LEAST_WIDTH)
    low = np.where(fitted.told, fitted.centre - half, fitted.interval[:, 0])
    high = np.where(fitted.told, fitted.centre + half, fitted.interval[:, 1])
    return np.clip(low, 0.0, 1.0), np.clip(high, 0.0, 1.0)


# Files ----------------------------------------------------------------------------------------------------------------


def check_out(path: Path) -> None:
    """Raise `InputError` if a recipe cannot be written there: before the fit, which takes long."""
    if path.suffix != ".toml" or path.is_dir():
        raise InputError(f"--out {path}: must be a file whose name ends in .toml")


def write_fit(found: FittedRecipe, path: Path) -> tuple[Path, Path]:
    """Write the recipe, and the report beside it with the suffix .json; return both paths."""
    report = path.with_suffix(".json")
    with written_together(path.parent, (report.name, path.name)) as new:
        write_atomically(new / path.name, lambda part: part.write_text(recipe_toml(found.recipe), encoding="utf-8"))
        write_json(new / report.name, report_json(found))
    return path, report


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
        "parameters": [_parameter(found, number) for number in range(len(found.parameters))],
        "not_told": [p.key for p, told in zip(found.parameters, found.fitted.told, strict=True) if not told],
        "summaries": _summaries(found),
        "gap": found.fitted.gap,
        "notes": found.notes(),
        "scenes": len(found.scenes),
        "bank": {"radiances": len(np.unique(found.bank.radiance)), "pictures": len(found.bank.radiance)},
        "left_out": dict(found.left_out),
    }


def _parameter(found: FittedRecipe, number: int) -> dict[str, Json]:
    """Return one parameter's centre, spread and 95 % interval, in its own unit."""
    parameter, fitted = found.parameters[number], found.fitted
    interval = fitted.interval[number]
    centre, low, high = parameter.from_unit(np.array([fitted.centre[number], *interval])).tolist()
    first, last = parameter.ends
    return {
        "key": parameter.key,
        "kind": parameter.kind,
        "unit": next(unit for kind, _, unit in KNOWN if kind == parameter.kind),
        "centre": centre,
        "ci95": [low, high],
        "spread": float(fitted.spread[number] * (last - first)),
        "spread_of_logarithm": parameter.prior.log,
        "spread_ci95_shares": np.quantile(fitted.spreads[:, number], [0.025, 0.975]).tolist(),
        "interval_share_of_range": float(np.diff(interval)[0]),
        "told": bool(fitted.told[number]),
        "range_before": [float(end) for end in parameter.prior.ends],
    }


def _summaries(found: FittedRecipe) -> list[Json]:
    """Return of each summary the mean over scenes, what the fitted recipe shows, and the bank's ends."""
    emulator, fitted = found.emulator, found.fitted
    real = [column[np.isfinite(column)] for column in np.array(list(found.scenes.values())).T]
    columns = zip(NAMES, real, emulator.mean(fitted.centre)[0] * emulator.scale + emulator.centre, *found.bank.ends(),
                  fitted.summaries, strict=True)  # fmt: skip
    return [
        {
            "name": name,
            "real": plain(values.mean()) if len(values) else None,
            "fitted": plain(shown),
            "bank": [plain(low), plain(high)],
            "used": bool(used),
            "in_reach": name not in found.out_of_reach,
        }
        for name, values, shown, low, high, used in columns
    ]

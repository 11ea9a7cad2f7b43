"""A bank: frames of a recipe over its whole ranges, as parameters and summaries. It is kept, and resumes."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.parameters import Parameter
from simtest.realism.fitting.summaries import NAMES, summarise
from simtest.realism.frame_statistics import measure
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import Json, make_folder, read_json, write_json
from simtest.runtime.provenance import source_hash
from simtest.spec.recipes import Dataset, Splits

if TYPE_CHECKING:
    from simtest.realism.fitting.frames import DrawnFrame

CHAINS = 3
"""Pictures of one radiance: the camera chain is cheap beside it."""

FRAMES_PER_ANATOMY = 5
"""Radiances of one anatomy: making one takes as long as three of them at 640 x 480 px."""

MADE_ANEW = ("surface.recipe", "surface.path", "reflectance.albedo")
"""Keys of which each value is another anatomy, or a pattern of its own, which takes as long."""

Progress = Callable[[int, int, str], None]
"""Called with what is done, how much there is, and what is done now; may raise to stop."""


@dataclass(frozen=True)
class Bank:
    """Frames over the ranges of a recipe.

    Parameters
    ----------
    shares : ndarray, shape (N, P)
        Parameters of each picture as shares of their ranges.
    summaries : ndarray, shape (N, S)
        See `summarise`; NaN where a picture does not tell one.
    radiance : ndarray of int, shape (N,)
        Which pictures are of one radiance.
    """

    shares: Array
    summaries: Array
    radiance: IntArray

    def ends(self) -> tuple[Array, Array]:
        """Return the least and the largest value of each summary, shape (S,); infinite where no picture tells it."""
        known = np.isfinite(self.summaries)
        low = np.where(known, self.summaries, np.inf).min(axis=0)
        return np.asarray(low), np.asarray(np.where(known, self.summaries, -np.inf).max(axis=0))

    def chosen(self, rows: IntArray) -> "Bank":
        """Return the bank of these rows."""
        return Bank(self.shares[rows], self.summaries[rows], self.radiance[rows])


def bank_recipe(dataset: Dataset, size: int) -> Dataset:
    """Return the recipe whose samples are a bank: few of each anatomy, and each with values of its own."""
    family = dataset.families[0]
    kept = {key: one for key, one in family.per_anatomy.items() if key.startswith(MADE_ANEW)}
    moved = {key: one for key, one in family.per_anatomy.items() if key not in kept}
    family = family.model_copy(update={"per_anatomy": kept, "per_sample": {**moved, **family.per_sample}})
    update = {"families": (family,), "samples": size, "samples_per_anatomy": FRAMES_PER_ANATOMY, "highlights": 0}
    return dataset.model_copy(update={**update, "splits": Splits(train=1.0, validation=0.0, test=0.0)})


def make_bank(
    dataset: Dataset,
    parameters: Sequence[Parameter],
    folder: Path,
    size: int,
    chains: int = CHAINS,
    progress: Progress | None = None,
) -> Bank:
    """Render a bank, or what is missing of it.

    Parameters
    ----------
    dataset : Dataset
        Recipe of one family.
    parameters : sequence of Parameter
        What is fitted.
    folder : Path
        Holds a file for each radiance; one that holds another recipe's is refused.
    size, chains : int
        Radiances, and pictures of each.
    progress : callable, optional
        See `Progress`.
    """
    recipe = bank_recipe(dataset, size)
    _claim(recipe, folder, chains)
    maker = None
    for index in range(size):
        path = folder / f"{index:06d}.json"
        if not path.is_file():
            if maker is None:
                # Imported here: a complete bank needs no renderer.
                from simtest.realism.fitting.frames import FrameMaker

                maker = FrameMaker(recipe)
            write_json(path, [_row(frame, parameters) for frame in maker.frames(index, chains)])
        if progress:
            progress(index + 1, size, "rendering the bank")
    return read_bank(folder, size, parameters)


def count_made(folder: Path) -> int:
    """Return how many radiances a folder holds, counted from the first without a gap: those of a stopped bank."""
    count = 0
    while (folder / f"{count:06d}.json").is_file():
        count += 1
    return count


def read_bank(folder: Path, size: int, parameters: Sequence[Parameter]) -> Bank:
    """Read the first `size` radiances of a bank; those that could not be measured are left out."""
    shares, summaries, radiance, reason = [], [], [], ""
    for index in range(size):
        path = folder / f"{index:06d}.json"
        try:
            rows = read_json(path)
            for row in rows:
                told = [np.nan if value is None else value for value in row["summaries"]]
                values = [row["values"][parameter.key] for parameter in parameters]
                if len(told) == len(NAMES):
                    shares.append([float(p.to_unit(np.array(v))) for p, v in zip(parameters, values, strict=True)])
                    summaries.append(told)
                    radiance.append(index)
                else:
                    reason = str(row["left_out"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: no file of a bank ({error}); remove it, and it is made again") from error
    if not shares:
        raise InputError(f"{folder}: the bank holds no frame that can be measured ({reason})")
    return Bank(np.array(shares), np.array(summaries, dtype=float), np.array(radiance))


def _row(frame: "DrawnFrame", parameters: Sequence[Parameter]) -> dict[str, Json]:
    """Return what is kept of a picture."""
    try:
        told: Sequence[float] = summarise(measure(frame.picture)).tolist()
        reason = None
    except InputError as error:
        told, reason = (), str(error)
    values: dict[str, Json] = {parameter.key: frame.values[parameter.key] for parameter in parameters}
    return {"values": values, "summaries": [v if math.isfinite(v) else None for v in told], "left_out": reason}


def _claim(recipe: Dataset, folder: Path, chains: int) -> None:
    """Note what a folder's bank is of, or raise `InputError` if it is of something else."""
    make_folder(folder)
    path = folder / "bank.json"
    # A larger bank of the same recipe goes on from a smaller one only where the plan is the same.
    wanted: dict[str, Any] = {"chains": chains, "recipe": recipe.model_dump(mode="json"), "summaries": list(NAMES)}
    wanted["source"] = source_hash()
    if not path.is_file():
        write_json(path, wanted)
        return
    try:
        held = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; remove the folder") from None
    if held != json.loads(json.dumps(wanted)):
        raise InputError(
            f"{folder}: holds the bank of another recipe, seed, size or release of simtest; remove it or name "
            "another --out"
        )

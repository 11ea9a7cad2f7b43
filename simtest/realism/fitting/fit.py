"""Fits a recipe to frames: measures them, makes the bank, infers, and narrows the recipe's ranges."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.bank import Bank, Progress, make_bank
from simtest.realism.fitting.emulator import Emulator, learn
from simtest.realism.fitting.inference import REPEATS, Fitted, infer
from simtest.realism.fitting.parameters import Parameter, fitted_parameters, missing_kinds, narrowed
from simtest.realism.fitting.summaries import NAMES, summarise
from simtest.realism.frame_sets import NamedFrame
from simtest.realism.frame_statistics import measure
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from simtest.spec import load_scene
from simtest.spec.recipes import Dataset

LEAST_SCENES = 3
"""Of fewer scenes neither a spread nor an interval can be said."""

LEAST_WIDTH = 0.02
"""A fitted range keeps at least this half width, share of the recipe's."""


Seen = tuple[dict[str, Array], set[tuple[int, int]], dict[str, str]]
"""Mean summaries by scene, sizes of frames, and reasons by frame that was left out."""


@dataclass(frozen=True)
class FittedRecipe:
    """What a fit found.

    Parameters
    ----------
    recipe : Dataset
        With its ranges narrowed to the fitted distribution.
    parameters : list of Parameter
        What was fitted, with the ranges before.
    fitted : Fitted
        As shares of these.
    emulator : Emulator
        Of the bank.
    bank : Bank
        Frames over the whole ranges.
    scenes : dict
        Summaries by scene, shape (S,), the mean over its frames.
    sizes : set of (int, int)
        Width and height of the frames, px.
    left_out : dict
        Reason by frame that could not be measured.
    """

    recipe: Dataset
    parameters: list[Parameter]
    fitted: Fitted
    emulator: Emulator
    bank: Bank
    scenes: dict[str, Array]
    sizes: set[tuple[int, int]]
    left_out: dict[str, str]

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
    """Fit a recipe of one family to frames.

    Parameters
    ----------
    frames : sequence of NamedFrame
        Real frames of at least three scenes.
    dataset : Dataset
        The recipe; its ranges are where parameters are looked for.
    folder : Path
        Of the bank, which is kept: a stopped fit goes on, and another fit of the same recipe uses it again.
    size : int
        Radiances of the bank.
    seed : int
        Of the inference; that of the bank is the recipe's.
    progress : callable, optional
        See `Progress`.
    repeats : int
        Repeated fits for the intervals.
    """
    parameters = fitted_parameters(dataset)
    seen = summarise_scenes(frames, progress)
    bank = make_bank(dataset, parameters, folder, size, progress=progress)
    return fit_to_bank(seen, dataset, parameters, bank, seed, progress, repeats)


def fit_to_bank(
    seen: Seen,
    dataset: Dataset,
    parameters: list[Parameter],
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

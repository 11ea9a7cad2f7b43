"""Whether `simtest fit` finds parameters that were planted: 20 recipes of narrow ranges, 30 frames of each.

    python -m studies.fit_plantings --out FOLDER [--plantings 20] [--bank 200]

The recipe is `studies/fit_plantings.toml`, at 320 x 240 px: the fit takes any recipe, and 600 frames at full size take
hours. Each planting draws the middle of its ranges over the middle 70 % of the recipe's, makes its ranges 15 % as wide,
and renders 30 frames of six anatomies that the bank does not hold. Frames are kept in FOLDER as measured summaries, so
a stopped study goes on.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.bank import (
    Bank,
    FrameMaker,
    RecipeParameter,
    count_made,
    fitted_parameters,
    make_bank,
    narrowed,
    one_family,
    read_bank,
)
from simtest.realism.fitting.inference import REPEATS, infer, learn
from simtest.realism.statistics import measure, summarise
from simtest.runtime.arrays import Array
from simtest.runtime.files import write_json
from simtest.runtime.seeds import from_integer
from simtest.spec.recipes import Dataset, SeedRange, Splits, load_dataset

RECIPE = Path(__file__).with_suffix(".toml")
FRAMES, MARGIN, WIDTH = 30, 0.15, 0.15
SEED = 7000


def planted(dataset: Dataset, parameters: list[RecipeParameter], number: int) -> tuple[Dataset, Array]:
    """Return a planting's recipe and the middle of its ranges, shape (P,), shares of the recipe's."""
    middle = from_integer(SEED + number).uniform(MARGIN, 1 - MARGIN, len(parameters))
    recipe = narrowed(dataset, parameters, middle - WIDTH / 2, middle + WIDTH / 2)
    # Anatomies of a range that the bank does not draw from.
    family = recipe.families[0].model_copy(update={"seeds": SeedRange(low=100_000 + 1000 * number, high=2**31)})
    update = {"families": (family,), "samples": FRAMES, "seed": SEED + number, "highlights": 0}
    return recipe.model_copy(update={**update, "splits": Splits(train=1.0, validation=0.0, test=0.0)}), middle


def frames(dataset: Dataset, parameters: list[RecipeParameter], number: int, folder: Path) -> tuple[Array, Array]:
    """Return the summaries of a planting's frames, shape (30, S), and its truth; rendered where they are missing."""
    path = folder / f"planting_{number:02d}.json"
    recipe, middle = planted(dataset, parameters, number)
    if not path.is_file():
        maker, told = FrameMaker(recipe), []
        for index in range(FRAMES):
            picture = next(iter(maker.frames(index, 1))).picture
            told.append([v if np.isfinite(v) else None for v in summarise(measure(picture))])
        write_json(path, told)
    held = json.loads(path.read_text(encoding="utf-8"))
    return np.array([[np.nan if v is None else v for v in row] for row in held], dtype=float), middle


def coverage(dataset: Dataset, parameters: list[RecipeParameter], bank: Bank, folder: Path, numbers: list[int]) -> None:
    """Fit each planting and print how many intervals hold the truth, how wide they are, and the errors of centres."""
    emulator = learn(bank, from_integer(SEED), REPEATS)
    held, widths, errors = [], [], []
    for number in numbers:
        seen, middle = frames(dataset, parameters, number, folder)
        found = infer(emulator, seen, from_integer(SEED + number))
        held.append((found.interval[:, 0] <= middle) & (middle <= found.interval[:, 1]))
        widths.append(found.interval[:, 1] - found.interval[:, 0])
        errors.append(found.centre - middle)
    print(f"{len(numbers)} plantings of {FRAMES} frames; bank of {len(np.unique(bank.radiance))} radiances")
    print("| parameter | intervals that hold the truth | median width, share of the range | RMS error, same |")
    print("|---|---|---|---|")
    for p, parameter in enumerate(parameters):
        inside, width = int(np.sum([row[p] for row in held])), float(np.median([row[p] for row in widths]))
        rms = float(np.sqrt(np.mean([row[p] ** 2 for row in errors])))
        print(f"| {parameter.key} | {inside} of {len(numbers)} | {width:.2f} | {rms:.3f} |")


def main() -> None:
    """Render, fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plantings", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first planting, where several processes share them")
    parser.add_argument("--made", action="store_true", help="judge what is there, and render nothing")
    parser.add_argument("--bank", type=int, default=200)
    told = parser.parse_args()
    told.out.mkdir(parents=True, exist_ok=True)
    dataset = one_family(load_dataset(RECIPE))
    parameters = fitted_parameters(dataset)
    if told.made:
        whole = count_made(told.out / "bank")
        numbers = [n for n in range(told.plantings) if (told.out / f"planting_{n:02d}.json").is_file()]
        coverage(dataset, parameters, read_bank(told.out / "bank", whole, parameters), told.out, numbers)
        return
    bank = make_bank(dataset, parameters, told.out / "bank", told.bank)
    for number in range(told.first, told.plantings):
        try:
            frames(dataset, parameters, number, told.out)
        except InputError as error:
            raise SystemExit(str(error)) from None
        print(f"planting {number}", flush=True)
    coverage(dataset, parameters, bank, told.out, list(range(told.first, told.plantings)))


if __name__ == "__main__":
    main()

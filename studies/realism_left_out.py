"""How well a fitted recipe predicts a scene that the fit did not see, beside the smooth control.

    python -m studies.realism_left_out --frames FOLDER --bank FOLDER --out FOLDER [--made N]

Each real colonoscopic scene is left out in turn, the colon's family of `--recipe` is fitted to the others, and frames
of the fitted recipe are compared with the scene left out. The default recipe, `studies/realism_left_out.toml`, has wide
ranges. The distance of a statistic is the mean Wasserstein distance of a left-out scene and its frames, over the mean
one of a left-out scene and the other real scenes: at 1 the recipe predicts a new scene as well as the other real scenes
do. The real frames stay where they are.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.realism.compare import NEAR, by_scene, quartiles
from simtest.realism.fitting.bank import FrameMaker, count_made, fitted_parameters, make_bank, one_family, read_bank
from simtest.realism.fitting.fit import fit_to_bank, recipe_toml, summarise_scenes
from simtest.realism.frames import open_frames
from simtest.realism.statistics import COLUMNS, STATISTICS, Measured, measure
from simtest.runtime.files import write_json
from simtest.spec.recipes import Dataset, Splits, load_dataset

REAL = ("fig5_a.bmp", "fig7_a.bmp", "hyperkvasir_0qkwl.jpg", "hyperkvasir_0qx73.jpg", "hyperkvasir_0rx1i.jpg")
RECIPE = Path(__file__).with_suffix(".toml")
PER_ANATOMY = 4
QUARTILED = ("per_frame", "radius", "axis_ratio", "clipped")


def made(recipe: Dataset, count: int, path: Path) -> Measured:
    """Return what is measured of frames of a recipe; rendered and kept where the file is missing."""
    if not path.is_file():
        update = {"samples": count, "samples_per_anatomy": PER_ANATOMY, "highlights": 0}
        maker = FrameMaker(recipe.model_copy(update={**update, "splits": Splits(train=1.0, validation=0.0, test=0.0)}))
        rows = [dict(measure(next(iter(maker.frames(index, 1))).picture)) for index in range(count)]
        write_json(path, rows)
    rows = json.loads(path.read_text(encoding="utf-8"))
    return by_scene([("made", {name: np.array(row[name], dtype=float) for name in COLUMNS}) for row in rows])["made"]


def rows_of(real: dict[str, Measured], sets: dict[str, Measured]) -> Iterator[tuple[str, float]]:
    """Yield each statistic's distance; a statistic that fewer than two scenes tell is NaN."""
    from scipy.stats import wasserstein_distance

    for statistic in STATISTICS:
        ratios = []
        for column in (each.name for each in statistic.columns):
            gaps, spreads = [], []
            for scene, values in real.items():
                others = [other[column] for name, other in real.items() if name != scene and len(other[column])]
                if len(values[column]) and others and len(sets[scene][column]):
                    # Each scene weighs the same.
                    weights = np.concatenate([np.full(len(v), 1 / len(v)) for v in others])
                    spreads.append(wasserstein_distance(values[column], np.concatenate(others), v_weights=weights))
                    gaps.append(wasserstein_distance(values[column], sets[scene][column]))
            ratios.append(np.mean(gaps) / np.mean(spreads) if len(gaps) > 1 else np.nan)
        yield statistic.name, float(np.mean(ratios))


def quartile_rows(real: dict[str, Measured], sets: dict[str, Measured]) -> Iterator[str]:
    """Yield whether the median of the frames lies inside the real frames' quartiles."""
    for column in QUARTILED:
        (low, _, high), (_, middle, _) = (quartiles(side, column) or (np.nan,) * 3 for side in (real, sets))
        yield f"{column}: median {middle:.3g}, real quartiles {low:.3g} to {high:.3g}, {low <= middle <= high}"


def main() -> None:
    """Fit, render, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path, required=True, help="folder of the real frames")
    parser.add_argument("--bank", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recipe", default=str(RECIPE), help="whose colon is fitted")
    parser.add_argument("--size", type=int, default=150, help="radiances of the bank")
    parser.add_argument("--stopped", action="store_true", help="take what a stopped bank holds")
    parser.add_argument("--made", type=int, default=20, help="frames of each fitted recipe")
    told = parser.parse_args()
    told.out.mkdir(parents=True, exist_ok=True)
    try:
        frames = open_frames([told.frames / name for name in REAL])
        real = by_scene([(frame.name, measure(frame.read())) for frame in frames])
        dataset, tissue = one_family(load_dataset(told.recipe), "tissue_colon"), {}
        parameters = fitted_parameters(dataset)
        if told.stopped:
            bank = read_bank(told.bank, count_made(told.bank), parameters)
        else:
            bank = make_bank(dataset, parameters, told.bank, told.size)
        for frame in frames:
            seen = summarise_scenes([f for f in frames if f is not frame])
            found = fit_to_bank(seen, dataset, parameters, bank)
            (told.out / f"without_{frame.name}.toml").write_text(recipe_toml(found.recipe), encoding="utf-8")
            tissue[frame.name] = made(found.recipe, told.made, told.out / f"without_{frame.name}.json")
            print(f"without {frame.name}: {'; '.join(found.notes())}", flush=True)
        control = load_dataset("smooth")
        control = control.model_copy(update={"families": control.families[:1]})
        smooth = dict.fromkeys(real, made(control, told.made, told.out / "smooth.json"))
    except InputError as error:
        raise SystemExit(str(error)) from None
    both = list(zip(rows_of(real, tissue), rows_of(real, smooth), strict=True))
    print("| statistic | tissue | smooth |\n|---|---|---|")
    for (name, first), (_, second) in both:
        print(f"| {name} | {first:.2f} | {second:.2f} |")
    for k, name in enumerate(("tissue", "smooth")):
        print(f"{name}: {sum(row[k][1] <= NEAR for row in both)} of {len(both)} at most {NEAR}")
    for name, sets in (("tissue", tissue), ("smooth", smooth)):
        print(name, *quartile_rows(real, sets), sep="\n  ")


if __name__ == "__main__":
    main()

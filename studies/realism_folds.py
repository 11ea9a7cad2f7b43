"""Realism of a recipe on frames that it was not fitted to, in two folds.

    python -m studies.realism_folds FRAMES OLD... --recipe RECIPE --out FOLDER [--size 150] [--frames 24] [--as-it-is]

FRAMES is a folder of frames of colonoscopy, each a scene; OLD are further frames, used in both fits. The first half of
FRAMES by name, rounded up, and OLD are fitted to (`simtest fit`), and frames of the fitted recipe are judged on the
second half; then the halves change places. Frames of one scene in both halves would be seen twice: pairs whose small
pictures correlate by more than `ALIKE` are named. With `--as-it-is` nothing is fitted.

Printed are the 12 distances of `simtest realism` in each fold; what `HIGHLIGHTS` says of highlights, against the
quartiles of the real scenes; the classifier of `studies.realism_classifier` on patches, and the same on whole frames
reduced to `WHOLE` rows, over both folds together: all real scenes against as many generated ones of the recipe that did
not see them; and the largest black share of the view, where no light comes back, of each fold's frames. The pictures
stay in FOLDER.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import print_markdown
from simtest.calibration import Calibration, Frame, Response
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection.colour import ColourDetector
from simtest.geometry import Camera
from simtest.realism.compare import compare, distance_text
from simtest.realism.fitting.bank import FrameMaker, one_family
from simtest.realism.fitting.fit import fit, write_fit
from simtest.realism.frames import NamedFrame, open_frames
from simtest.runtime.arrays import Array, Image
from simtest.spec.recipes import Dataset, load_dataset
from studies.realism_classifier import Scenes, crops_of, features, same_way, separation

ALIKE, WHOLE = 0.9, 96
HIGHLIGHTS = ("area in the largest tenth", "distance to the nearest", "run of dry ground")
"""Share of the highlights' area above half height; median over highlights, over the view's width; mean length of the
rows' runs without a highlight, over the width, each weighted by its length."""


def main() -> None:
    """Fit, generate and judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", type=Path)
    parser.add_argument("old", type=Path, nargs="*")
    parser.add_argument("--recipe", default="endoscopy_close")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=150, help="radiances of the fit's bank")
    parser.add_argument("--count", type=int, default=24, help="generated frames of each fold")
    parser.add_argument("--as-it-is", action="store_true")
    options = parser.parse_args()
    frames, old = open_frames([options.frames]), open_frames(options.old)
    for pair in alike([*frames, *old]):
        print("alike:", *pair)
    recipe = one_family(load_dataset(options.recipe), "tissue_colon")
    half = (len(frames) + 1) // 2
    folds = ((frames[:half], frames[half:]), (frames[half:], frames[:half]))
    made: list[list[NamedFrame]] = []
    table = [["statistic", *(f"fold {i + 1}, {len(judged)} scenes" for i, (_, judged) in enumerate(folds))]]
    columns, shares = [], []
    for number, (seen, judged) in enumerate(folds, 1):
        of = recipe if options.as_it_is else fitted(recipe, [*old, *seen], options, number)
        black = generate(of, options.count, options.out / f"fold{number}", number == 2)
        made.append(open_frames([options.out / f"fold{number}"]))
        found = compare(judged, made[-1])
        columns.append([f"{distance_text(d.distance)}, {d.verdict}" for d in found.distances])
        shares.append(f"{100 * max(black):.2f} %")
        print(f"fold {number}: {found.verdict}", flush=True)
    names = [d.statistic.name for d in found.distances]
    print_markdown([*table, *map(list, zip(names, *columns, strict=True)), ["black, largest share of a view", *shares]])
    print_markdown(highlight_rows(frames, [each for fold in made for each in fold]))
    report_classifiers(folds, made)


def fitted(recipe: Dataset, seen: Sequence[NamedFrame], options: argparse.Namespace, number: int) -> Dataset:
    """Fit a recipe, and write it; both folds use one bank."""
    found = fit(seen, recipe, options.out / "bank", options.size)
    write_fit(found, options.out / f"fold{number}.toml")
    print(f"fold {number}: fitted to {len(found.scenes)} scenes; {'; '.join(found.notes())}", flush=True)
    return found.recipe


def generate(recipe: Dataset, count: int, folder: Path, shift: bool) -> list[float]:
    """Write frames of a recipe, each of an anatomy of its own, and return the black share of each one's view."""
    folder.mkdir(parents=True, exist_ok=True)
    maker = FrameMaker(recipe.model_copy(update={"samples_per_anatomy": 1, "samples": 2 * count, "highlights": 0}))
    black = []
    for index in range(count):
        drawn = next(maker.frames(index + count * shift, 1))
        shown = np.rint(255 * np.clip(drawn.picture, 0, 1)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{index:03d}.png"), shown[..., ::-1])
        session = maker._session
        assert session is not None
        light, camera = session.radiance().total, session.camera
        lit = np.asarray((light > 0).any(axis=-1))
        seen = camera.view_mask.contains(camera.pixel_centres()) if camera.view_mask else np.ones_like(lit)
        black.append(float(np.mean(~lit[seen])))
    return black


def alike(frames: Sequence[NamedFrame]) -> Iterator[tuple[str, str, str]]:
    """Return the pairs of frames that look alike, with the correlation of their small grey pictures."""
    small = [cv2.resize(frame.read().mean(axis=-1), (32, 32), interpolation=cv2.INTER_AREA).ravel() for frame in frames]
    between = np.corrcoef(small)
    for i, j in zip(*np.nonzero(np.triu(between, 1) > ALIKE), strict=True):
        yield frames[i].name, frames[j].name, f"{between[i, j]:.2f}"


def of_highlights(picture: Image) -> Array:
    """Return the numbers `HIGHLIGHTS` of a frame, shape (3,); NaN without two highlights."""
    height, width = picture.shape[:2]
    calibration = Calibration(Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0)
    found = ColourDetector(isolated=False).detect(Frame(picture, calibration, DEFAULT_SMOOTHING_PX), calibration.camera)
    assert found.view is not None
    seen = np.ones((height, width), bool) if found.view.seen is None else found.view.seen
    across = float(np.ptp(np.nonzero(seen.any(axis=0))[0]) + 1)
    peaks, wet = np.array([each.region.peak for each in found.highlights], float), np.zeros((height, width), bool)
    areas = np.array([each.area_px for each in found.highlights], float)
    if len(peaks) < 2:
        return np.full(3, math.nan)
    gaps = np.linalg.norm(peaks[:, None] - peaks, axis=-1) + np.diag(np.full(len(peaks), np.inf))
    for (column, row), area in zip(peaks.astype(int), areas, strict=True):
        cv2.circle(wet.view(np.uint8), (int(column), int(row)), max(round(math.sqrt(area / math.pi)), 1), 1, -1)
    dry = seen & ~wet
    ends = np.diff(np.pad(dry, ((0, 0), (1, 1))).astype(int), axis=1)
    runs = np.nonzero(ends < 0)[1] - np.nonzero(ends > 0)[1]
    largest = np.sort(areas)[-max(len(areas) // 10, 1) :].sum() / areas.sum()
    return np.array([largest, np.median(gaps.min(axis=1)) / across, (runs**2).sum() / runs.sum() / across])


def highlight_rows(real: Sequence[NamedFrame], generated: Sequence[NamedFrame]) -> list[list[str]]:
    """Return the table of `HIGHLIGHTS`: quartiles of the real frames, and the generated median."""
    held, shown = (np.array([of_highlights(each.read()) for each in side]) for side in (real, generated))
    low, middle, high = np.nanquantile(held, (0.25, 0.5, 0.75), axis=0)
    median = np.nanmedian(shown, axis=0)
    rows = [
        [name, f"{a:.3f}, {b:.3f}, {c:.3f}", f"{m:.3f}", "inside" if a <= m <= c else "outside"]
        for name, a, b, c, m in zip(HIGHLIGHTS, low, middle, high, median, strict=True)
    ]
    return [["highlights", "real quartiles", "generated median", ""], *rows]


def report_classifiers(
    folds: Sequence[tuple[Sequence[NamedFrame], Sequence[NamedFrame]]], made: Sequence[Sequence[NamedFrame]]
) -> None:
    """Print the AUC of all real scenes against as many generated ones that were fitted to the others."""
    real = [each for _, judged in folds for each in judged]
    generated = [each for (_, judged), fold in zip(folds, made, strict=True) for each in fold[: len(judged)]]
    height = min(frame.read().shape[0] for frame in (*real, *generated))
    patches = [crops_of(side, height) for side in (real, generated)]
    whole: list[Scenes] = [
        {each.scene: features(same_way(each.read(), WHOLE))[None] for each in side} for side in (real, generated)
    ]
    rows = [["classifier", "scenes", "AUC (95 %)"]]
    for name, (first, second) in (("patches", patches), ("whole frames", whole)):
        value, low, high = separation(first, second)
        rows.append([name, f"{len(first)} and {len(second)}", f"{value:.2f} ({low:.2f} to {high:.2f})"])
    print_markdown(rows)


if __name__ == "__main__":
    main()

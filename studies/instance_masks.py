"""Masks of highlights in datasets against a region growing that shares no code with them.

    python -m studies.instance_masks [--samples WET SMOOTH]

Samples of the recipe `highlights` (wet tissue) and of `highlights_smooth` are made as datasets make them, and their
scenes are rendered again. `instance`: from the maximum uphill from a highlight's point, in the lobe's float radiance,
the pixels of at least half of the peak are grown by scipy.ndimage; the peak is that maximum, or, where it is more, the
brightest of 100 x 100 rays through a pixel's area around the point. `visible`: all pixels above half of a peak behind
the lens, shared out among the peaks from the brightest pixel on by a queue. A mask agrees if the IoU is at least 0.9
from 20 pixels on, or the numbers of pixels differ by at most 1 below. The table also says how many isolated highlights
have no pixel: "clipped" where the lobe's peak is above full scale, else "dim".
"""

import argparse
import heapq
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from benchmarks.measuring import print_markdown
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session
from simtest.rendering.rays import Sightlines
from simtest.runtime.arrays import AnyArray, Array, Image, IntArray, Mask
from simtest.spec import Scene
from simtest.spec.recipes import load_dataset

RECIPES = ("highlights", "highlights_smooth")
SAMPLES = (200, 100)

DIVISION = 100
"""Rays along a pixel's side."""

LEAST_IOU, LARGE_PX, OFF_PX = 0.9, 20, 1


@dataclass(frozen=True)
class Compared:
    """A mask of a highlight beside that of the region growing; a null mask has the reason `missing`."""

    recipe: str
    field: str
    where: str
    pixels: int
    expected: int
    both: int
    missing: str | None = None

    @property
    def iou(self) -> float:
        """Shared pixels over those of either; 1 where neither has any."""
        either = self.pixels + self.expected - self.both
        return self.both / either if either else 1.0

    @property
    def agrees(self) -> bool:
        """Whether the masks agree, as the study's head says; a null one only with an empty region."""
        if not self.pixels or not self.expected:
            return self.pixels == self.expected and self.missing is not None
        return self.iou >= LEAST_IOU if self.expected >= LARGE_PX else abs(self.pixels - self.expected) <= OFF_PX


def grown(image: Image, seed: tuple[int, int], level: float) -> Mask:
    """Return the pixels of at least a level that are connected with a seed by their sides."""
    pieces, _ = ndimage.label(image >= level)
    return np.asarray((pieces == pieces[seed]) & (pieces > 0))


def uphill(image: Image, start: tuple[int, int]) -> tuple[int, int]:
    """Return the local maximum to which the way from pixel to brightest neighbour leads."""
    row, column = start
    while True:
        around = [(image[r, c], r, c) for r in range(max(row - 1, 0), min(row + 2, image.shape[0]))
                  for c in range(max(column - 1, 0), min(column + 2, image.shape[1]))]  # fmt: skip
        value, up, along = max(around)
        if value <= image[row, column]:
            return row, column
        row, column = up, along


def shared_out(image: Image, peaks: IntArray) -> IntArray:
    """Return whose each pixel is, from 1, 0 for none's: of peaks, rows and columns, shape (N, 2), the brightest first.

    From the brightest pixel on, each goes to the peak from which it is reached; what is below half of that peak then,
    or cut off from it, goes to none.
    """
    owner = np.zeros(image.shape, dtype=np.int64)
    owner[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    half = image[tuple(peaks.T)] / 2
    queue = [(-float(image[r, c]), number, int(r), int(c), number + 1) for number, (r, c) in enumerate(peaks)]
    heapq.heapify(queue)
    order, done = len(queue), np.zeros(image.shape, dtype=bool)
    while queue:
        _, _, row, column, number = heapq.heappop(queue)
        if done[row, column] or owner[row, column] not in (0, number):
            continue
        done[row, column], owner[row, column] = True, number
        for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            inside = 0 <= r < image.shape[0] and 0 <= c < image.shape[1]
            if inside and not owner[r, c] and image[r, c] >= half.min():
                heapq.heappush(queue, (-float(image[r, c]), order, r, c, number))
                order += 1
    kept = np.zeros_like(owner)
    for number, (row, column) in enumerate(peaks, 1):
        kept[grown(np.where(owner == number, image, 0), (row, column), half[number - 1])] = number
    return kept


def peak_of(session: Session, point_px: Array) -> float:
    """Render a pixel's area around a point with many rays, and return the lobe's brightest."""
    camera, corner, size = session.camera, point_px - 0.5, DIVISION
    x, y = (camera.cx - corner[0]) * DIVISION, (camera.cy - corner[1]) * DIVISION
    close = replace(
        camera, fx=camera.fx * DIVISION, fy=camera.fy * DIVISION, cx=x, cy=y, width=size, height=size, view_mask=None
    )
    sightlines = Sightlines(close, session.surface.model_from_camera)
    parts, _ = session._tracer(sightlines).centres(None, True, None)
    # Of an instrument in front, too.
    channels = len(parts) // (2 if session.scene.instruments else 1) // 2
    return float(np.mean(parts[:channels], axis=0).max())


def behind_lens(specular: Image, scene: Scene) -> Image:
    """Return light behind the lens, in view: the point spread, then vignetting by a power of the cosine."""
    sensor, camera = scene.sensor, scene.camera.model()
    if sensor.point_spread_px:
        specular = ndimage.gaussian_filter(specular, sensor.point_spread_px, mode="mirror", truncate=6.0)
    cosine = camera.unproject(camera.pixel_centres().reshape(-1, 2))[:, 2].reshape(specular.shape)
    shown = True if camera.seen is None else camera.seen
    return np.where(shown, specular * cosine**sensor.vignetting.power, 0.0)


def compared(recipe: str, samples: int) -> Iterator[Compared]:
    """Compare all masks of the first samples of a recipe."""
    maker = Maker(Plan(load_dataset(recipe, {"samples": samples})))
    for index in range(samples):
        sample = maker.make(index)
        # It stands at the sample's scene.
        session, meta = maker._session, sample.meta
        assert session is not None
        specular = _mean(session.radiance().specular)
        yield from _instances(recipe, index, session, meta["highlights"], sample.images["instance"], specular)
        spots = meta.get("visible_highlights", [])
        at = np.array([spot["peak_px"] for spot in spots]).reshape(-1, 2)[:, ::-1].astype(int)
        light = behind_lens(specular, session.scene)
        expected = shared_out(light, at) if spots else np.zeros(light.shape, dtype=int)
        for number in range(1, len(spots) + 1):
            yield _masks(recipe, "visible", f"{index}/{number - 1}", sample.images["visible"] == number,
                         expected == number)  # fmt: skip
        # The maker drops it before the next anatomy's.
        del session


def _instances(
    recipe: str, index: int, session: Session, highlights: list[Any], instance: AnyArray, specular: Image
) -> Iterator[Compared]:
    taken = np.zeros(specular.shape, dtype=bool)
    isolated = [(number, own, peak_of(session, np.array(own["bp_px"]))) for number, own in enumerate(highlights)
                if own["isolated"]]  # fmt: skip
    # The brightest first, so that it has the pixels that two claim.
    for number, own, peak in sorted(isolated, key=lambda each: -each[2]):
        seed = uphill(specular, (int(own["bp_px"][1]), int(own["bp_px"][0])))
        expected = grown(specular, seed, max(peak, float(specular[seed])) / 2) & ~taken
        taken |= expected
        missing = None
        if own["region"]["instance_px"] is None:
            missing = "clipped" if own["region"]["lobe_peak"] > 1 else "dim"
        yield _masks(recipe, "instance", f"{index}/{number}", instance == number + 1, expected, missing)


def _masks(recipe: str, field: str, where: str, mask: Mask, expected: Mask, missing: str | None = None) -> Compared:
    pixels = (int(np.count_nonzero(each)) for each in (mask, expected, mask & expected))
    return Compared(recipe, field, where, *pixels, missing)


def _mean(image: Image) -> Array:
    return np.asarray(image if image.ndim == 2 else image.mean(axis=2), dtype=float)


def main() -> None:
    """Compare the masks and print how many agree."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--samples", type=int, nargs=2, default=SAMPLES, help="of the wet and of the smooth recipe")
    parser.add_argument("--all", action="store_true", help="list every mask that does not agree")
    options = parser.parse_args()
    head = ["recipe", "field", "highlights", f"{LARGE_PX} px and more", "least IoU of these", "agree", "null"]
    rows, off = [[*head, "clipped", "dim"]], []
    for recipe, samples in zip(RECIPES, options.samples, strict=True):
        found = list(compared(recipe, samples))
        for field in ("instance", "visible"):
            own = [each for each in found if each.field == field]
            large = [each for each in own if each.expected >= LARGE_PX]
            nulls = [each.missing for each in own if not each.pixels]
            least = min((each.iou for each in large), default=1.0)
            counts = (len(own), len(large), f"{least:.3f}", sum(each.agrees for each in own))
            rows.append([recipe, field, *map(str, (*counts, len(nulls), nulls.count("clipped"), nulls.count("dim")))])
        off += [each for each in found if not each.agrees]
    print_markdown(rows)
    for each in off if options.all else off[:20]:
        print(f"{each.recipe} {each.field} {each.where}: {each.pixels} px, grown {each.expected}, both {each.both}")


if __name__ == "__main__":
    main()

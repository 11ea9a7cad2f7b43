"""Draw a frame with its true normals, those of a dense network, their error and their stated deviation.

python -m studies.learned_dense_picture data/highlights scenes/learning/weights/learned_dense.onnx FILE [INDEX]...

Each sample of the test split named by its index is a row; by default the first frame of each organ.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from simtest.dataset.reader import read_samples
from simtest.dataset.shard import Sample
from simtest.errors import Failure
from simtest.estimators.learned_dense import LearnedDense
from simtest.geometry.vectors import angle_deg
from simtest.pages.pixels import normal_colours
from simtest.runtime.arrays import Array, Picture
from studies.networks.examples import DENSE_FIELDS, sample_frame

SIZE = (256, 192)
HEAD_PX, GAP_PX, QUALITY = 24, 4, 85
ERROR_END_DEG, DEVIATION_END_DEG = 30.0, 30.0
HEADS = ("frame", "true normal, base", "estimated", f"error, 0 to {ERROR_END_DEG:g} deg",
         f"stated deviation, 0 to {DEVIATION_END_DEG:g} deg")  # fmt: skip
EMPTY = (60, 64, 70)


def main() -> None:
    """Write the picture."""
    data, model, out = sys.argv[1:4]
    wanted = [int(index) for index in sys.argv[4:]]
    rows, families = [_heads()], set()
    for sample in read_samples(data, "test", DENSE_FIELDS):
        family = sample.meta["anatomy"]["family"]
        if sample.index in wanted or (not wanted and family not in families):
            rows.append(_joined(list(_panels(sample, LearnedDense(model)))))
            families.add(family)
    picture = np.concatenate(rows)[:, :, ::-1]
    cv2.imwrite(str(Path(out)), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _panels(sample: Sample, estimator: LearnedDense) -> Iterator[Picture]:
    """Yield the panels of a row; print the frame's median error."""
    frame = sample_frame(sample)
    maps = estimator.maps(frame.encoded, frame.calibration)
    true = sample.images["normal_base"].astype(float)
    if isinstance(maps, Failure):
        raise SystemExit(f"sample {sample.index}: refused ({maps.detail})")
    error = angle_deg(maps.normal.astype(float), true)
    deviation = np.degrees(np.sqrt(np.trace(maps.covariance, axis1=2, axis2=3)))
    print(
        f"sample {sample.index}: median error {np.nanmedian(error):.1f} deg, stated {np.nanmedian(deviation):.1f} deg"
    )
    yield _small(sample.images["image"])
    yield _small(normal_colours(true, EMPTY))
    yield _small(normal_colours(maps.normal.astype(float), EMPTY))
    yield _small(_shares(error / ERROR_END_DEG))
    yield _small(_shares(deviation / DEVIATION_END_DEG))


def _shares(values: Array) -> Picture:
    levels = np.rint(255 * np.clip(np.nan_to_num(values), 0, 1)).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_CIVIDIS)[:, :, ::-1].copy()
    colours[~np.isfinite(values)] = EMPTY
    return np.asarray(colours, np.uint8)


def _small(picture: Picture) -> Picture:
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def _heads() -> Picture:
    """Return the row of captions."""
    made = []
    for text in HEADS:
        panel = np.full((HEAD_PX, SIZE[0], 3), 255, np.uint8)
        cv2.putText(panel, text, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (20, 20, 20), 1, cv2.LINE_AA)
        made.append(panel)
    return _joined(made)


def _joined(panels: list[Picture]) -> Picture:
    gap = np.full((len(panels[0]), GAP_PX, 3), 255, np.uint8)
    parts = [part for panel in panels for part in (panel, gap)][:-1]
    row = np.concatenate(parts, axis=1)
    return np.concatenate([row, np.full((GAP_PX, row.shape[1], 3), 255, np.uint8)])


if __name__ == "__main__":
    main()

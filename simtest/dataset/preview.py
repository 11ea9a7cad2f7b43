"""A contact sheet of a dataset: frames, normals, depth, curvature, highlights, and what was drawn how often."""

import base64
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import polars as pl
from jinja2 import Environment, PackageLoader, StrictUndefined

from simtest.dataset.index import HIGHLIGHTS, SAMPLES
from simtest.dataset.reader import Record, open_manifest, read, shard_names
from simtest.errors import InputError
from simtest.runtime.files import write_atomically

Array = npt.NDArray[Any]

WIDTH = 240
"""Of a thumbnail, px."""

CURVATURE_END = 0.15
"""Curvature, 1/mm, at which the colours end."""

MAX_SAMPLES = 500

_FRAME_COLOUR, _HIGHLIGHT_COLOUR = "#0072B2", (245, 217, 10)


@dataclass(frozen=True)
class Card:
    """One sample on the page: its caption, and pictures with their titles, as data addresses."""

    title: str
    caption: str
    pictures: list[tuple[str, str]]


def write_preview(folder: Path, page: Path, count: int = 24) -> Path:
    """Write the page.

    Parameters
    ----------
    folder : Path
        A finished dataset's.
    page : Path
        HTML file to write.
    count : int
        How many samples to show, evenly over the dataset, 1 to 500.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the folder holds no finished dataset, the number is out of range, or the page cannot be written.
    """
    if not 1 <= count <= MAX_SAMPLES:
        raise InputError(f"--samples {count}: must be 1 to {MAX_SAMPLES}")
    shard_names(folder)
    manifest = open_manifest(folder)
    index, highlights = (pl.read_parquet(folder / name) for name in (SAMPLES, HIGHLIGHTS))
    wanted = set(index["index"].gather_every(max(1, index.height // count)).head(count).to_list())
    names = index.filter(pl.col("index").is_in(list(wanted)))["shard"].unique().to_list()
    shown = (record for record in read(folder, shards=sorted(names)) if record["meta"]["index"] in wanted)
    environment = Environment(
        loader=PackageLoader("simtest.dataset", "."), undefined=StrictUndefined, autoescape=True, trim_blocks=True
    )
    html = environment.get_template("preview.html.j2").render(
        title=manifest.dataset["title"] or manifest.dataset["name"],
        description=manifest.dataset["description"],
        facts=_facts(index, highlights),
        histograms=list(_histograms(index, highlights)),
        cards=[_card(record) for record in sorted(shown, key=lambda r: int(r["meta"]["index"]))],
    )
    try:
        write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--out {page}: cannot be written ({error.strerror})") from error
    return page


def _facts(index: pl.DataFrame, highlights: pl.DataFrame) -> list[tuple[str, str]]:
    by_split = index.group_by("split", maintain_order=True).len().sort("split")
    isolated, sizes = highlights.filter(pl.col("isolated")).height, index["bytes"].to_numpy()
    return [
        ("samples", f"{index.height} ({', '.join(f'{split} {n}' for split, n in by_split.rows())})"),
        ("anatomies", str(index.select("family", "anatomy").unique().height)),
        ("highlights", f"{highlights.height}, of them {isolated} isolated"),
        ("frames without an isolated one", str(index.filter(pl.col("n_isolated") == 0).height)),
        ("size", f"{sizes.sum() / 1e6:.1f} MB, {np.median(sizes) / 1e6:.2f} MB a sample"),
    ]


# Pictures -----------------------------------------------------------------------------------------------------------


def _card(record: Record) -> Card:
    meta = record["meta"]
    isolated = [highlight for highlight in meta["highlights"] if highlight["isolated"]]
    drawn = ", ".join(f"{key} = {_short(value)}" for key, value in sorted(meta["drawn"].items()))
    return Card(
        f"{meta['index']}: {meta['anatomy']['surface']}, {meta['split']}",
        f"{len(isolated)} isolated of {len(meta['highlights'])} highlights; {drawn}",
        [
            ("frame, isolated highlights outlined", _address(_outlined(record))),
            ("normal, as colour (x, y, z)", _address(_normal_colours(record["normal"]))),
            ("depth, near is bright", _address(_depth_colours(record["depth"]))),
            (f"curvature k_max, -{CURVATURE_END} to {CURVATURE_END} per mm", _address(_curvature_colours(record))),
        ],
    )


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _outlined(record: Record) -> Array:
    image = np.ascontiguousarray(record["image"])
    regions = (record["instance"] > 0).astype(np.uint8)
    contours, _ = cv2.findContours(regions, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, _HIGHLIGHT_COLOUR, max(1, image.shape[1] // WIDTH))
    return image


def _normal_colours(normal: Array) -> Array:
    colours = np.rint(127.5 * (1 + normal * np.array([1, -1, -1])))
    return np.nan_to_num(colours, nan=0.0).astype(np.uint8)


def _depth_colours(depth: Array) -> Array:
    low, high = np.nanpercentile(depth, (1, 99))
    share = 1 - np.clip((np.nan_to_num(depth, nan=high) - low) / max(high - low, 1e-9), 0, 1)
    return np.asarray(cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)[:, :, ::-1])


def _curvature_colours(record: Record) -> Array:
    share = np.clip(np.nan_to_num(record["curvature"][..., 1], nan=0.0) / CURVATURE_END, -1, 1)[..., None]
    convex, concave, middle = np.array([213, 94, 0]), np.array([0, 114, 178]), np.array([245, 245, 245])
    colours = middle + np.abs(share) * (np.where(share > 0, convex, concave) - middle)
    return np.asarray(np.rint(colours).astype(np.uint8))


def _address(image: Array) -> str:
    """Give a picture as a data address, made small."""
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    small = cv2.resize(np.ascontiguousarray(image), (WIDTH, height), interpolation=cv2.INTER_AREA)
    ok, data = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    assert ok
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


# Distributions ------------------------------------------------------------------------------------------------------


def _histograms(index: pl.DataFrame, highlights: pl.DataFrame) -> Iterator[tuple[str, str]]:
    """Give a histogram's title and picture for each quantity."""
    isolated = highlights.filter(pl.col("isolated"))
    lights = {row["index"]: row["drawn"] for row in index.select("index", "drawn").iter_rows(named=True)}
    offsets = isolated.select("index", "distance_mm").iter_rows()
    eps = [found / d for i, d in offsets if (found := _offset(lights[i])) is not None]
    shown: tuple[tuple[str, Iterable[float], str], ...] = (
        ("smaller curvature of isolated highlights", isolated["kd_min"], "k_min d"),
        ("larger curvature of isolated highlights", isolated["kd_max"], "k_max d"),
        ("distance of isolated highlights", isolated["distance_mm"], "d, mm"),
        ("light offset over distance", eps, "eps / d"),
        ("isolated highlights a frame", index["n_isolated"], "number"),
    )
    for title, values, label in shown:
        numbers = np.asarray([v for v in values if v is not None], dtype=float)
        if len(numbers) and np.ptp(numbers) > 0:
            yield title, _histogram(numbers, label)


def _offset(drawn: str) -> float | None:
    import json

    return next((v for k, v in json.loads(drawn).items() if k == "rig.lights.0.offset_mm"), None)


def _histogram(numbers: Array, label: str) -> str:
    from matplotlib.figure import Figure

    # The few farthest would squeeze all others into one bar; they are counted in the outer bars.
    low, high = np.percentile(numbers, (0.5, 99.5)) if len(numbers) > 200 else (numbers.min(), numbers.max())
    figure = Figure(figsize=(4.2, 2.6), dpi=110, layout="constrained")
    axes = figure.subplots()
    axes.hist(np.clip(numbers, low, high), bins=min(40, max(8, int(len(numbers) ** 0.5))), color=_FRAME_COLOUR)
    axes.set_xlabel(label)
    axes.set_ylabel("count")
    axes.spines[["top", "right"]].set_visible(False)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()

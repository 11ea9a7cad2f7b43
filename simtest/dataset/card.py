"""The dataset card, a README for people whose head Hugging Face `datasets` reads, and the contact sheet."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import polars as pl
from jinja2 import Environment, PackageLoader, StrictUndefined

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.dataset.index import HIGHLIGHTS, SAMPLES, TABLES
from simtest.dataset.manifest import NAME, Manifest
from simtest.dataset.metadata import has_relief
from simtest.dataset.plan import Plan
from simtest.dataset.reader import open_manifest, read_samples, read_table, shard_names
from simtest.dataset.shard import Sample
from simtest.errors import InputError
from simtest.pages import style
from simtest.pages.charts import Axis, Chart, Mark, Panel, embedded
from simtest.pages.html import environment
from simtest.pages.markdown import escaped, paragraphs, yaml_string
from simtest.pages.pixels import jpeg_address, normal_colours
from simtest.runtime.arrays import AnyArray
from simtest.runtime.files import write_atomically
from simtest.spec.recipes import Distribution

CARD = "README.md"


def write_card(plan: Plan, manifest: Manifest, lacking: str, folder: Path) -> None:
    """Write the card."""
    text = make_card(plan, manifest, lacking)
    write_atomically(folder / CARD, lambda part: part.write_text(text, encoding="utf-8"))


def make_card(plan: Plan, manifest: Manifest, lacking: str = "") -> str:
    """Return the card's text, which depends on the dataset alone; `lacking` is its `shortfall`."""
    dataset = plan.dataset
    # samples and shards of each split
    counts: dict[str, list[int]] = {name: [0, 0] for name in plan.splits}
    for shard in plan.shards:
        counts[shard.split][0] += len(shard.indices)
        counts[shard.split][1] += 1
    # Markdown, not HTML, so what a recipe says is escaped where it stands.
    templates = Environment(  # nosec B701
        loader=PackageLoader("simtest.dataset", "."), undefined=StrictUndefined, autoescape=False, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    templates.filters.update(escaped=escaped, paragraphs=paragraphs, yaml=yaml_string)
    return templates.get_template("card.md.j2").render(
        dataset=dataset,
        counts=counts,
        made_small=plan.made_small,
        lacking=lacking,
        fields=plan.fields,
        has_relief=plan.has_relief,
        has_instruments=plan.has_instruments,
        draws=list(_draws(plan)),
        tables=TABLES,
        meshes=sorted({path.name for path in plan.inputs if path.suffix != ".toml"}),
        isovalue=HIGHLIGHT_ISOVALUE,
        versions=manifest.origin["versions"],
        variant=manifest.origin["variant"],
    )


def _draws(plan: Plan) -> Iterator[tuple[str, str, str]]:
    """Yield how often each drawn key is drawn, the key, and from what."""
    dataset = plan.dataset
    for number, family in enumerate(dataset.families):
        where = f"family {number} ({family.scene}), each"
        yield from ((f"{where} anatomy", key, _describe(drawn)) for key, drawn in family.per_anatomy.items())
        yield from ((f"{where} sample", key, _describe(drawn)) for key, drawn in family.per_sample.items())
    yield from (("each sample", key, _describe(drawn)) for key, drawn in dataset.per_sample.items())


def _describe(drawn: Distribution) -> str:
    if drawn.choose:
        weights = f", weights {list(drawn.weights)}" if drawn.weights else ""
        return f"one of {list(drawn.choose)}{weights}"
    kind = "whole numbers" if drawn.integer else "even in the logarithm" if drawn.log else "even"
    return f"{drawn.low:g} to {drawn.high:g}, {kind}"


WIDTH = 240
"""Width of a thumbnail, px."""

CURVATURE_END = 0.15
"""Curvature, 1/mm, at which the colour scale ends."""

MAX_SAMPLES = 500

_HIGHLIGHT_COLOUR = style.rgb(style.TRUTH)


def write_preview(folder: Path, page: Path, count: int = 24) -> Path:
    """Write the contact sheet of a finished dataset as an HTML page; return its path.

    `count` samples are shown, 1 to 500, evenly over the dataset. Raises `InputError` if the folder holds no finished
    dataset, the number is out of range, or the page cannot be written.
    """
    if not 1 <= count <= MAX_SAMPLES:
        raise InputError(f"--samples {count}: must be 1 to {MAX_SAMPLES}")
    shard_names(folder)
    manifest = open_manifest(folder)
    index = read_table(folder / SAMPLES)
    # A file of them after the other, since all highlights may be more than memory holds.
    files = [folder / name for name in manifest.tables if name.startswith(HIGHLIGHTS)]
    if not files:
        raise InputError(f"{folder / NAME}: lists no file of {HIGHLIGHTS}; simtest dataset verify --repair mends it")
    columns = ["index", "isolated", "distance_mm", "kd_min", "kd_max"]
    isolated = pl.concat(read_table(file, columns).filter(pl.col("isolated")) for file in files)
    # samples, evenly over the dataset, and the shards that hold them
    places = np.linspace(0, index.height - 1, min(count, index.height)).round().astype(int)
    wanted = set(index["index"].sort()[places.tolist()].to_list())
    names = index.filter(pl.col("index").is_in(list(wanted)))["shard"].unique().to_list()
    shown = read_samples(folder, shards=sorted(names), indices=wanted)
    charts = list(_histograms(index, isolated))
    html = (
        environment()
        .get_template("preview.html.j2")
        .render(
            title=manifest.dataset["title"] or manifest.dataset["name"],
            description=manifest.dataset["description"],
            facts=_facts(index),
            charts=charts,
            **embedded(charts),
            cards=[_card(sample) for sample in sorted(shown, key=lambda sample: sample.index)],
        )
    )
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _facts(index: pl.DataFrame) -> list[tuple[str, str]]:
    by_split = index.group_by("split", maintain_order=True).len().sort("split")
    sizes = index["bytes"].to_numpy()
    return [
        ("samples", f"{index.height} ({', '.join(f'{split} {n}' for split, n in by_split.rows())})"),
        ("anatomies", str(index.select("family", "anatomy").unique().height)),
        ("highlights", f"{index['n_highlights'].sum()}, of them {index['n_isolated'].sum()} isolated"),
        ("frames without an isolated one", str(index.filter(pl.col("n_isolated") == 0).height)),
        ("size", f"{sizes.sum() / 1e6:.1f} MB, {np.median(sizes) / 1e6:.2f} MB a sample"),
    ]


# Pictures -----------------------------------------------------------------------------------------------------------


def _card(sample: Sample) -> tuple[str, str, list[tuple[str, str]]]:
    """Return the title of a sample, its caption, and its pictures as data URLs with their titles."""
    meta, images = sample.meta, sample.images
    isolated = [highlight for highlight in meta["highlights"] if highlight["isolated"]]
    base = []
    if has_relief(meta):
        base = [("normal of the base, without the relief", _data_url(normal_colours(images["normal_base"])))]
    if meta.get("instrument_share"):
        base.append(("instruments, by number", _data_url(_instrument_colours(images["instrument"]))))
    drawn = ", ".join(f"{key} = {_short(value)}" for key, value in sorted(meta["drawn"].items()))
    return (
        f"{meta['index']}: {meta['anatomy']['surface']}, {meta['split']}",
        f"{len(isolated)} isolated of {len(meta['highlights'])} highlights; {drawn}",
        [
            ("frame, isolated highlights outlined", _data_url(_outlined(images["image"], images["instance"]))),
            ("normal, as colour (x, y, z)", _data_url(normal_colours(images["normal"]))),
            *base,
            ("depth, near is bright", _data_url(_depth_colours(images["depth"]))),
            (
                f"curvature k_max, -{CURVATURE_END} to {CURVATURE_END} per mm",
                _data_url(_curvature_colours(images["curvature"])),
            ),
        ],
    )


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _outlined(image: AnyArray, instance: AnyArray) -> AnyArray:
    image = np.ascontiguousarray(image)
    regions = (instance > 0).astype(np.uint8)
    contours, _ = cv2.findContours(regions, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, _HIGHLIGHT_COLOUR, max(1, image.shape[1] // WIDTH))
    return image


def _instrument_colours(instrument: AnyArray) -> AnyArray:
    # Grey steps, none is black.
    return np.repeat(np.where(instrument > 0, 255 - 24 * (instrument - 1), 0).astype(np.uint8)[..., None], 3, axis=2)


def _depth_colours(depth: AnyArray) -> AnyArray:
    low, high = np.nanpercentile(depth, (1, 99))
    # Percentiles, so that a few far pixels do not use up the scale
    share = 1 - np.clip((np.nan_to_num(depth, nan=high) - low) / max(high - low, 1e-9), 0, 1)
    return np.asarray(cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)[:, :, ::-1])


def _curvature_colours(curvature: AnyArray) -> AnyArray:
    share = np.clip(np.nan_to_num(curvature[..., 1], nan=0.0) / CURVATURE_END, -1, 1)[..., None]
    convex, concave, middle = np.array([213, 94, 0]), np.array([0, 114, 178]), np.array([245, 245, 245])
    colours = middle + np.abs(share) * (np.where(share > 0, convex, concave) - middle)
    return np.asarray(np.rint(colours).astype(np.uint8))


def _data_url(image: AnyArray) -> str:
    """Return a picture as a thumbnail's data URL."""
    height = max(1, round(image.shape[0] * WIDTH / image.shape[1]))
    small = cv2.resize(np.ascontiguousarray(image), (WIDTH, height), interpolation=cv2.INTER_AREA)
    return jpeg_address(np.asarray(small, np.uint8), 82)


# Distributions ------------------------------------------------------------------------------------------------------


def _histograms(index: pl.DataFrame, isolated: pl.DataFrame) -> Iterator[Chart]:
    """Yield the histogram of each quantity that varies."""
    # Light offsets are drawn for each sample, distances belong to its highlights.
    offsets = {i: json.loads(drawn).get("rig.lights.0.offset_mm") for i, drawn in index.select("index", "drawn").rows()}
    distances = isolated.select("index", "distance_mm").rows()
    eps = [offsets[i] / distance for i, distance in distances if offsets[i] is not None]
    shown: tuple[tuple[str, Iterable[float], str], ...] = (
        ("smaller curvature of isolated highlights", isolated["kd_min"], "k_min d"),
        ("larger curvature of isolated highlights", isolated["kd_max"], "k_max d"),
        ("distance of isolated highlights", isolated["distance_mm"], "d, mm"),
        ("light offset over distance", eps, "eps / d"),
        ("isolated highlights a frame", index["n_isolated"], "number"),
    )
    for number, (title, values, label) in enumerate(shown):
        numbers = np.asarray([v for v in values if v is not None], dtype=float)
        if not len(numbers) or np.ptp(numbers) == 0:
            continue
        # The few largest and smallest would squeeze all others into one bar; they count in the outer bars.
        low, high = np.percentile(numbers, (0.5, 99.5)) if len(numbers) > 200 else (numbers.min(), numbers.max())
        bins = min(40, max(8, int(len(numbers) ** 0.5)))
        counts, edges = np.histogram(np.clip(numbers, low, high), bins)
        # The outline of the bars; the counts of each are told at its corners.
        outline = Mark(np.repeat(edges, 2), np.pad(np.repeat(counts, 2), 1), style.SERIES[0], line="solid", hover="{y}")
        panel = Panel(Axis(label), Axis("count", limits=(0.0, 1.05 * float(counts.max()))), (outline,))
        yield Chart(f"histogram-{number}", title, (panel,), 240)

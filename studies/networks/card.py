"""The card of a network: what it is, what it was made of, and where it holds.

All of it is read from the network's own file, so the card of a copy is made again from the copy.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import polars as pl
import torch
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from onnx import TensorProto, numpy_helper

from simtest.dataset.index import SAMPLES
from simtest.dataset.manifest import NAME
from simtest.dataset.reader import open_manifest
from simtest.estimators.learned import METADATA
from simtest.pages.markdown import escaped, paragraphs
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject, write_atomically
from studies.networks.training import Recipe, Trained

MEASURED = "## Measured on unseen anatomies"
"""Heading of the card's last part, which people write; what stands below it is kept when the card is made again."""

LONGEST_AXIS = 8
"""Characters of the name of an axis."""

LEAST_SHOWN = 1e-9
"""Values of a range below this are rounding errors."""

NOT_MEASURED = "Nothing yet. State the command with each figure, and how often the test split was used."


def origin_of(recipe: Recipe, data: Path, trained: Trained) -> dict[str, str]:
    """Return what a network was made of, each a text: dataset, versions, training, figures on the validation split."""
    manifest = open_manifest(data)
    table = pl.read_parquet(data / SAMPLES, columns=["split", "family", "anatomy", "surface"])
    counts = {
        str(split): [len(part), part.select("family", "anatomy").n_unique()]
        for (split,), part in table.group_by("split", maintain_order=True)
    }
    described = {key: manifest.dataset.get(key) for key in ("name", "title", "seed")}
    described |= {"scenes": [str(family["scene"]) for family in manifest.plan().dataset.model_dump()["families"]]}
    figures = {key: value for key, value in trained.history[trained.best].items() if key != "train_loss"}
    return {
        "dataset": data.name,
        "dataset_sha256": provenance.file_hash(data / NAME),
        "recipe": json.dumps({**described, "splits": counts}),
        "dataset_simtest": str(manifest.origin["versions"].get("simtest")),
        "simtest": provenance.version(),
        "torch": str(torch.__version__),
        "training": json.dumps(asdict(recipe)),
        "epochs": str(len(trained.history)),
        "best_epoch": str(trained.best + 1),
        "validation": json.dumps(figures),
    }


def write_card(model: Path) -> Path:
    """Write the card of a network beside it, with the ending ``.md``; return its path.

    What stands below the heading `MEASURED` in a card that is there already is kept.
    """
    path = model.with_suffix(".md")
    before = path.read_text(encoding="utf-8") if path.is_file() else ""
    measured = before.partition(f"\n{MEASURED}\n")[2].lstrip("\n") or f"{NOT_MEASURED}\n"
    text = f"{make_card(model)}\n\n{measured}"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def make_card(model: Path) -> str:
    """Return the card's text up to the heading `MEASURED`, which it ends with."""
    data = model.read_bytes()
    content = onnx.load_from_string(data)
    metadata = json.loads({each.key: each.value for each in content.metadata_props}[METADATA])
    about = metadata["about"]
    environment = Environment(  # nosec B701
        loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, autoescape=False,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(escaped=escaped, paragraphs=paragraphs)
    low, high = metadata["low"], metadata["high"]
    return environment.get_template("model.md.j2").render(
        name=model.name, size=len(data), digest=hashlib.sha256(data).hexdigest(), measured=MEASURED, about=about,
        training=json.loads(about["training"]), recipe=json.loads(about["recipe"]),
        validation=_figures(json.loads(about["validation"])),
        ranges=[(name, _number(low[name]), _number(high[name])) for name in low], **_shape(content),
    )  # fmt: skip


def _shape(model: onnx.ModelProto) -> JsonObject:
    """Return inputs and outputs with their shapes, and how many weights there are, and how many in 16 and 8 bits."""
    counts: Counter[int] = Counter()
    for tensor in model.graph.initializer:
        counts[tensor.data_type] += int(np.prod(numpy_helper.to_array(tensor).shape))
    weights = counts[TensorProto.FLOAT] + counts[TensorProto.FLOAT16] + counts[TensorProto.INT8]
    sides = {"inputs": model.graph.input, "outputs": model.graph.output}
    shapes = {side: [f"{each.name} {_sizes(each)}" for each in values] for side, values in sides.items()}
    return {**shapes, "weights": weights, "halved": counts[TensorProto.FLOAT16], "stepped": counts[TensorProto.INT8]}


def _sizes(value: onnx.ValueInfoProto) -> str:
    # Axes of any length have the name that the export gave them; PyTorch makes up long names for those that it derives.
    sides = value.type.tensor_type.shape.dim
    sizes = [str(side.dim_value) if side.dim_value else side.dim_param for side in sides]
    return f"({', '.join(size if len(size) <= LONGEST_AXIS else '?' for size in sizes)})"


def _number(value: float) -> str:
    return f"{value if abs(value) >= LEAST_SHOWN else 0:.4g}"


def _figures(values: Mapping[str, float]) -> list[tuple[str, str]]:
    return [("loss" if name == "validation_loss" else name, f"{value:.4g}") for name, value in values.items()]

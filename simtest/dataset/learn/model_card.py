"""The card of a network: what it is, what it was made of, and where it holds. One form for own and shipped networks.

All of it is read from the network's own file, so the card of a copy is made again from the copy.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import polars as pl
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined
from onnx import TensorProto, numpy_helper

from simtest.dataset.index import SAMPLES
from simtest.dataset.learn.checkpoint import State
from simtest.dataset.learn.engine import history_table
from simtest.dataset.learn.training import Training
from simtest.dataset.manifest import NAME
from simtest.dataset.reader import open_manifest
from simtest.errors import InputError
from simtest.pages.markdown import escaped, paragraphs
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject, require_plain, write_atomically
from simtest.runtime.onnx_model import METADATA

MEASURED = "## Measured on unseen anatomies"
"""Heading of the card's last part, which people write; what stands below it is kept when the card is made again."""

LONGEST_AXIS = 8
"""Characters of the name of an axis."""

LEAST_SHOWN = 1e-9
"""Values of a range below this are rounding errors."""

NOT_MEASURED = "Nothing yet. State the command with each figure, and how often the test split was used."


def origin_of(training: Training, data: Path) -> dict[str, str]:
    """Return what a network is about to be made of, each a text: dataset, versions, training.

    Raises `InputError` if the folder holds no finished dataset.
    """
    manifest = open_manifest(data)
    try:
        table = pl.read_parquet(require_plain(data / SAMPLES), columns=["split", "family", "anatomy", "surface"])
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(f"{data / SAMPLES}: cannot be read ({error!s:.80})") from None
    counts = {
        str(split): [len(part), part.select("family", "anatomy").n_unique()]
        for (split,), part in table.group_by("split", maintain_order=True)
    }
    recipe = manifest.dataset
    described = {key: recipe.get(key) for key in ("name", "title", "seed")}
    described |= {"scenes": [str(family["scene"]) for family in manifest.plan().dataset.model_dump()["families"]]}
    return {
        "dataset": str(data.name),
        "dataset_sha256": provenance.file_hash(data / NAME),
        "recipe": json.dumps({**described, "splits": counts}),
        "dataset_simtest": str(manifest.origin["versions"].get("simtest")),
        "simtest": provenance.version(),
        "torch": str(torch.__version__),
        "training": training.model_dump_json(),
    }


def validation_of(state: State) -> dict[str, str]:
    """Return which epoch was kept, and its figures on the validation split, as a text each."""
    row = dict(history_table(state)[state.best])
    epoch, figures = row.pop("epoch"), {key: value for key, value in row.items() if key != "train_loss"}
    return {"epochs": str(len(state.history)), "best_epoch": str(epoch), "validation": json.dumps(figures)}


def write_card(model: Path) -> Path:
    """Write the card of a network beside it, with the ending ``.md``; return its path.

    What stands below the heading `MEASURED` in a card that is there already is kept.

    Raises `InputError` if the file is no network of `simtest train`.
    """
    path = model.with_suffix(".md")
    text = f"{make_card(model)}\n\n{_measured(path)}"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def make_card(model: Path) -> str:
    """Return the card's text up to the heading `MEASURED`, which it ends with."""
    try:
        data = require_plain(model).read_bytes()
        content = onnx.load_from_string(data)
        metadata = json.loads({each.key: each.value for each in content.metadata_props}[METADATA])
        about = metadata["about"]
        training = json.loads(about["training"])
    except Exception as error:  # of protobuf, which shares no base with the others
        reason = f"{type(error).__name__}: {error!s:.80}"
        raise InputError(f"{model}: is no network of simtest train ({reason})") from None
    environment = Environment(  # nosec B701
        loader=PackageLoader("simtest.dataset.learn", "."), undefined=StrictUndefined, autoescape=False,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(escaped=escaped, paragraphs=paragraphs)
    return environment.get_template("model.md.j2").render(
        name=model.name, size=len(data), digest=hashlib.sha256(data).hexdigest(), measured=MEASURED, about=about,
        training=training, training_toml=_toml(training), recipe=json.loads(about.get("recipe", "null")),
        validation=_figures(json.loads(about.get("validation", "{}"))), ranges=_ranges(metadata), **_shape(content),
    )  # fmt: skip


def _measured(path: Path) -> str:
    """Return what stands below the heading `MEASURED` in a card, or that nothing does."""
    if not path.is_file():
        return f"{NOT_MEASURED}\n"
    _, heading, rest = path.read_text(encoding="utf-8").partition(f"\n{MEASURED}\n")
    return rest.lstrip("\n") if heading and rest.strip() else f"{NOT_MEASURED}\n"


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


def _ranges(metadata: Mapping[str, JsonObject]) -> list[tuple[str, str, str]]:
    """Return name, smallest and largest value of each input whose range the network knows."""
    low, high = metadata.get("low", {}), metadata.get("high", {})
    return [(name, _number(low[name]), _number(high[name])) for name in low if name in high]


def _number(value: float) -> str:
    return f"{value if abs(value) >= LEAST_SHOWN else 0:.4g}"


def _figures(values: Mapping[str, float]) -> list[tuple[str, str]]:
    names = {"validation_loss": "loss"}
    return [(names.get(name, name), f"{value:.4g}") for name, value in values.items()]


def _toml(training: Mapping[str, object]) -> str:
    """Return a training as the text of its file, which `simtest train` takes."""
    # Numbers, texts and booleans of JSON are those of TOML, but for a sign that TOML wants escaped.
    values = {key: json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f") for key, value in training.items()}
    return "\n".join(f"{key} = {value}" for key, value in values.items() if key != "name")

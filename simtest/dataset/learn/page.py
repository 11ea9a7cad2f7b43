"""The page of a training: curves, figures and origin, as training.json and one HTML file."""

from pathlib import Path

import numpy as np

from simtest.dataset.learn.checkpoint import State
from simtest.dataset.learn.engine import history_table
from simtest.dataset.learn.training import Training
from simtest.pages.charts import Axis, Chart, Mark, Panel, embedded, png
from simtest.pages.html import environment
from simtest.pages.style import NEUTRAL, colours, symbols
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json

PAGE, RESULT = "index.html", "training.json"

_SPLITS = {"train_loss": "train split, while it learned", "validation_loss": "validation split"}


def write_page(training: Training, state: State, out: Path, data: str, command: str = "") -> Path:
    """Write what a training came to, finished or not, into its folder; return the page.

    `data` is the dataset as it was named, `command` how the training was called.
    """
    charts = _charts(state)
    make_folder(out / "figures")
    for chart in charts:
        _write_png(out / "figures" / f"{chart.key}.png", chart)
    made_by = provenance.environment()
    record = {"data": data, "command": command, **made_by}
    rows = history_table(state)
    content = {"training": training.model_dump(mode="json"), "best_epoch": state.best + 1, "epochs": rows}
    write_json(out / RESULT, {**content, "run": record})
    text = environment().get_template("training.html.j2").render(
        training=training, rows=rows, best=state.best, charts=charts, data=data, command=command,
        provenance={"commit": made_by["commit"] or "–", "simtest": made_by["version"], "python": made_by["python"]},
        **embedded(charts),
    )  # fmt: skip
    write_atomically(out / PAGE, lambda part: part.write_text(text, encoding="utf-8"))
    return out / PAGE


def _write_png(path: Path, chart: Chart) -> None:
    content = png([chart])
    write_atomically(path, lambda part: part.write_bytes(content))


def _charts(state: State) -> list[Chart]:
    """Return the losses, and each metric, over the epochs."""
    rows = history_table(state)
    x = np.arange(1, len(rows) + 1)
    colour_of = colours(_SPLITS)
    losses = tuple(
        Mark(x, [row[key] for row in rows], colour_of[key], name, line="solid",
             hover="epoch {x}: {y}")
        for key, name in _SPLITS.items()
    )  # fmt: skip
    made = [Chart("loss", "Loss", (Panel(Axis("epoch"), Axis("loss"), (*losses, *_best(state))),))]
    names = [name for name in (rows[0] if rows else ()) if name not in ("epoch", *_SPLITS)]
    for number, name in enumerate(names):
        curve = Mark(x, [row[name] for row in rows], colour_of["validation_loss"], line="solid",
                     hover="epoch {x}: {y}")  # fmt: skip
        panel = Panel(Axis("epoch"), Axis(name), (curve,))
        made.append(Chart(f"metric-{number + 1}", name, (panel,), height=300))
    return made


def _best(state: State) -> tuple[Mark, ...]:
    """Return the mark of the epoch whose weights are kept."""
    if state.best < 0:
        return ()
    loss = state.history[state.best].validation_loss
    return (Mark([state.best + 1], [loss], NEUTRAL, "kept", symbol=symbols(["kept"])["kept"], size=10),)

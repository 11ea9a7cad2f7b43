"""The results of a run, as a notebook holds them: table, summary and page, read when they are asked for."""

import json
import warnings
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import polars as pl

MOST_SETTINGS = 12
"""Settings that a notebook lists."""


@dataclass(frozen=True, repr=False)
class RunResults:
    """What `simtest.validate` made.

    It stands for its page where a path is wanted: ``open(results)`` and ``str(results)``.

    Parameters
    ----------
    page : Path
        index.html of the run.

    Examples
    --------
    >>> from pathlib import Path
    >>> import simtest
    >>> simtest.RunResults(Path("reports/runs/overview/index.html")).folder.name
    'overview'
    """

    page: Path

    @property
    def folder(self) -> Path:
        """Folder of the run: results.parquet, summary.json, guide.json, figures/, index.html."""
        return self.page.parent

    @cached_property
    def results(self) -> "pl.DataFrame":
        """results.parquet: a row for each realisation, specularity and estimator (docs/howto/experiments.md)."""
        import polars as pl

        return pl.read_parquet(self.folder / "results.parquet", hive_partitioning=False)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """summary.json: provenance, and the figures of each experiment, setting and estimator."""
        read: dict[str, Any] = json.loads((self.folder / "summary.json").read_text(encoding="utf-8"))
        return read

    def warn_of_faults(self) -> None:
        """Warn of each error inside an estimator or a core, with its text and the number of rows that it cost."""
        faults = [fault for held in self.summary["experiments"].values() for fault in held.get("faults") or ()]
        if faults:
            # Loaded where there is one: a finished run that is asked for again should answer at once.
            from simtest.validation.run_summary import Fault

            for fault in faults:
                warnings.warn(str(Fault(**fault)), RuntimeWarning, stacklevel=3)

    def __fspath__(self) -> str:
        return str(self.page)

    def __str__(self) -> str:
        return str(self.page)

    def __repr__(self) -> str:
        each = ", ".join(
            f"{name}: {len(held['settings'])} settings, {len(_estimators(held))} estimators"
            for name, held in list(self.summary["experiments"].items())[:2]
        )
        return f"RunResults({each}; page {str(self.page)[-120:]})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: median errors by setting and estimator, and the first figure."""
        from simtest.pages.notebook import note_html, table_html
        from simtest.pages.style import number

        parts = []
        for name, held in self.summary["experiments"].items():
            names, settings = _estimators(held), list(held["settings"].items())
            rows = [
                (setting, *(number(figures.get(each, {}).get("median_deg")) for each in names))
                for setting, figures in settings[:MOST_SETTINGS]
            ]
            left = len(settings) - len(rows)
            parts.append(f"<b>{escape(name)}</b>" + note_html("Median error (deg) of the answers, by setting"))
            parts.append(
                table_html(("setting", *names), rows) + (note_html(f"and {left} more settings") if left else "")
            )
        figure = next(iter(sorted((self.folder / "figures").glob("*.png"))), None)
        return "".join(parts) + (_figure(figure) if figure else "") + note_html(f"Page: {self.page}")


def _estimators(held: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(name for figures in held["settings"].values() for name in figures))


def _figure(path: Path) -> str:
    """Return a figure of the run as an image element."""
    import cv2
    import numpy as np

    from simtest.pages.notebook import picture_html

    read = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return "" if read is None else picture_html(np.asarray(cv2.cvtColor(read, cv2.COLOR_BGR2RGB), np.uint8), path.stem)

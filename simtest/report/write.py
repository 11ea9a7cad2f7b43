"""Writes the page of a run, where it is not up to date: what it was made of stands in a note at its end."""

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

from simtest.pages import WRITTEN
from simtest.runtime.files import write_atomically, write_json
from simtest.runtime.provenance import file_hash, package_versions, source_hash, versions

GUIDE = "guide.json"
"""File of a run folder with the rows of its page's first table."""

_OPEN, _CLOSE = "<!-- made of ", " -->\n"
_PACKAGE = Path(__file__).resolve().parents[1]
_TEMPLATES = ("*.j2", "*.json", "*.toml")
# Whose versions change a page, beside those that change results.
_DRAWING = ("pillow", "jinja2", "matplotlib", "trimesh", "vl-convert-python")


def page_key(run: Path) -> str:
    """Return a hash of all that a run's page is made of: results, summary, frames, simtest's code, and versions.

    Files that are missing count as such; `read_run` refuses them.
    """
    files = [run / "results.parquet", run / "summary.json", *sorted((run / "gallery").glob("[!.]*.npz"))]
    content = {str(file.relative_to(run)): file_hash(file) if file.is_file() else None for file in files}
    return _hash({"files": content, "code": _code(), "versions": versions() | package_versions(_DRAWING)})


def signed(html: str, key: str, charts: bool, figures: Mapping[str, str], guide: str) -> str:
    """Return a page with its note: key, whether charts are files, SHA-256 of page, files of figures, and `GUIDE`."""
    digest = hashlib.sha256(html.encode()).hexdigest()
    content = {"key": key, "charts": charts, "page": digest, "guide": guide, "figures": dict(sorted(figures.items()))}
    note = json.dumps(content, separators=(",", ":"))
    return f"{html}{_OPEN}{note}{_CLOSE}"


def is_up_to_date(run: Path, key: str, charts: bool = False) -> bool:
    """Return whether a run's page was made of what `key` stands for, and it and all its figures are still as made.

    With `charts` only where they are files too.
    """
    try:
        html, found, end = (run / "index.html").read_text(encoding="utf-8").rpartition(_OPEN)
        if not found or not end.endswith(_CLOSE):
            return False
        note = json.loads(end.removesuffix(_CLOSE))
        if note["key"] != key or note["page"] != hashlib.sha256(html.encode()).hexdigest():
            return False
        if charts and not note["charts"]:
            return False
        if file_hash(run / GUIDE) != note["guide"]:
            return False
        return all(file_hash(run / "figures" / name) == digest for name, digest in note["figures"].items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


@cache
def _code() -> str:
    """Return a hash of simtest's source and of what its pages are filled into."""
    files = sorted(file for pattern in _TEMPLATES for file in _PACKAGE.rglob(pattern))
    return _hash({"source": source_hash()} | {str(file.relative_to(_PACKAGE)): file_hash(file) for file in files})


def _hash(content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and what is done."""


def write_report(run: Path, progress: Progress | None = None, charts: bool = False) -> Path:
    """Write the page of a run and the pictures of its frames; what is up to date stays as it is.

    Parameters
    ----------
    run : pathlib.Path
        Run folder with results.parquet, summary.json and, if there is one, gallery/*.npz.
    progress : callable, optional
        Called with steps done, steps in all (a figure or frame each, and the page), and what is done; what it raises
        stops the report, and the page stays the earlier one.
    charts : bool
        Whether the charts, which the page draws, are written as PNG files too.

    Returns
    -------
    pathlib.Path
        ``run/index.html``. Beside it, ``run/guide.json`` and ``run/figures/*.png`` are written anew; pictures of an
        earlier report go.
    """
    run = Path(run)
    page, key = run / "index.html", page_key(run)
    if is_up_to_date(run, key, charts):
        return page
    # Imported here: a page that is up to date needs none of what draws it.
    from simtest.report.page import draw_page, guide_json
    from simtest.report.run_folder import read_run

    if progress:
        progress(0, 1, "reading the results")
    data = read_run(run)
    folder = run / "figures"
    folder.mkdir(exist_ok=True)
    html, figures, steps = draw_page(data, folder, progress, charts)
    write_json(run / GUIDE, guide_json(data))
    # The page comes last, so that a stopped report leaves the earlier one.
    note = signed(html, key, charts, figures, file_hash(run / GUIDE))
    write_atomically(page, lambda part: part.write_text(note, encoding="utf-8"))
    if progress:
        progress(steps, steps, WRITTEN)
    return page

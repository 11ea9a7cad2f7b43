"""The table of certificates: cores ranked in pairs, scene by scene, with ties where no difference is clear."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simtest.bench.certificate import CERTIFICATE, Certificate, check_suite, read_certificate
from simtest.bench.phrases import COLUMNS, NONE, part_cells, spanned
from simtest.bench.ranking import ALPHA, CAP_DEG, rank
from simtest.bench.run import parts_of_overall
from simtest.bench.suite import Suite
from simtest.errors import InputError
from simtest.pages.html import environment
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject, make_folder, write_atomically

PAGE = "index.html"
MOST_CERTIFICATES = 1000

Figure = Callable[[Certificate], float | None]
"""A certificate's score, which a table is ordered by."""


@dataclass(frozen=True)
class Ranked:
    """A row of a table: a certificate and the ranks that it may have; None where it has no score."""

    certificate: Certificate
    first: int | None
    last: int | None

    @property
    def rank(self) -> str:
        """The rank, or the first and the last of those that are tied."""
        if self.first is None:
            return NONE
        return str(self.first) if self.first == self.last else f"{self.first}–{self.last}"


@dataclass(frozen=True)
class Board:
    """Certificates, ranked over all parts and by part.

    Parameters
    ----------
    overall : list of Ranked
        By the mean of the parts' scores.
    parts : dict
        By each part's score.
    """

    overall: list[Ranked]
    parts: dict[str, list[Ranked]]

    def to_json(self) -> JsonObject:
        """Return the ranks by core."""
        return {
            "overall": _names(self.overall),
            "parts": {part: _names(rows) for part, rows in self.parts.items()},
        }

    @property
    def leader(self) -> str:
        """Who leads, as a sentence: over all parts, or on each where no core has run them all."""
        if found := _leaders(self.overall):
            return f"{found} over all parts"
        told = [f"{found} on the part {part}" for part, rows in self.parts.items() if (found := _leaders(rows))]
        return ", ".join(told) or "No core has answered"


def _leaders(rows: list[Ranked]) -> str:
    """Return which cores have none ranked above them, as the beginning of a sentence; empty without any."""
    names: list[str] = [row.certificate.core["name"] for row in rows if row.first == 1]
    if len(names) < 2:
        return f"{names[0]} ranks first" if names else ""
    return f"{', '.join(names[:-1])} and {names[-1]} share the first rank"


def _names(rows: list[Ranked]) -> JsonObject:
    """Return the ranks of a table, by core and version, best first; beside a name that several have stands the file."""
    names = [_name(row.certificate) for row in rows]
    return {
        name if names.count(name) == 1 else f"{name} ({row.certificate.path})": row.rank
        for name, row in zip(names, rows, strict=True)
    }


def _name(certificate: Certificate) -> str:
    return f"{certificate.core['name']} {certificate.core['version'] or ''}".strip()


def read_entries(folder: Path, suite: Suite) -> Board:
    """Read the certificates below a folder and rank them."""
    if not folder.is_dir():
        raise InputError(f"{folder}: must be a folder that holds certificates")
    files = sorted(file for file in folder.rglob("*.json") if _is_certificate(file))
    if not files or len(files) > MOST_CERTIFICATES:
        raise InputError(f"{folder}: holds {len(files)} certificates; must be 1 to {MOST_CERTIFICATES}")
    certificates = [read_certificate(file) for file in files]
    for certificate in certificates:
        check_suite(certificate, suite)
    return _board(suite, certificates)


def _is_certificate(file: Path) -> bool:
    """Return whether a file is meant as a certificate: by its name, or by what it begins with."""
    if file.name == CERTIFICATE:
        return True
    try:
        with file.open("rb") as opened:
            return b"simtest-bench certificate" in opened.read(200)
    except OSError:
        return False


def _board(suite: Suite, certificates: list[Certificate]) -> Board:
    def score_on(part: str) -> Figure:
        return lambda certificate: certificate.parts[part]["score_deg"]

    parts = {
        part.name: ranked(
            [entry for entry in certificates if part.name in entry.parts], [part.name], score_on(part.name)
        )
        for part in suite.spec.parts
        if any(part.name in entry.parts for entry in certificates)
    }
    overall = ranked(certificates, parts_of_overall(suite), lambda entry: entry.content["overall"]["score_deg"])
    return Board(overall, parts)


def ranked(certificates: list[Certificate], parts: Sequence[str], score: Figure) -> list[Ranked]:
    """Rank certificates by some parts, the smallest score first (`simtest.bench.ranking`)."""
    # Files of different makers may have the same score.
    order = sorted(certificates, key=lambda entry: (score(entry) is None, score(entry) or 0.0, str(entry.path)))
    scored = [entry for entry in order if score(entry) is not None]
    if not scored:
        return [Ranked(entry, None, None) for entry in order]
    found = rank([[entry.parts[part]["scenes"] for entry in scored] for part in parts])
    held = [
        Ranked(entry, int(first), int(last)) for entry, first, last in zip(scored, found.first, found.last, strict=True)
    ]
    return held + [Ranked(entry, None, None) for entry in order[len(scored) :]]


def write_leaderboard(suite: Suite, board: Board, out: Path) -> Path:
    """Write the page of ranked certificates; `out` is an HTML file, or a folder that gets index.html."""
    page = out if out.suffix == ".html" else out / PAGE
    make_folder(page.parent)
    made_by = provenance.environment()
    html = environment().get_template("leaderboard.html.j2").render(
        suite=suite, board=board, columns=COLUMNS, cells=part_cells, headline=_headline, about=_about,
        cap=f"{CAP_DEG:g}", risk=f"{100 * ALPHA:g}",
        provenance={"commit": made_by["commit"] or NONE, "simtest": made_by["version"]},
    )  # fmt: skip
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _headline(certificate: Certificate) -> str:
    told = certificate.content["overall"]
    return spanned(told["score_deg"], told["score_interval"])


def _about(certificate: Certificate) -> dict[str, Any]:
    """Return what a row tells of the core and its machine."""
    told, core = certificate.content, certificate.core
    return {
        "name": core["name"],
        "version": core["version"] or NONE,
        "hash": (core["sha256"] or "")[:12],
        "processor": told["environment"]["processor"],
        "verdicts": {part: figures["uncertainty"]["verdict"] for part, figures in certificate.parts.items()},
    }

"""The table of certificates: cores ranked in pairs, scene by scene, with ties where no difference is clear.

A ranking is a claim about scenes that were not drawn: another set of seeds must confirm it. So a core is ranked above
another only where three things agree:

1. **The score.** The mean error in which each highlight counts at most `CAP_DEG`, and a refused or missed one counts
   `CAP_DEG`. It is 10 deg times (1 - a), a the area under the recall curve up to 10 deg as a share of the whole, as
   image matching and pose estimation measure it. Errors beyond the cap are alike in use: the plain reverse of the
   sightline is that good already, since a light in the scope's tip leaves a highlight's normal within about 10 deg of
   it. A penalty of 90 deg would rank cores by how many highlights are missed, which is chance where all use the same
   detector.
2. **The test.** Both cores saw the same scenes, so the difference is taken scene by scene: what both miss cancels. The
   standard error is that of the difference of two ratio estimators over scenes, with the cases as strata (Cochran 1977,
   sections 2.11, 5.6 and 6.11), and its degrees of freedom are Satterthwaite's. The level is Bonferroni's over all
   pairs of a table: `ALPHA` is the stated risk that a table of one part holds any order that new scenes would not
   confirm.
3. **The margin.** The difference must exceed what another processor may move both figures by, 5 % of each and 0.001 deg
   (`FIGURES`, `MEDIAN_DEG`): what is smaller, a run there may turn round.

Two cores that neither is ranked above the other are tied.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.bench.scores import CAP_DEG, CERTIFICATE, FORMAT, KIND, OF_CERTIFICATE, CertificateForm
from simtest.bench.suite import SUITES, Suite, cases_of, digest_of, layout_of, parts_of_overall
from simtest.errors import InputError
from simtest.pages.html import environment
from simtest.runtime import provenance
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject, make_folder, require_plain, write_atomically
from simtest.spec.spec_model import validate

FIGURES, MEDIAN_DEG = 0.05, 1e-3
"""Share of itself, and deg, by which another processor may move a score: contours change their topology."""

ALPHA = 0.05
"""Risk that a table of one part holds any order beyond the margin that is not so."""

SceneSums = Mapping[str, Sequence[Sequence[float]]]
"""By case, for each of its scenes: the number of highlights, and the sum of their capped errors, deg."""

Part = Sequence[SceneSums]
"""A part's scenes as each core was scored on them; all cores have the same cases with equally many scenes."""

IntMatrix = npt.NDArray[np.int8]


PAGE = "index.html"
MOST_CERTIFICATES = 1000

COLUMNS = ("median", "mean", "p95", "score", "answered", "refused", "missed", "coverage",
           "wrong and sure", "verdict", "95 % axis", "energy")  # fmt: skip
"""Headings of `part_cells`; errors, axis and score are in deg."""

NONE = "–"


@dataclass(frozen=True)
class Certificate:
    """A certificate that was read and checked."""

    path: Path
    content: JsonObject  # as it stands there, without its own hash

    @property
    def core(self) -> JsonObject:
        """Name, version and hashes of the core."""
        return dict(self.content["core"])

    @property
    def parts(self) -> dict[str, JsonObject]:
        """Figures by part."""
        return dict(self.content["parts"])


def read_certificate(path: Path) -> Certificate:
    """Read a certificate; raise `InputError` if it is none, was altered, lacks a figure, or is of another format."""
    if path.is_dir():
        path = path / CERTIFICATE
    require_plain(path, "record_bytes", "a certificate")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        # What has no hash is none: numbers that are not finite, and what is nested too deeply.
        digest_of(told)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as a certificate ({error})") from error
    if not isinstance(told, dict) or told.get("kind") != KIND:
        raise InputError(f"{path}: is no certificate; its kind must be {KIND!r}")
    if told.get("format") != FORMAT:
        raise InputError(f"{path}: format = {told.get('format')!s:.20}; this release reads {FORMAT}")
    stated, keys = told.pop(OF_CERTIFICATE, None), CertificateForm.model_fields.keys()
    if missing := sorted(keys - told.keys()):
        raise InputError(f"{path}: has no key {missing[0]}; a certificate has {', '.join(sorted(keys))}")
    if not isinstance(stated, str) or stated != digest_of(told):
        raise InputError(f"{path}: was altered: its content does not have the hash that it states")
    validate(CertificateForm, told, str(path))
    return Certificate(path, told)


def check_suite(certificate: Certificate, suite: Suite) -> None:
    """Raise `InputError` where a certificate is of other cases or scenes than a suite's."""
    told = certificate.content["suite"]
    if told.get("version") != suite.version:
        own = SUITES.get(suite.version, suite.version)
        raise InputError(f"{certificate.path}: is of version {told.get('version')!r:.20}; must be of {own}")
    for part in certificate.parts:
        if part not in {each.name for each in suite.spec.parts}:
            raise InputError(f"{certificate.path}: part {part!r:.60} is none of {SUITES[suite.version]}")
    stated, frozen = certificate.content["cases"], cases_of(suite, certificate.parts)
    for name in (*stated, *frozen):
        if name not in frozen or stated.get(name) != frozen[name]:
            raise InputError(f"{certificate.path}: case {name!s:.60} is not that of {SUITES[suite.version]}")
    if told.get("sha256") != suite.digest:
        raise InputError(f"{certificate.path}: its suite's hash is not that of {SUITES[suite.version]}")
    for part, figures in certificate.parts.items():
        layout = {case: scenes for case, (scenes, _) in layout_of(suite, part).items()}
        if {case: len(held) for case, held in figures["scenes"].items()} != layout:
            wanted = ", ".join(f"{count} of {case}" for case, count in layout.items())
            raise InputError(f"{certificate.path}: parts.{part}.scenes: must be {wanted}")


@dataclass(frozen=True)
class Ranking:
    """N cores compared in pairs."""

    scores: Array  # mean capped errors, deg; of several parts their mean; shape (N,)
    errors: Array  # standard errors of the scores' differences, deg; shape (N, N)
    better: IntMatrix  # 1 where the core of the row ranks above that of the column, -1 where below, 0 where tied

    @property
    def first(self) -> npt.NDArray[np.intp]:
        """Rank of each core: 1 and the number of cores above it."""
        return np.asarray(1 + np.count_nonzero(self.better < 0, axis=1))

    @property
    def last(self) -> npt.NDArray[np.intp]:
        """The last rank that each core may share: the number of cores less those below it."""
        return np.asarray(len(self.scores) - np.count_nonzero(self.better > 0, axis=1))


def rank(parts: Sequence[Part], alpha: float = ALPHA) -> Ranking:
    """Compare cores in pairs on one part, or by the mean over several, at a stated risk of the whole table.

    `parts` holds for each part what each core's scenes sum up to: a highlight at least for each core.
    """
    from scipy.special import stdtrit

    count = len(parts[0])
    scores = np.zeros(count)
    variances, terms = np.zeros((count, count)), np.zeros((count, count))
    for part in parts:
        means, strata = _residuals(part)
        scores += means / len(parts)
        # A case of one scene shows no spread: it is taken to spread as the others do, or as such cases do between them.
        seen = [rest for rest in strata if rest.shape[1] > 1] or [np.concatenate(strata, axis=1)]
        share = sum(rest.shape[1] for rest in strata) / sum(rest.shape[1] for rest in seen)
        for rest in seen:
            free = rest.shape[1] - 1
            if free < 1:
                # A single scene tells nothing.
                variances += np.inf
                continue
            centred = rest / len(parts)
            centred = centred - centred.mean(axis=1, keepdims=True)
            gram = centred @ centred.T * ((free + 1) / free) * share
            own = np.diag(gram)
            of_stratum = np.maximum(own[:, None] + own[None, :] - 2 * gram, 0.0)
            variances += of_stratum
            terms += of_stratum**2 / free
    # Without any variance the difference is exact, and its degrees of freedom do not matter.
    known = (terms > 0) & np.isfinite(variances)
    freedom = np.divide(variances**2, terms, out=np.full_like(terms, np.inf), where=known)
    pairs = max(count * (count - 1) / 2, 1)
    reach = stdtrit(np.minimum(freedom, 1e6), 1 - alpha / (2 * pairs)) * np.sqrt(variances)
    gain = scores[None, :] - scores[:, None]
    clear = np.abs(gain) > margin(scores[:, None], scores[None, :]) + reach
    return Ranking(scores, np.sqrt(variances), np.where(clear, np.sign(gain), 0).astype(np.int8))


def margin(first: Array, second: Array) -> Array:
    """Return how far two scores must lie apart, deg: what another processor may move both by."""
    return np.asarray(2 * MEDIAN_DEG + FIGURES * (first + second))


def _residuals(part: Part) -> tuple[Array, list[Array]]:
    """Return each core's mean, and by case its scenes' linearised residuals (sum - mean number) / total number."""
    cases = [np.array([core[case] for core in part], dtype=float) for case in part[0]]
    totals, sums = (sum((case[:, :, column].sum(axis=1) for case in cases), np.zeros(len(part))) for column in (0, 1))
    means = sums / totals
    return means, [(case[:, :, 1] - means[:, None] * case[:, :, 0]) / totals[:, None] for case in cases]


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
    """Certificates, ranked over all parts and by part."""

    overall: list[Ranked]  # by the mean of the parts' scores
    parts: dict[str, list[Ranked]]  # by each part's score

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
    """Read the certificates below a folder and rank them.

    Raises `InputError` if there are none, or one was altered, is malformed, or is of another version.
    """
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
            return KIND.encode() in opened.read(200)
    except OSError:
        return False


def _board(suite: Suite, certificates: list[Certificate]) -> Board:
    def score_on(part: str) -> Callable[[Certificate], float | None]:
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


def ranked(
    certificates: list[Certificate], parts: Sequence[str], score: Callable[[Certificate], float | None]
) -> list[Ranked]:
    """Rank certificates by some parts, the smallest score first (`rank`)."""
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


def part_cells(told: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the figures of a part as cells of a row, in the order of `COLUMNS`."""
    uncertainty = told["uncertainty"]
    return (
        spanned(told["median_deg"], told["median_interval"]),
        degrees(told["mean_deg"]),
        degrees(told["p95_deg"]),
        spanned(told["score_deg"], told["score_interval"]),
        f"{told['answered']} of {told['n']}",
        str(sum(told["refused"].values())),
        str(told["missed"]),
        coverage(uncertainty),
        NONE if (share := told.get("wrong_and_sure")) is None else f"{100 * share:.1f} %",
        uncertainty["verdict"],
        degrees(uncertainty["semi_axis_deg"]),
        degrees(uncertainty["energy_deg"]),
    )


def degrees(value: float | None) -> str:
    """Return an angle with three significant digits, deg."""
    return NONE if value is None else f"{value:.3g}"


def spanned(value: float | None, interval: Sequence[float] | None) -> str:
    """Return a value with its interval."""
    if value is None or interval is None:
        return degrees(value)
    return f"{degrees(value)} ({degrees(interval[0])} to {degrees(interval[1])})"


def coverage(told: Mapping[str, Any]) -> str:
    """Return the coverage with its interval, %."""
    if told["coverage"] is None:
        return NONE
    low, high = told["interval"]
    return f"{100 * told['coverage']:.1f} % ({100 * low:.0f} to {100 * high:.0f}) of {told['n']}"


def refusals(parts: Mapping[str, Any]) -> list[str]:
    """Return a line for each part with refusals: how many for which reason."""
    return [
        f"{part}: refused {', '.join(f'{count} {reason}' for reason, count in told['refused'].items())}"
        for part, told in parts.items()
        if told["refused"]
    ]

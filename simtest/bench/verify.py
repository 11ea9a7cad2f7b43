"""Verifies a certificate: by what it states itself, or by running the core again and comparing the figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from simtest.bench.certificate import Certificate, check_suite
from simtest.bench.draws import Seeds
from simtest.bench.maps import BASELINE, MAPS, PART, SHADING, stated_options
from simtest.bench.run import overall_of, run_bench, run_maps
from simtest.bench.scores import score_part
from simtest.bench.suite import Suite, frames_of
from simtest.errors import InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.runtime.engines import Engine
from simtest.runtime.files import JsonObject
from simtest.runtime.resources import shown
from simtest.validation.runner import RESULTS, Progress
from simtest.validation.statistics import PENALTY_DEG

MEDIAN_DEG = 1e-3
"""How far medians of two processors may lie apart, deg."""

COUNTS = 0.01
"""Share of the highlights that may be answered by one processor and not by another: contours change their topology."""


@dataclass(frozen=True)
class Verified:
    """What a verification found.

    Parameters
    ----------
    problems : tuple of str
        What speaks against the certificate; none where it holds.
    notes : tuple of str
        What differs without speaking against it, and what was compared.
    """

    problems: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against the certificate."""
        return not self.problems

    def to_json(self) -> JsonObject:
        """Return the finding as a JSON object."""
        return {"holds": self.holds, "problems": list(self.problems), "notes": list(self.notes)}


def check_seeds(certificate: Certificate, suite: Suite, seeds: Seeds) -> None:
    """Raise `InputError` where seeds are not those that a certificate is of."""
    where = shown(certificate.path)
    if certificate.commitment is None and seeds.commitment is not None:
        raise InputError(f"{where}: is of the public seeds; leave out --sealed")
    if certificate.commitment is not None and seeds.commitment is None:
        raise InputError(f"{where}: is of sealed seeds; --sealed must name their file")
    if certificate.commitment != seeds.commitment:
        raise InputError(f"{where}: its commitment is not that of --sealed: it was run with other seeds")
    if certificate.commitment is None and certificate.content["seeds"].get("seed") != suite.spec.seed:
        raise InputError(f"{where}: its public seed is not {suite.spec.seed}")


def check_quick(certificate: Certificate, suite: Suite) -> Verified:
    """Check hashes and consistency without running anything.

    That is: the cases are the suite's, each part's counts add up, the headline follows from the parts, and results
    that lie beside the certificate have the hash and give the figures that it states.
    """
    check_suite(certificate, suite)
    problems, notes = [], ["the cases are those of the suite"]
    stated = certificate.content["seeds"]
    if certificate.commitment is None and (stated["kind"] != "public" or stated.get("seed") != suite.spec.seed):
        problems.append(f"seeds: neither a commitment nor the public seed {suite.spec.seed}")
    for part, told in certificate.parts.items():
        problems += _against_itself(part, told) + _against_results(certificate, suite, part, told, notes)
    if overall_of(suite, certificate.parts) != certificate.content["overall"]:
        problems.append("overall: does not follow from the parts")
    return Verified(tuple(problems), tuple(notes))


def _against_itself(part: str, told: JsonObject) -> list[str]:
    """Compare a part's counts with each other, and its penalised error with the mean of the answers."""
    refused = told["missed"] + sum(told["refused"].values())
    if told["n"] != told["answered"] + refused:
        return [f"{part}: answered, missed and refused do not add up to n = {told['n']}"]
    if (told["mean_deg"] is None) != (told["answered"] == 0) or (told["penalised_deg"] is None) != (told["n"] == 0):
        return [f"{part}: mean and penalised error do not go with {told['answered']} answers of {told['n']}"]
    if told["n"]:
        expected = ((told["mean_deg"] or 0.0) * told["answered"] + PENALTY_DEG * refused) / told["n"]
        if not _alike(expected, told["penalised_deg"], 1e-9):
            return [f"{part}: penalised error {told['penalised_deg']:.6g} does not follow from the mean and the counts"]
    return []


def _against_results(
    certificate: Certificate, suite: Suite, part: str, told: JsonObject, notes: list[str]
) -> list[str]:
    """Compare a part's figures with those of the results that lie beside the certificate, if any do."""
    file = certificate.path.parent / part / RESULTS
    if not file.is_file():
        return []
    try:
        rows = pl.read_parquet(file)
        score = score_part(rows, frames_of(suite, part)).to_json()
    except (OSError, pl.exceptions.PolarsError) as error:
        return [f"{part}: its results cannot be read ({error})"]
    if score["results"] != told["results"]:
        return [f"{part}: the results beside the certificate have another hash"]
    notes.append(f"{part}: the figures follow from the results beside the certificate")
    # Figures are sums over rows: another library may add in another order.
    off = [key for key in _differing(score, told, 1e-9)]
    return [f"{part}: {key} does not follow from the results" for key in off]


def _differing(first: JsonObject, second: JsonObject, tolerance: float) -> list[str]:
    """Return the keys whose values differ, numbers by more than a share of themselves."""
    return [key for key, value in first.items() if not _alike(value, second.get(key), tolerance)]


def _alike(first: object, second: object, tolerance: float) -> bool:
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(_alike(first[key], second[key], tolerance) for key in first)
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(lambda a, b: _alike(a, b, tolerance), first, second))
    if isinstance(first, float) and isinstance(second, int | float):
        return abs(first - second) <= tolerance * max(1.0, abs(first))
    return first == second


def verify_run(
    certificate: Certificate,
    suite: Suite,
    folder: Path,
    seeds: Seeds,
    core: str | None = None,
    maps: Path | None = None,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> Verified:
    """Run a certificate's core again and compare the figures.

    Parameters
    ----------
    certificate : Certificate
        What to verify.
    suite : Suite
        The suite that it is of.
    folder : Path
        Gets the run.
    seeds : Seeds
        Public, or the opened ones.
    core : str, optional
        How the core is started here; default the certificate's name, where it is an installed estimator.
    maps : Path, optional
        Folder of the maps that a certificate of maps is of.
    engine, progress
        See `simtest.validate`.
    """
    check_seeds(certificate, suite, seeds)
    quick = check_quick(certificate, suite)
    told = certificate.core
    if told["kind"] in (MAPS, BASELINE):
        if list(certificate.parts) != [PART]:
            raise InputError(f"{shown(certificate.path)}: is of maps; its only part must be {PART}")
        if maps is None and told["kind"] == MAPS:
            raise InputError(f"{shown(certificate.path)}: is of maps; --maps must name their folder")
        options = stated_options(str(told["name"]), certificate.parts[PART])
        run = run_maps(suite, maps or SHADING, folder, seeds, options, engine, progress)
    else:
        if core is None and told["kind"] != "installed":
            raise InputError(f"{shown(certificate.path)}: is of a command; --core must say how to start it here")
        if core is None and told["name"] not in ESTIMATORS.names():
            # A stranger wrote the name: a command in its place is never run.
            raise InputError(
                f"{shown(certificate.path)}: core {shown(told['name'], 60)!r} is not installed here; install its "
                "package, or give --core"
            )
        run = run_bench(suite, core or str(told["name"]), folder, seeds, list(certificate.parts), engine, progress)
    compared = compare(certificate.content, run.content)
    return Verified((*quick.problems, *compared.problems), (*quick.notes, *compared.notes))


def compare(told: JsonObject, found: JsonObject) -> Verified:
    """Compare a certificate's content with that of another run of the same cases."""
    problems, notes = _compare_origin(told, found)
    for part, stated in told["parts"].items():
        again = found["parts"].get(part)
        if again is None:
            problems.append(f"{part}: was not run again")
        elif stated["results"] == again["results"]:
            notes.append(f"{part}: the same rows")
        else:
            wrong, other = _compare_part(part, stated, again)
            problems += wrong
            notes += other
    return Verified(tuple(problems), tuple(notes))


def _compare_origin(told: JsonObject, found: JsonObject) -> tuple[list[str], list[str]]:
    """Return what differs between two runs' cores, which is a problem, and between their machines, which is none."""
    problems = [
        f"core {key}: stated {shown(told['core'][key], 60)}, here {shown(found['core'][key], 60)}"
        for key in ("name", "version", "sha256")
        if told["core"][key] != found["core"][key]
    ]
    notes = [
        f"{key}: stated {shown(told['environment'].get(key), 80)}, here {shown(value, 80)}"
        for key, value in found["environment"].items()
        if told["environment"].get(key) != value and not isinstance(value, dict)
    ]
    programs = [core["core"].get("program") for core in (told, found)]
    if programs[0] != programs[1]:
        notes.append(f"core program: stated {shown(str(programs[0]), 120)}, here {shown(str(programs[1]), 120)}")
    stated = told["environment"]["versions"]
    notes += [
        f"{name}: stated {stated.get(name)}, here {version}"
        for name, version in found["environment"]["versions"].items()
        if stated.get(name) != version
    ]
    return problems, notes


def _compare_part(part: str, told: JsonObject, found: JsonObject) -> tuple[list[str], list[str]]:
    """Return what differs between two runs of a part: beyond what processors may differ by, and within."""
    problems, notes = [], []
    most = max(1.0, COUNTS * told["n"])
    for key in ("n", "answered", "missed", "false"):
        if (apart := abs(told[key] - found[key])) > most:
            problems.append(f"{part}: {key} {told[key]}, here {found[key]}; at most {most:.3g} may differ")
        elif apart:
            notes.append(f"{part}: {key} {told[key]}, here {found[key]}: contours changed their topology")
    medians: Sequence[float | None] = (told["median_deg"], found["median_deg"])
    # A mean, and a coverage, may change by what the highlights can do that may be answered otherwise.
    share = most / max(told["n"], 1)
    figures = (
        ("medians", medians, MEDIAN_DEG, " deg"),
        ("penalised errors", (told["penalised_deg"], found["penalised_deg"]), MEDIAN_DEG + PENALTY_DEG * share, " deg"),
        ("coverages", (told["uncertainty"]["coverage"], found["uncertainty"]["coverage"]),
         most / max(found["uncertainty"]["n"], 1), ""),
    )  # fmt: skip
    for name, pair, allowed, unit in figures:
        if None in pair:
            if pair[0] != pair[1]:
                problems.append(f"{part}: {name} {pair[0]} and {pair[1]}")
            continue
        apart = abs(float(pair[0] or 0) - float(pair[1] or 0))
        text = f"{part}: {name} differ by {apart:.2g}{unit}; at most {allowed:.3g} is allowed"
        (problems if apart > allowed else notes).append(text)
    return problems, notes

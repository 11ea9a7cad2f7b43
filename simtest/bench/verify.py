"""Verifies a certificate: by what it states itself, or by running the core again and comparing the figures."""

from pathlib import Path

import polars as pl

from simtest.bench.certificate import Certificate, check_suite
from simtest.bench.compare import SAME, Verified, alike, compare, differing
from simtest.bench.draws import Seeds
from simtest.bench.maps import BASELINE, MAPS, PART, SHADING, stated_options
from simtest.bench.ranking import CAP_DEG
from simtest.bench.run import overall_of, run_bench, run_maps
from simtest.bench.scores import score_part
from simtest.bench.suite import Suite, layout_of
from simtest.errors import InputError
from simtest.estimators.installed import ESTIMATORS
from simtest.runtime.engines import Engine
from simtest.runtime.files import JsonObject
from simtest.runtime.resources import shown
from simtest.validation.run_folder import RESULTS
from simtest.validation.runner import Progress
from simtest.validation.statistics import PENALTY_DEG

_ROUNDED = 1e-5
"""How far sums of a part's errors and of its scenes' may lie apart by rounding, deg."""


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
        problems += _against_itself(suite, part, told) + _against_results(certificate, suite, part, told, notes)
    if overall_of(suite, certificate.parts) != certificate.content["overall"]:
        problems.append("overall: does not follow from the parts")
    return Verified(tuple(problems), tuple(notes))


def _against_itself(suite: Suite, part: str, told: JsonObject) -> list[str]:
    """Compare a part's counts with each other, and its score with its scenes' sums, with the mean and the counts."""
    n, answered = told["n"], told["answered"]
    refused = told["missed"] + sum(told["refused"].values())
    if n != answered + refused:
        return [f"{part}: answered, missed and refused do not add up to n = {n}"]
    if (told["mean_deg"] is None) != (answered == 0) or (told["score_deg"] is None) != (n == 0):
        return [f"{part}: mean and score do not go with {answered} answers of {n}"]
    layout = {case: scenes for case, (scenes, _) in layout_of(suite, part).items()}
    if {case: len(held) for case, held in told["scenes"].items()} != layout:
        return [f"{part}: scenes: must be {', '.join(f'{count} of {case}' for case, count in layout.items())}"]
    sums = [scene for held in told["scenes"].values() for scene in held]
    if sum(number for number, _ in sums) != n:
        return [f"{part}: the scenes' numbers do not add up to n = {n}"]
    if not n:
        return []
    if not alike(sum(total for _, total in sums) / n, told["score_deg"], SAME):
        return [f"{part}: score {told['score_deg']:.6g} does not follow from the scenes' sums"]
    of_maps = suite.part(part).kind == MAPS
    penalty = PENALTY_DEG if of_maps else CAP_DEG
    if not of_maps and any(total > CAP_DEG * number + 1e-6 for number, total in sums):
        return [f"{part}: a scene's sum exceeds {CAP_DEG:g} deg for each of its highlights"]
    most = ((told["mean_deg"] or 0.0) * answered + penalty * refused) / n
    least = most if of_maps else penalty * refused / n
    if not least - _ROUNDED <= told["score_deg"] <= most + _ROUNDED:
        return [f"{part}: score {told['score_deg']:.6g} does not go with the mean and the counts"]
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
        score = score_part(rows, layout_of(suite, part)).to_json()
    except (OSError, ValueError, TypeError, pl.exceptions.PolarsError) as error:
        return [f"{part}: its results cannot be read ({shown(error)})"]
    if score["results"] != told["results"]:
        return [f"{part}: the results beside the certificate have another hash"]
    notes.append(f"{part}: the figures follow from the results beside the certificate")
    return [f"{part}: {key} does not follow from the results" for key in differing(score, told, SAME)]


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
            raise InputError(f"{shown(certificate.path)}: is of a {told['kind']}; --core must say how to start it here")
        if core is None and told["name"] not in ESTIMATORS.names():
            # A stranger wrote the name: a command in its place is never run.
            raise InputError(
                f"{shown(certificate.path)}: core {shown(told['name'], 60)!r} is not installed here; install its "
                "package, or give --core"
            )
        run = run_bench(suite, core or str(told["name"]), folder, seeds, list(certificate.parts), engine, progress)
    compared = compare(certificate.content, run.content)
    return Verified((*quick.problems, *compared.problems), (*quick.notes, *compared.notes))

"""The figures of a part, as a certificate holds them: accuracy over scenes, refusals, and the stated uncertainty."""

import math
from typing import Annotated, Any, Literal

import numpy as np
import polars as pl
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from simtest.bench.suite import Layout, digest_of
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.statistics import (
    Interval,
    deviation_of_mean,
    mean_interval,
    median_interval,
    share_interval,
    summed,
)
from simtest.validation.statistics import figures

CERTIFICATE = "certificate.json"
KIND = "simtest-bench certificate"
FORMAT = 2

OF_CERTIFICATE = "sha256"
"""Key of the hash of everything else."""

CAP_DEG = 10.0
"""What a highlight counts at most, deg, and what a refused or missed one counts."""

HASHED = (
    "setting", "realisation", "specularity", "true_id", "status", "target", "error_deg", "normal_x", "normal_y",
    "normal_z", "cov_11", "cov_12", "cov_22", "mahalanobis2", "n_candidates",
)  # fmt: skip
"""Columns that the hash of a part's results is of."""

SUM_DIGITS = 6
"""Decimals of the sums by scene: the score is computed of the rounded ones, so that it follows from a certificate."""

LEVEL = 0.95
"""Of the regions whose coverage is tested."""

ALPHA = 0.01
"""Risk of each one-sided test that a right uncertainty is marked."""

LEAST_STATED = 50
"""With fewer uncertainties no verdict is given."""

DIRECTIONS = 64
"""Over which the energy score is averaged."""

_Z_TEST = 2.3263478740408408
"""Quantile of the normal distribution at 1 - ALPHA."""

Verdict = Literal["overconfident", "calibrated", "underconfident", "too few"]

NARROW: Verdict = "overconfident"
WELL: Verdict = "calibrated"
SCALED: Verdict = "underconfident"
UNTESTED: Verdict = "too few"


def _ordered(span: list[float]) -> list[float]:
    if span[0] > span[1]:
        raise ValueError(f"{span}: the low end exceeds the high one")
    return span


Text = Annotated[str, Field(max_length=200)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Angle = Annotated[float, Field(ge=0, le=180)]
Figure = Annotated[float, Field(ge=0)]
Interval95 = Annotated[list[Angle], Field(min_length=2, max_length=2), AfterValidator(_ordered)]
SceneSum = Annotated[tuple[Count, Figure], Field(strict=False)]
Shares = Annotated[list[Share], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class Form(BaseModel):
    """Base of the tables: other keys are refused, numbers are finite and never text."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, defer_build=True)

    def to_json(self) -> JsonObject:
        """Return what was given as a JSON object."""
        return self.model_dump(exclude_unset=True)


class UncertaintyScore(Form):
    """How good a stated uncertainty is."""

    n: Count  # answers that state an uncertainty, of highlights that are true ones
    coverage: Share | None  # share of them whose 95 % region holds the true normal
    interval: Shares | None  # 95 % interval of the coverage, over scenes
    verdict: Verdict  # by a test of the coverage
    # Factor on the covariances with which 95 % of the regions would hold the true normal; None where no factor would
    # do, since too many covariances are singular
    inflation: Figure | None
    # Sharpness: median of the regions' mean semi-axis (the square root of both semi-axes' product)
    semi_axis_deg: Figure | None
    # Mean energy score: a proper score; smaller is better, and only the right covariance has the smallest
    energy_deg: Figure | None


class ZoneScore(Form):
    """Figures of a zone of maps; see `simtest.bench.run.dense_figures`."""

    n: Count
    n_unanswered: Count
    mean_deg: Angle | None
    median_deg: Angle | None
    median_interval: Interval95 | None
    p95_deg: Angle | None
    penalised_deg: Angle | None
    penalised_interval: Interval95 | None


class StatedForm(Form):
    """What was stated of maps (`simtest.dataset.scoring.dense.maps.MapOptions`); null: the default."""

    encoding: Text | None
    frame: Text | None
    depth: Text | None
    unit_mm: Annotated[float, Field(gt=0)] | None


class PartScore(Form):
    """The figures of one part."""

    n: Count  # true highlights
    answered: Count
    missed: Count
    false: Count
    refused: dict[str, Count]  # highlights by reason
    # Of the errors of the answers; the interval is over scenes: cases are frozen, and their differences no chance
    median_deg: Angle | None
    median_interval: Interval95 | None
    mean_deg: Angle | None
    p95_deg: Angle | None
    # What cores are ranked by: the mean of the errors, each at most `CAP_DEG`, with `CAP_DEG` for each highlight that
    # was refused or missed
    score_deg: Angle | None
    score_interval: Interval95 | None
    # By case, for each scene: its number of highlights, and the sum of their errors as the score takes them
    scenes: dict[Text, list[SceneSum]]
    uncertainty: UncertaintyScore
    results: Hash  # of the rows
    # Share of the answers that are wrong and sure (`simtest.validation.statistics`); earlier certificates lack it
    wrong_and_sure: Share | None = None
    # Of maps alone
    source: Text | None = None
    zones: dict[Text, ZoneScore] | None = None
    conventions: list[Annotated[str, Field(max_length=2000)]] | None = None
    stated: StatedForm | None = None


class SuiteForm(Form):
    """Which suite it is of."""

    name: Text
    version: Text
    sha256: Hash


class ProgramForm(Form):
    """The interpreter, or another program of the machine, that runs a core."""

    name: Text
    sha256: Hash


class CoreForm(Form):
    """What was run."""

    name: Text
    kind: Literal["installed", "command", "network", "maps", "baseline"]
    version: Text | None
    sha256: Hash | None
    program: ProgramForm | None = None


class EnvironmentForm(Form):
    """On what it was run."""

    commit: Text | None
    version: Text
    versions: dict[str, Text | None]
    python: Text
    processor: Text | None
    source_sha256: Hash | None


class OverallForm(Form):
    """The headline."""

    complete: bool
    score_deg: Angle | None
    score_interval: Interval95 | None


class CertificateForm(Form):
    """The whole content, without its own hash."""

    kind: Text
    format: int
    suite: SuiteForm
    cases: dict[str, Hash]
    core: CoreForm
    environment: EnvironmentForm
    parts: Annotated[dict[str, PartScore], Field(min_length=1)]
    overall: OverallForm


def score_part(rows: pl.DataFrame, layout: Layout) -> PartScore:
    """Compute the figures of a part's rows.

    Raises `ValueError` for rows of scenes that the part does not have.
    """
    told = figures(rows)
    true = rows.filter(pl.col("true_id").is_not_null())
    answered = true.filter(pl.col("status") == "ok")
    errors = answered["error_deg"].to_numpy()
    capped = np.where(true["status"] == "ok", true["error_deg"].fill_null(CAP_DEG).clip(0.0, CAP_DEG), CAP_DEG)
    scenes = scene_sums(true, capped, layout)
    numbers, sums = np.array([scene for held in scenes.values() for scene in held]).T
    cases = np.repeat(np.arange(len(scenes)), [len(held) for held in scenes.values()])
    return PartScore(
        n=told.n,
        answered=told.n_ok,
        missed=told.n_missed,
        false=told.n_false,
        refused=told.n_failed_by_reason,
        median_deg=told.median_deg,
        median_interval=_span(median_interval(errors, *scenes_of(answered, layout))),
        mean_deg=told.mean_deg,
        p95_deg=told.p95_deg,
        score_deg=float(sums.sum() / numbers.sum()) if len(capped) else None,
        score_interval=_span(mean_interval(sums, None, cases, numbers), CAP_DEG) if len(capped) else None,
        scenes=scenes,
        uncertainty=score_uncertainty(answered, *scenes_of(answered, layout)),
        results=results_hash(rows),
        wrong_and_sure=told.wrong_and_sure,
    )


def scenes_of(rows: pl.DataFrame, layout: Layout) -> tuple[IntArray, IntArray]:
    """Return a number for the scene of each row, whose frames differ in noise alone, and one for its case."""
    scenes: dict[tuple[str, int], int] = {}
    cases = {case: number for number, case in enumerate(layout)}
    numbers = [(scenes.setdefault(key, len(scenes)), cases.get(key[0], 0)) for key in _scene_keys(rows, layout)]
    return np.array([scene for scene, _ in numbers], dtype=int), np.array([case for _, case in numbers], dtype=int)


def scene_sums(rows: pl.DataFrame, values: Array, layout: Layout) -> dict[str, list[tuple[int, float]]]:
    """Return how many rows each scene has, and the sum of their values, by case; scenes without rows are held."""
    numbers = {case: [0] * scenes for case, (scenes, _) in layout.items()}
    sums = {case: [0.0] * scenes for case, (scenes, _) in layout.items()}
    for (case, scene), value in zip(_scene_keys(rows, layout), values.tolist(), strict=True):
        numbers[case][scene] += 1
        sums[case][scene] += value
    return {
        case: [(number, round(total, SUM_DIGITS)) for number, total in zip(held, sums[case], strict=True)]
        for case, held in numbers.items()
    }


def _scene_keys(rows: pl.DataFrame, layout: Layout) -> list[tuple[str, int]]:
    """Return the case of each row, and the number of its scene there."""
    keys = []
    for case, number in zip(rows["setting"].to_list(), rows["realisation"].to_list(), strict=True):
        scenes, frames = layout.get(case, (0, 1))
        if not 0 <= number < scenes * frames:
            raise ValueError(f"setting {case!r}, realisation {number}: the part has no such frame")
        keys.append((case, number // frames))
    return keys


def results_hash(rows: pl.DataFrame) -> str:
    """Return the SHA-256 of a part's rows: of what was answered and how it was judged, in their order."""
    held: list[Json] = [list(map(_plain, row)) for row in rows.select(HASHED).iter_rows()]
    return digest_of([list(HASHED), held])


def _plain(value: Any) -> Json:
    """Return a value as it is hashed; JSON knows neither NaN nor infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    plain: Json = value
    return plain


def _span(interval: Interval, most: float = 180.0) -> list[float] | None:
    """Return an interval of angles up to the largest; None where there is none."""
    low, high = interval
    return None if low is None or high is None else [max(low, 0.0), min(high, most)]


UNSTATED = UncertaintyScore(
    n=0, coverage=None, interval=None, verdict=UNTESTED, inflation=None, semi_axis_deg=None, energy_deg=None
)


def score_uncertainty(answered: pl.DataFrame, scenes: IntArray, cases: IntArray | None = None) -> UncertaintyScore:
    """Score the uncertainties of answers: rows of results with status "ok" and a true highlight.

    `scenes` and `cases` say which scene and case each row is of: rows of one scene are not independent, cases are
    frozen, and not drawn. A stated covariance without a finite Mahalanobis distance is singular.
    """
    distances = answered["mahalanobis2"].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    covariances = answered.select("cov_11", "cov_12", "cov_22").cast(pl.Float64).to_numpy().astype(float)
    # A singular region holds no true normal: it is one that was stated and missed, not one that was left open.
    squared: Array = np.where(np.isnan(distances) & ~np.isnan(covariances).any(axis=1), np.inf, distances)
    stated = ~np.isnan(squared)
    n, limit = int(stated.sum()), chi_squared.quantile(LEVEL, 2)
    if n == 0:
        return UNSTATED
    inside = (squared[stated] <= limit).astype(float)
    share, groups = float(np.mean(inside)), (scenes[stated], None if cases is None else cases[stated])
    error, interval = coverage_error(inside, *groups), share_interval(inside, *groups)
    coordinates, covariances = _misses(answered)
    semi_axis = energy = None
    if len(covariances):
        with np.errstate(all="ignore"):
            areas = np.sqrt(np.maximum(np.linalg.det(covariances), 0.0))
            semi_axis = finite(np.degrees(np.median(np.sqrt(limit * areas))))
            energy = finite(np.degrees(np.mean(energy_scores(coordinates, covariances))))
    with np.errstate(invalid="ignore"):
        inflation = finite(np.quantile(squared[stated], LEVEL) / limit)
    return UncertaintyScore(
        n=n, coverage=share, interval=list(interval), verdict=verdict_of(share, error, n), inflation=inflation,
        semi_axis_deg=semi_axis, energy_deg=energy,
    )  # fmt: skip


def finite(value: float | np.floating) -> float | None:
    """Return a figure as a certificate holds it; None in place of what is not finite."""
    return float(value) if np.isfinite(value) else None


def coverage_error(inside: Array, scenes: IntArray, cases: IntArray | None = None) -> float:
    """Return the standard error that a coverage of 95 % has with rows that are grouped in scenes.

    By how much the variance over the scenes of each case exceeds that of independent rows, at least 1, is the design
    effect; it enlarges the variance at 95 %. The variance at the observed share would be small where that happens to be
    large, and mark right uncertainties as underconfident.
    """
    n, share = len(inside), float(np.mean(inside))
    independent = math.sqrt(LEVEL * (1 - LEVEL) / n)
    totals, counts, kinds = summed(inside, scenes, cases, None)
    if len(counts) < 2 or share in (0.0, 1.0):
        return independent
    grouped = deviation_of_mean(totals, counts, kinds) ** 2
    return independent * math.sqrt(max(1.0, grouped / (share * (1 - share) / n)))


def verdict_of(share: float, error: float, n: int) -> Verdict:
    """Return what two one-sided tests of the coverage against 95 %, each of risk `ALPHA`, say of `n` regions.

    Each asks two things: the normal test with the coverage's error, which scenes enlarge, and the exact binomial test.
    The normal test alone would mark up to 3 % of the right ones where there are few regions: shares near 1 are skew.
    """
    from scipy.special import bdtr, bdtrc

    if n < LEAST_STATED:
        return UNTESTED
    hits = round(share * n)
    if share < LEVEL - _Z_TEST * error and bdtr(hits, n, LEVEL) <= ALPHA:
        return NARROW
    return SCALED if share > LEVEL + _Z_TEST * error and bdtrc(hits - 1, n, LEVEL) <= ALPHA else WELL


def energy_scores(misses: Array, covariances: Array) -> Array:
    """Compute the energy score of normal distributions in the plane, E|X - y| - E|X - X'| / 2, in the unit of `misses`.

    The length of a vector is pi/2 times the mean of its parts along all directions, so the score is pi/2 times the
    mean over directions of the continuous ranked probability score of a normal distribution on a line, which has a
    closed form (Gneiting and Raftery 2007, J. Am. Stat. Assoc. 102, equation 21). `misses` are the true values less the
    distributions' means, shape (N, 2); `covariances` have the shape (N, 2, 2).
    """
    from scipy.special import ndtr

    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    value = misses @ along.T
    variance = np.einsum("kj,nji,ki->nk", along, covariances, along)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    z = value / sd
    density = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    ranked = sd * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi))
    return np.asarray(np.pi / 2 * ranked.mean(axis=1))


def _misses(answered: pl.DataFrame) -> tuple[Array, Array]:
    """Return the true normals' coordinates about the proposed ones, rad, and the covariances, where one is stated."""
    columns = ["normal_x", "normal_y", "normal_z", "error_deg", "cov_11", "cov_12", "cov_22"]
    names = ["truth_x", "truth_y", "truth_z"]
    held = answered.select(columns + names).drop_nulls()
    values = held.select(columns).to_numpy().astype(float)
    truths = held.select(names).to_numpy().astype(float)
    misses, covariances = [], []
    for row, truth in zip(values, truths, strict=True):
        normal, (c11, c12, c22) = row[:3], row[4:7]
        across = tangent_coordinates(normal, truth)
        length = float(np.hypot(*across))
        # The length is the error that is scored: a base's normal may be the one that is stated.
        misses.append(across * (math.radians(row[3]) / length) if length > 0 else across)
        covariances.append([[c11, c12], [c12, c22]])
    return np.array(misses).reshape(-1, 2), np.array(covariances).reshape(-1, 2, 2)

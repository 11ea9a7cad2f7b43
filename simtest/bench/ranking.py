"""Which of two cores is better: by their paired difference over the scenes that both were run on.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array

CAP_DEG = 10.0
"""What a highlight counts at most, deg, and what a refused or missed one counts."""

FIGURES, MEDIAN_DEG = 0.05, 1e-3
"""Share of itself, and deg, by which another processor may move a score: contours change their topology."""

ALPHA = 0.05
"""Risk that a table of one part holds any order beyond the margin that is not so."""

SceneSums = Mapping[str, Sequence[Sequence[float]]]
"""By case, for each of its scenes: the number of highlights, and the sum of their capped errors, deg."""

Part = Sequence[SceneSums]
"""A part's scenes as each core was scored on them; all cores have the same cases with equally many scenes."""

IntMatrix = npt.NDArray[np.int8]


@dataclass(frozen=True)
class Ranking:
    """Cores compared in pairs.

    Parameters
    ----------
    scores : ndarray, shape (N,)
        Mean capped errors, deg; of several parts their mean.
    errors : ndarray, shape (N, N)
        Standard errors of the scores' differences, deg.
    better : ndarray of int, shape (N, N)
        1 where the core of the row is ranked above that of the column, -1 where below, 0 where they are tied.
    """

    scores: Array
    errors: Array
    better: IntMatrix

    @property
    def first(self) -> npt.NDArray[np.intp]:
        """Rank of each core: 1 and the number of cores above it."""
        return np.asarray(1 + np.count_nonzero(self.better < 0, axis=1))

    @property
    def last(self) -> npt.NDArray[np.intp]:
        """The last rank that each core may share: the number of cores less those below it."""
        return np.asarray(len(self.scores) - np.count_nonzero(self.better > 0, axis=1))


def rank(parts: Sequence[Part], alpha: float = ALPHA) -> Ranking:
    """Compare cores in pairs on one part, or by the mean over several.

    Parameters
    ----------
    parts : sequence
        For each part, what each core's scenes sum up to. A part must hold a highlight for each core.
    alpha : float
        Stated risk of the whole table, 0 to 1.

    Returns
    -------
    Ranking
        Of the cores, in the order of each part.
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

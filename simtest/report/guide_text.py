"""The guide to a run's methods in words, for its page and for the terminal."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from simtest.pages.style import estimator_order, number
from simtest.validation.guide import BREAK_DEG, LEAST_ANSWERED, Advice, Guide, MethodFigures
from simtest.validation.statistics import PENALTY_DEG

HEADS = ("situation", "best method", "median error", "answered", "where it breaks")

RULES = (
    "Median error: the angle between the estimated and the true normal, with the 95 % interval of the median where six "
    "or more highlights were answered.",
    "Best method: the lowest mean error, where a highlight that a method missed or could not answer counts as "
    f"{PENALTY_DEG:g}°. A method is tied with it where the 95 % interval of their mean difference on the same "
    "highlights holds 0.",
    f"A method breaks where that mean exceeds {BREAK_DEG:g}°, or where it answers fewer than "
    f"{100 * LEAST_ANSWERED:g} % of the highlights.",
)
"""How the table is made."""

WORDS = {
    "k d": "curvature times distance, positive where the surface is convex",
    "ε/d": "distance of the light from the camera over that of the surface",
    "flat": "|k d| below 0.05",
    "outside, inside of a tube": "convex, concave in one direction, flat in the other",
    "dome, bowl": "convex, concave in both directions",
    "place, distance told": "what the methods may use: where the light is, how far the surface is",
}
"""Words of the situations and figures, explained."""


@dataclass(frozen=True)
class GuideRow:
    """A situation's row; texts but for the names."""

    surface: str
    circumstances: str
    best: str | None
    ties: tuple[str, ...]
    error: str
    answered: str
    breaks: str
    is_broken: bool  # whether the best method breaks in one of the settings


@dataclass(frozen=True)
class MethodRow:
    """A method's row."""

    estimator: str
    about: str
    best: str
    breaks: str


def guide_rows(guide: Guide) -> list[GuideRow]:
    """Return a row for each situation."""
    return [_row(advice) for advice in guide.advice]


def _row(advice: Advice) -> GuideRow:
    where = (advice.situation.surface, advice.situation.circumstances)
    if advice.best is None:
        return GuideRow(*where, None, (), "–", f"0 of {advice.n}", "no method answered", True)
    best = advice.methods[advice.best]
    answered = f"{best.answered} of {best.n}"
    return GuideRow(
        *where, advice.best, advice.ties, _error(best), answered, _breaks(advice), bool(advice.broken)
    )  # fmt: skip


def _error(figures: MethodFigures) -> str:
    low, high = figures.interval_deg
    texts = [number(value, 2) for value in (figures.median_deg, low, high)]
    return f"{texts[0]}°" if low is None else f"{texts[0]}° ({texts[1]}–{texts[2]})"


def _breaks(advice: Advice) -> str:
    """Say in which settings a situation's best method breaks, or how far it is from that."""
    settings, broken = advice.by_setting, advice.broken
    worst = f"{number(settings[advice.worst].mean_penalised_deg, 2)}°"
    if not broken:
        return f"not here: at most {worst}" + (f", {_short(advice, advice.worst)}" if len(settings) > 1 else "")
    first, figures = next(iter(broken.items()))
    if len(settings) == 1:
        return f"here: {_why(figures)}"
    if len(broken) == len(settings):
        return f"all {len(settings)} settings: {_why(figures)} or more"
    count = f"{len(broken)} of {len(settings)} settings, {_short(advice, first)}: {_why(figures)}"
    return count if len(broken) == 1 else f"{count}; worst {worst}"


def _why(figures: MethodFigures) -> str:
    if figures.answered < LEAST_ANSWERED * figures.n:
        return f"{figures.answered} of {figures.n} answered"
    return f"mean {number(figures.mean_penalised_deg, 2)}°"


def _short(advice: Advice, setting: str) -> str:
    """Return a setting's name, without the curve's where the situation has one curve."""
    labels = advice.situation.labels
    return setting.removeprefix(f"{labels[0]}, ") if len(labels) == 1 else setting


def method_rows(guide: Guide, about: Mapping[str, str]) -> list[MethodRow]:
    """Return a row for each method; `about` describes them by name."""
    rows = []
    for name in estimator_order(guide.estimators):
        own = [each for each in guide.advice if name in each.methods]
        best = sum(each.best == name for each in own)
        tied = sum(name in each.ties for each in own)
        told = f"{best} of {len(own)}" + (f", tied in {tied}" if tied else "")
        rows.append(MethodRow(name, about.get(name, ""), told, _broken(name, own)))
    return rows


def _broken(name: str, own: Sequence[Advice]) -> str:
    """Say in how many situations a method breaks as a whole, and in which least and most."""
    broken = [each for each in own if each.methods[name].breaks]
    if not broken:
        return "in none as a whole"
    ranked = sorted(broken, key=lambda each: each.methods[name].mean_penalised_deg)
    texts = [f"{each.situation.title} ({_why(each.methods[name])})" for each in (ranked[0], ranked[-1])]
    if len(ranked) == 1:
        return f"1 of {len(own)}: {texts[0]}"
    return f"{len(ranked)} of {len(own)}, from {texts[0]} to {texts[1]}"


def shared_sentence(guide: Guide) -> str:
    """Say what holds in all situations; empty where nothing does."""
    return f"In every situation: {', '.join(guide.shared)}." if guide.shared else ""

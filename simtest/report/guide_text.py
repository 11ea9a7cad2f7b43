"""The guide to a run's methods in words, for its page, for guide.json and for the terminal."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from simtest.estimators.names import is_own
from simtest.pages.style import estimator_order, number
from simtest.validation.comparison import LEAST_FRAMES, MATTERS_DEG, MATTERS_SHARE
from simtest.validation.guide import BREAK_DEG, LEAST_ANSWERED, Advice, Guide, MethodFigures

HEADS = ("situation", "best method", "median error", "answered", "where it breaks")

NOTABLE_SHARE = 0.1
"""A larger share of highlights without an answer is told beside where a method breaks."""

RULES = (
    "Median error: the angle between the estimated and the true normal, of the answers. The units of its 95 % "
    f"interval are frames within their settings; none is given for fewer than {LEAST_FRAMES} distinct frames.",
    "Answered: of the true highlights that the method had to answer for. Missed ones were not detected; refused ones "
    "were, and the method gave a reason instead of a normal; failed ones were, and its code or process stopped with an "
    "error.",
    "Best method: no other has a smaller mean error on the highlights that both answered. Two methods are tied where "
    f"that difference is below {MATTERS_DEG:g}° or {100 * MATTERS_SHARE:g} % of the better one's mean error, or where "
    "its 95 % interval holds 0. Frames are its independent units, and spread between settings does not widen it. "
    "Highlights without an answer count in their column alone, but a method that answers fewer than "
    f"{100 * LEAST_ANSWERED:g} % is not the best where another answers more, and one that breaks is not tied with one "
    "that does not.",
    f"Fewer than {LEAST_FRAMES} distinct frames are too few to rank by: methods whose difference they leave open are "
    "not called tied.",
    "Frames whose errors are the same to the last bit, as without noise, count as one frame.",
    "Methods that state the normal of the base, the surface without its relief, are ranked in rows of their own.",
    f"A method breaks where the mean error of its answers exceeds {BREAK_DEG:g}°, or where it answers fewer than "
    f"{100 * LEAST_ANSWERED:g} % of the highlights. Where it breaks nowhere, but more than {100 * NOTABLE_SHARE:g} % "
    "of the highlights have no answer, that is told first.",
    "An estimator of another package or of your own has a line in each situation, best or not.",
)
"""How the table is made."""

WORDS = {
    "k d": "curvature times distance, positive where the surface is convex; of the base where there is a relief",
    "ε/d": "distance of the light from the camera over that of the surface",
    "flat": "|k d| below 0.05",
    "outside, inside of a tube": "convex, concave in one direction, flat in the other",
    "dome, bowl": "convex, concave in both directions",
    "position, distance known": "what the methods may use: where the light is, how far the surface is",
}
"""Words of the situations and figures, explained."""

PRACTICE = Path(__file__).parent / "practice.toml"
"""What pictures from practice give, by the experiments beside whose figures it is shown."""

MOST_ANSWERS = 8
"""Lines of the page's first table; the table below it has them all."""


@dataclass(frozen=True)
class GuideRow:
    """A situation's row; texts but for the names."""

    surface: str
    circumstances: str
    best: str | None
    ties: tuple[str, ...]
    unranked: str  # that the frames are too few to rank by, where they are
    error: str
    answered: str
    unanswered: str  # why, where there are any
    breaks: str
    is_broken: bool  # whether the best method breaks in one of the settings
    guests: "tuple[GuestRow, ...]" = ()  # a line of each method from elsewhere that is not the best


@dataclass(frozen=True)
class GuestRow:
    """A line of a situation on a method that is not this package's; texts but for the name."""

    estimator: str
    standing: str  # "tied", "not ranked" or "not best"
    error: str
    answered: str
    unanswered: str
    breaks: str
    is_broken: bool


@dataclass(frozen=True)
class MethodRow:
    """A method's row."""

    estimator: str
    about: str
    best: str
    breaks: str


def guide_content(
    guide: Guide, about: Mapping[str, str], frames: int | None = None, experiment: str = ""
) -> dict[str, Any]:
    """Return the content of guide.json: the rows in words, and the figures that they are made of.

    `about` describes the methods by name; `frames` is the number of the run's frames, where it is known.
    """
    rows = [
        vars(row)
        | {
            "guests": [vars(guest) for guest in row.guests],
            "target": advice.target,
            "settings": advice.situation.settings,
            "methods": {name: _figures(figures) for name, figures in advice.methods.items()},
            "best_by_setting": {name: _figures(figures) for name, figures in advice.by_setting.items()},
        }
        for row, advice in zip(guide_rows(guide), guide.advice, strict=True)
    ]
    return {
        "heads": HEADS, "rows": rows, "shared": shared_sentence(guide), "seen": seen_sentence(guide, frames),
        "left_out": guide.left_out,
        "methods": [vars(row) for row in method_rows(guide, about)], "rules": RULES, "words": WORDS,
        "practice": practice(experiment),
    }  # fmt: skip


def practice(experiment: str) -> dict[str, Any] | None:
    """Return what practice gives beside an experiment's figures, its rows with the cells of a situation's row."""
    measured = tomllib.loads(PRACTICE.read_text(encoding="utf-8"))
    if experiment not in measured["experiments"]:
        return None
    rows = [
        row | {
            "unanswered": "",
            "error": f"{row['median_deg']:g}°" + (f" (95 % below {row['p95_deg']:g}°)" if "p95_deg" in row else ""),
            "breaks": f"95 % region of {row['region_deg']:g}°"
            + (f", covers {row['covered_percent']} %" if "covered_percent" in row else ""),
        }
        for row in measured["rows"]
    ]  # fmt: skip
    return {"title": measured["title"], "about": measured["about"], "rows": rows}


def answers(content: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the lines of the page's first table: situations of one kind of light that have one best method."""
    groups: dict[tuple[str, str, str], list[Mapping[str, Any]]] = {}
    for row in content["rows"]:
        groups.setdefault((row["circumstances"], row["best"] or "", row["unranked"]), []).append(row)
    lines = []
    for (circumstances, best, unranked), rows in groups.items():
        medians = [row["methods"][best]["median_deg"] for row in rows if best]
        ends = dict.fromkeys(number(end, 2) for end in (min(medians), max(medians))) if medians else ()
        broken = [row["surface"] for row in rows if row["is_broken"]]
        surfaces = ", ".join(row["surface"] for row in rows)
        notes = (surfaces if circumstances else "", unranked, f"breaks: {', '.join(broken)}" if broken else "")
        lines.append(
            {
                "situation": circumstances or surfaces, "best": best, "error": " to ".join(ends) + "°" * bool(ends),
                "note": "; ".join(filter(None, notes)),
            }
        )  # fmt: skip
    return lines


def _figures(figures: MethodFigures) -> dict[str, Any]:
    return {
        **{name: value for name, value in vars(figures).items() if name != "estimator"},
        "refused": figures.refused, "breaks": figures.breaks,
    }  # fmt: skip


def guide_rows(guide: Guide) -> list[GuideRow]:
    """Return a row for each situation."""
    return [_row(advice) for advice in guide.advice]


def _row(advice: Advice) -> GuideRow:
    where = (_surface(advice), advice.situation.circumstances)
    guests = tuple(_guest(advice, name) for name in advice.methods if not is_own(name) and name != advice.best)
    if advice.best is None:
        return GuideRow(*where, None, (), "", "–", f"0 of {advice.n}", "", "no method answered", True, guests)
    best = advice.methods[advice.best]
    return GuideRow(
        *where, advice.best, advice.ties, _unranked(advice), _error(best), _share(best), _unanswered(best),
        _breaks(advice), bool(advice.broken), guests,
    )  # fmt: skip


def _guest(advice: Advice, name: str) -> GuestRow:
    figures = advice.methods[name]
    # Worded as if it were the best: where it breaks, or its worst setting.
    alone = replace(advice, best=name, by_setting=advice.guests.get(name, {}))
    why = _breaks(alone) if alone.by_setting else "–"
    return GuestRow(
        name, _standing(advice, name), _error(figures) if figures.answered else "–",
        _share(figures), _unanswered(figures), why, bool(alone.broken),
    )  # fmt: skip


def _standing(advice: Advice, name: str) -> str:
    return "tied" if name in advice.ties else "not ranked" if name in advice.unranked else "not best"


def _unranked(advice: Advice) -> str:
    if not advice.unranked:
        return ""
    return "too few highlights to rank" + ("" if advice.few else f" beside {', '.join(advice.unranked)}")


def _surface(advice: Advice) -> str:
    return advice.situation.surface + (", normal of the base" if advice.target == "base" else "")


def _error(figures: MethodFigures) -> str:
    low, high = figures.interval_deg
    texts = [number(value, 2) for value in (figures.median_deg, low, high)]
    return f"{texts[0]}°" if low is None else f"{texts[0]}° ({texts[1]}–{texts[2]})"


def _share(figures: MethodFigures) -> str:
    return f"{figures.answered} of {figures.n}"


def _unanswered(figures: MethodFigures) -> str:
    parts = ((figures.missed, "missed"), (figures.refused, "refused"), (figures.failed, "failed"))
    return ", ".join(f"{count} {word}" for count, word in parts if count)


def _mean(figures: MethodFigures) -> str:
    return f"{number(figures.mean_deg, 2)}°"


def _breaks(advice: Advice) -> str:
    """Return in words in which settings a situation's best method breaks, or how far it is from that."""
    settings = advice.by_setting
    if not advice.broken:
        seen = "this highlight" if advice.n == 1 else f"these {advice.n} highlights"
        nowhere = f"not in {seen}" if advice.few else "nowhere here"
        if len(settings) > 1:
            median = number(settings[advice.worst].median_deg, 2)
            nowhere += f" (largest median: {median}°, at {_short(advice, advice.worst)})"
        best = advice.methods[advice.best or ""]
        silent_share = 1 - best.answered / best.n
        if silent_share <= NOTABLE_SHARE:
            return nowhere
        return f"{100 * silent_share:.0f} % of the highlights have no answer ({_unanswered(best)}); else {nowhere}"
    errs = {name: figures for name, figures in settings.items() if figures.errs}
    silent = {name: figures for name, figures in settings.items() if figures.is_silent}
    mildest_first = sorted(errs, key=lambda name: errs[name].mean_deg or 0.0)
    fewest_last = sorted(silent, key=lambda name: silent[name].answered / silent[name].n, reverse=True)
    parts = (
        _span(advice, mildest_first, "mean {}", _mean, "or more"),
        _span(advice, fewest_last, "{} answered", _share, "or fewer"),
    )
    return "; ".join(filter(None, parts))


def _span(
    advice: Advice, names: Sequence[str], form: str, told: Callable[[MethodFigures], str], beyond: str
) -> str:  # fmt: skip
    """Return in words at which settings, the mildest first, a method breaks in one way; empty where it does not."""
    if not names:
        return ""
    count = len(advice.by_setting)
    first, last = (told(advice.by_setting[names[end]]) for end in (0, -1))
    if count == 1:
        return f"here: {form.format(first)}"
    if len(names) == count:
        return f"all {count} settings: {form.format(first)}" + (f" {beyond}" if first != last else "")
    if len(names) == 1:
        return f"1 of {count} settings, {_short(advice, names[0])}: {form.format(first)}"
    ends = f"{first} ({_short(advice, names[0])}) to {last} ({_short(advice, names[-1])})"
    return f"{len(names)} of {count} settings: {form.format(ends)}"


def _why(figures: MethodFigures) -> str:
    """Return in words why a method breaks."""
    told = [f"mean {_mean(figures)}"] if figures.errs else []
    told += [f"{_share(figures)} answered"] if figures.is_silent else []
    return ", ".join(told)


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
    """Return in words in how many situations a method breaks as a whole, and in which least and most."""
    broken = [each for each in own if each.methods[name].breaks]
    if not broken:
        return "in none as a whole"
    ranked = sorted(broken, key=lambda each: each.methods[name].mean_penalised_deg)
    texts = [f"{each.situation.title} ({_why(each.methods[name])})" for each in (ranked[0], ranked[-1])]
    if len(ranked) == 1:
        return f"1 of {len(own)}: {texts[0]}"
    return f"{len(ranked)} of {len(own)}; least in {texts[0]}, most in {texts[1]}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def seen_sentence(guide: Guide, frames: int | None) -> str:
    """Return how many true highlights were seen in how many frames; empty where every frame shows one."""
    if frames is None or frames <= guide.frames:
        return ""
    seen = f"{_counted(guide.highlights, 'true highlight')} in {_counted(frames, 'frame')}"
    return f"{seen}; {_counted(frames - guide.frames, 'frame')} without one."


def shared_sentence(guide: Guide) -> str:
    """Return a sentence on what holds in all situations, and on ε/d where one names it; else an empty one."""
    told = [f"In every situation: {', '.join(guide.shared)}."] if guide.shared else []
    if any("ε/d" in text for text in (*guide.shared, *(each.situation.circumstances for each in guide.advice))):
        told.append("ε/d is the light's distance from the camera over that of the surface.")
    return " ".join(told)

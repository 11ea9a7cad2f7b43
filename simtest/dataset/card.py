"""The dataset card: a README for people, whose head Hugging Face `datasets` reads."""

from collections.abc import Iterator
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.dataset.index import ESTIMATES, HIGHLIGHTS, SAMPLES
from simtest.dataset.manifest import Manifest
from simtest.dataset.plan import Plan
from simtest.pages.markdown import escaped, paragraphs, yaml_string
from simtest.runtime.files import write_atomically
from simtest.spec.recipes import Distribution

CARD = "README.md"


def write_card(plan: Plan, manifest: Manifest, folder: Path) -> None:
    """Write the card."""
    text = make_card(plan, manifest)
    write_atomically(folder / CARD, lambda part: part.write_text(text, encoding="utf-8"))


def make_card(plan: Plan, manifest: Manifest) -> str:
    """Return the card's text, which depends on the dataset alone."""
    dataset = plan.dataset
    # samples and shards of each split
    counts: dict[str, list[int]] = {name: [0, 0] for name in plan.splits}
    for shard in plan.shards:
        counts[shard.split][0] += len(shard.indices)
        counts[shard.split][1] += 1
    # Markdown, not HTML, so what a recipe says is escaped where it stands.
    environment = Environment(  # nosec B701
        loader=PackageLoader("simtest.dataset", "."), undefined=StrictUndefined, autoescape=False, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(escaped=escaped, paragraphs=paragraphs, yaml=yaml_string)
    return environment.get_template("card.md.j2").render(
        dataset=dataset,
        counts=counts,
        made_small=plan.made_small,
        fields=plan.fields,
        has_relief=plan.has_relief,
        has_instruments=plan.has_instruments,
        draws=list(_draws(plan)),
        tables=(SAMPLES, HIGHLIGHTS, ESTIMATES),
        meshes=sorted({path.name for path in plan.inputs if path.suffix != ".toml"}),
        isovalue=HIGHLIGHT_ISOVALUE,
        versions=manifest.origin["versions"],
        variant=manifest.origin["variant"],
    )


def _draws(plan: Plan) -> Iterator[tuple[str, str, str]]:
    """Yield how often each drawn key is drawn, the key, and from what."""
    dataset = plan.dataset
    for number, family in enumerate(dataset.families):
        where = f"family {number} ({family.scene}), each"
        yield from ((f"{where} anatomy", key, _describe(drawn)) for key, drawn in family.per_anatomy.items())
        yield from ((f"{where} sample", key, _describe(drawn)) for key, drawn in family.per_sample.items())
    yield from (("each sample", key, _describe(drawn)) for key, drawn in dataset.per_sample.items())


def _describe(drawn: Distribution) -> str:
    if drawn.choose:
        weights = f", weights {list(drawn.weights)}" if drawn.weights else ""
        return f"one of {list(drawn.choose)}{weights}"
    kind = "whole numbers" if drawn.integer else "even in the logarithm" if drawn.log else "even"
    return f"{drawn.low:g} to {drawn.high:g}, {kind}"

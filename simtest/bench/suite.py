"""A suite of the benchmark: frozen cases by part, the hashes that pin them, and the scenes that are drawn of them.

A case is a scene with every default written out (scenes/bench/v1/PART/NAME.toml), and the values that are drawn for
each of its scenes (suite.toml). No later release changes it: a changed case is a new version of the suite.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.runtime.boundary import close_names
from simtest.runtime.files import Json
from simtest.runtime.provenance import file_hash
from simtest.runtime.resources import data_root
from simtest.runtime.seeds import Stage, generator
from simtest.spec import AnatomySurface, Experiment, Group, read_toml
from simtest.spec.spec_model import Name, Spec, load

FORMAT = 1
"""Of the cases' files; it enters their hashes."""

SUITES = {"v1": "simtest-bench v1"}
HASHES, SUITE = "hashes.json", "suite.toml"

HIGHLIGHTS = "highlights"

DIGITS = 6
"""Of a drawn value: mathematical libraries differ in the last ones."""

PartKind = Literal["highlights", "maps"]

Layout = Mapping[str, tuple[int, int]]
"""By case: the number of its scenes, and of the frames of each."""


class Draw(Spec):
    """The distribution of a value that is drawn for each scene of a case."""

    kind: Literal["uniform", "log_uniform", "integer", "normal"] = "uniform"
    low: float | None = Field(None, description="least value; of a normal distribution its mean")
    high: float = Field(description="largest value; of a normal distribution its standard deviation")
    blocks: int | None = Field(
        None,
        ge=1,
        description="draw so many values, each for a block of scenes that follow each other; default one each",
    )

    @model_validator(mode="after")
    def _ordered(self) -> "Draw":
        if self.kind != "normal" and (self.low is None or self.low > self.high):
            raise ValueError(f"low = {self.low} and high = {self.high}: low must be given and not exceed high")
        if self.kind == "log_uniform" and (self.low or 0) <= 0:
            raise ValueError(f"low = {self.low}: must be positive where the logarithm is uniform")
        return self


class PartSpec(Spec):
    """A part of the suite, which has a row of its own in the table."""

    name: Name
    title: str
    description: str
    kind: PartKind = "highlights"


class CaseSpec(Spec):
    """A case: how many scenes are drawn of it, and how many frames are taken of each."""

    part: Name
    name: Name
    draws: int = Field(ge=1, le=1000)
    realisations: int = Field(1, ge=1, le=1000, description="frames of each scene, which differ in noise")
    isolated: bool = Field(True, description="count isolated highlights only")
    draw: dict[str, Draw] = Field(default_factory=dict, description="drawn values by key path")


class SuiteSpec(Spec):
    """The content of suite.toml."""

    name: Name
    title: str
    description: str
    format: Literal[1]
    seed: int = Field(ge=0, lt=2**63, description="the public seed")
    parts: tuple[PartSpec, ...] = Field(min_length=1)
    cases: tuple[CaseSpec, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _told_apart(self) -> "SuiteSpec":
        names = [f"{case.part}/{case.name}" for case in self.cases]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"case {twice}: listed twice")
        parts = [part.name for part in self.parts]
        if lost := next((case.part for case in self.cases if case.part not in parts), None):
            raise ValueError(f"part {lost!r}: not listed; allowed: {', '.join(parts)}")
        return self


@dataclass(frozen=True)
class FrozenCase:
    """A case with its scene's tables and its hash."""

    spec: CaseSpec  # its entry in suite.toml
    file: Path  # of the scene
    scene: dict[str, Any]  # its tables
    digest: str  # SHA-256 of what defines the case

    @property
    def name(self) -> str:
        """Part and name."""
        return f"{self.spec.part}/{self.spec.name}"


@dataclass(frozen=True)
class Suite:
    """A version of the benchmark, read and checked against its pinned hashes."""

    version: str
    spec: SuiteSpec
    cases: tuple[FrozenCase, ...]
    digest: str

    @property
    def hashes(self) -> dict[str, str]:
        """Hash of each case, by part and name."""
        return {case.name: case.digest for case in self.cases}

    def part(self, name: str) -> PartSpec:
        """Return a part by name; raise `InputError` if there is none."""
        for part in self.spec.parts:
            if part.name == name:
                return part
        names = [part.name for part in self.spec.parts]
        meant = "".join(f" (did you mean {close}?)" for close in close_names(name, names))
        raise InputError(f"--part {name}: unknown; allowed: {', '.join(names)}{meant}")

    def of_part(self, name: str) -> list[FrozenCase]:
        """Return the cases of a part."""
        return [case for case in self.cases if case.spec.part == name]


def canonical(value: Json) -> bytes:
    """Return JSON as bytes that are the same on every machine: keys sorted, no spaces, shortest exact numbers."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode()


def digest_of(value: Json) -> str:
    """Return the SHA-256 of a value's canonical JSON."""
    return hashlib.sha256(canonical(value)).hexdigest()


def suite_folder(version: str) -> Path:
    """Return the folder of a shipped suite; raise `InputError` for an unknown version."""
    if version not in SUITES:
        raise InputError(f"suite {version!r}: unknown; allowed: {', '.join(SUITES)}")
    return data_root("scenes") / "bench" / version


def read_suite(folder: Path) -> Suite:
    """Read a suite and compute its hashes, without a look at the pinned ones.

    Raises `InputError` if a file is missing or malformed.
    """
    spec = load(SuiteSpec, folder / SUITE)
    # The hash is of the file's own tables: the model's would change with each key that a later release adds.
    tables = read_toml(folder / SUITE)["cases"]
    cases = tuple(_read_case(folder, case, table) for case, table in zip(spec.cases, tables, strict=True))
    # The suite's prose may be mended; what defines it may not.
    parts = [{"name": part.name, "kind": part.kind} for part in spec.parts]
    whole: Json = {
        "format": FORMAT, "name": spec.name, "seed": spec.seed, "parts": parts,
        "cases": {case.name: case.digest for case in cases},
    }  # fmt: skip
    return Suite(folder.name, spec, cases, digest_of(whole))


def load_suite(version: str = "v1", folder: Path | None = None) -> Suite:
    """Read a shipped suite and check it against its pinned hashes.

    Raises `InputError` if the version is unknown, a file is malformed, or a case is not the frozen one.
    """
    folder = folder or suite_folder(version)
    suite = read_suite(folder)
    try:
        pinned = json.loads((folder / HASHES).read_text(encoding="utf-8"))
        told, of_suite = dict(pinned["cases"]), str(pinned["suite"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / HASHES}: cannot be read as the pinned hashes ({error})") from error
    for name, digest in suite.hashes.items():
        if told.get(name) != digest:
            raise InputError(
                f"case {name} of {SUITES.get(version, version)}: its hash is {digest[:12]}, pinned is "
                f"{str(told.get(name))[:12]}; a changed case must be a new version"
            )
    if suite.digest != of_suite or set(told) != set(suite.hashes):
        raise InputError(f"{folder / SUITE}: parts, seed or list of cases are not those pinned in {HASHES}")
    return suite


def cases_of(suite: Suite, parts: Iterable[str]) -> dict[str, str]:
    """Return the hashes of the cases of some parts, by part and name."""
    return {case.name: case.digest for part in parts for case in suite.of_part(part)}


def parts_of_overall(suite: Suite) -> list[str]:
    """Return the parts whose scores make the headline: those whose unit is the highlight."""
    return [part.name for part in suite.spec.parts if part.kind == HIGHLIGHTS]


def layout_of(suite: Suite, part: str) -> Layout:
    """Return how many scenes each case of a part has, and how many frames each scene is taken in."""
    return {case.spec.name: (case.spec.draws, case.spec.realisations) for case in suite.of_part(part)}


def _read_case(folder: Path, spec: CaseSpec, table: dict[str, Any]) -> FrozenCase:
    file = folder / spec.part / f"{spec.name}.toml"
    scene = read_toml(file)
    content: Json = {"format": FORMAT, "case": table, "scene": scene, "files": _meshes(scene)}
    return FrozenCase(spec, file, scene, digest_of(content))


def _meshes(scene: Mapping[str, Any]) -> dict[str, str]:
    """Return the hashes of mesh files by name; a recipe's values stand in the scene itself."""
    surface = scene.get("surface", {})
    if surface.get("type") != "anatomy":
        return {}
    file = AnatomySurface.model_validate(surface).file()
    return {} if file.suffix == ".toml" else {file.name: file_hash(file)}


def experiment_of(suite: Suite, part: str, core: str) -> Experiment:
    """Return a part as an experiment of one estimator.

    Each drawn scene is a pooled value of its case, so that a case is one setting of the results.
    """
    text = f"{suite.spec.name} {suite.version} | {part} | {suite.spec.seed}"
    seed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1
    name = f"{suite.spec.name}-{suite.version}-{part}"
    groups = []
    for case in suite.of_part(part):
        pool = pooled(seed, name, case.spec)
        groups.append(
            Group(
                scene=str(Path(case.file).resolve()),
                label=case.spec.name,
                pool=(pool,) if pool else (),
                realisations=case.spec.realisations,
                isolated=case.spec.isolated,
            )
        )
    about = suite.part(part)
    return Experiment(
        name=name, title=f"{suite.spec.title}: {about.title}", description=about.description, seed=seed,
        estimators=(core,), groups=tuple(groups),
    )  # fmt: skip


def pooled(seed: int, experiment: str, case: CaseSpec) -> dict[str, tuple[float | int, ...]]:
    """Return the drawn values of a case's scenes by key path; each hangs on its key and its number alone."""
    made = {}
    for key, draw in sorted(case.draw.items()):
        numbers = [n if draw.blocks is None else n * draw.blocks // case.draws for n in range(case.draws)]
        made[key] = tuple(_drawn(seed, experiment, f"{case.name} | {key}", n, draw) for n in numbers)
    return made


def _drawn(seed: int, experiment: str, name: str, number: int, draw: Draw) -> float | int:
    rng = generator(seed, experiment, name, number, Stage.SWEEP)
    low, high = draw.low or 0.0, draw.high
    if draw.kind == "normal":
        value = low + high * float(rng.standard_normal())
    elif draw.kind == "log_uniform":
        value = math.exp(float(rng.uniform(math.log(low), math.log(high))))
    elif draw.kind == "integer":
        return int(rng.integers(int(low), int(high), endpoint=True))
    else:
        value = float(rng.uniform(low, high))
    return float(f"{value:.{DIGITS}g}")

"""The form of a certificate's content: what the table reads."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from simtest.bench.uncertainty import LEAST_STATED, LEVEL, NARROW, SCALED, UNTESTED


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
Interval = Annotated[list[Angle], Field(min_length=2, max_length=2), AfterValidator(_ordered)]
SceneSum = Annotated[list[Figure], Field(min_length=2, max_length=2)]
Shares = Annotated[list[Share], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class Form(BaseModel):
    """Base of the tables: other keys are refused, numbers are finite and never text."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True, defer_build=True)


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


class UncertaintyForm(Form):
    """See `simtest.bench.uncertainty.UncertaintyScore`."""

    n: Count
    coverage: Share | None
    interval: Shares | None
    verdict: Literal["overconfident", "calibrated", "underconfident", "too few"]
    inflation: Figure | None
    semi_axis_deg: Figure | None
    energy_deg: Figure | None

    @model_validator(mode="after")
    def _consistent(self) -> "UncertaintyForm":
        if (self.coverage is None) != (self.n == 0) or (self.interval is None) != (self.n == 0):
            raise ValueError(f"n = {self.n}: coverage and interval stand where n is not 0")
        low, high = self.interval or (0.0, 1.0)
        if self.coverage is not None and not low - 1e-9 <= self.coverage <= high + 1e-9:
            raise ValueError(f"coverage = {self.coverage}: lies outside its interval")
        if (self.verdict == UNTESTED) != (self.n < LEAST_STATED):
            raise ValueError(f"verdict = {self.verdict}: does not go with n = {self.n}")
        share = LEVEL if self.coverage is None else self.coverage
        if (self.verdict == NARROW and share >= LEVEL) or (self.verdict == SCALED and share <= LEVEL):
            raise ValueError(f"verdict = {self.verdict}: does not go with a coverage of {share}")
        return self


class ZoneForm(Form):
    """Figures of a zone of maps; see `simtest.bench.maps.dense_figures`."""

    n: Count
    n_unanswered: Count
    mean_deg: Angle | None
    median_deg: Angle | None
    median_interval: Interval | None
    p95_deg: Angle | None
    penalised_deg: Angle | None
    penalised_interval: Interval | None


class StatedForm(Form):
    """What was stated of maps; see `simtest.bench.maps.stated_record`."""

    encoding: Text | None
    frame: Text | None
    depth: Text | None
    unit_mm: Annotated[float, Field(gt=0)] | None


class PartForm(Form):
    """See `simtest.bench.scores.PartScore`."""

    n: Count
    answered: Count
    missed: Count
    false: Count
    refused: dict[str, Count]
    median_deg: Angle | None
    median_interval: Interval | None
    mean_deg: Angle | None
    p95_deg: Angle | None
    score_deg: Angle | None
    score_interval: Interval | None
    scenes: dict[Text, list[SceneSum]]
    uncertainty: UncertaintyForm
    results: Hash
    # Of maps alone.
    source: Text | None = None
    zones: dict[Text, ZoneForm] | None = None
    conventions: list[Annotated[str, Field(max_length=2000)]] | None = None
    stated: StatedForm | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "PartForm":
        if None not in (self.median_deg, self.p95_deg) and self.median_deg > self.p95_deg:  # type: ignore[operator]
            raise ValueError(f"median_deg = {self.median_deg}: exceeds p95_deg = {self.p95_deg}")
        if self.uncertainty.n > self.answered:
            raise ValueError(f"uncertainty.n = {self.uncertainty.n}: exceeds answered = {self.answered}")
        return self


class OverallForm(Form):
    """The headline."""

    complete: bool
    score_deg: Angle | None
    score_interval: Interval | None


class CertificateForm(Form):
    """The whole content, without its own hash."""

    kind: Text
    format: int
    suite: SuiteForm
    cases: dict[str, Hash]
    core: CoreForm
    environment: EnvironmentForm
    parts: Annotated[dict[str, PartForm], Field(min_length=1)]
    overall: OverallForm

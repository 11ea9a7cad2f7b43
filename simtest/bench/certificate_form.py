"""The form of a certificate's content: what the table and a verification read. A stranger may have written it."""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Text = Annotated[str, Field(max_length=200)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]
Angle = Annotated[float, Field(ge=0)]
Interval = Annotated[list[Angle], Field(min_length=2, max_length=2)]


class Form(BaseModel):
    """Base of the tables: keys that are not named here are left alone, numbers are finite and never text."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True, defer_build=True)


class SuiteForm(Form):
    """Which suite it is of."""

    name: Text
    version: Text
    sha256: Hash


class SeedsForm(Form):
    """Public seeds, or the commitment to sealed ones."""

    kind: Literal["public", "sealed"]
    seed: int | None = None
    commitment: Text | None = None


class CoreForm(Form):
    """What was run."""

    name: Text
    kind: Literal["installed", "command", "maps", "baseline"]
    version: Text | None
    sha256: Hash | None


class EnvironmentForm(Form):
    """On what it was run."""

    processor: Text | None
    versions: dict[str, str | None]


class UncertaintyForm(Form):
    """See `simtest.bench.uncertainty.UncertaintyScore`."""

    n: Count
    coverage: Annotated[float, Field(ge=0, le=1)] | None
    interval: Interval | None
    verdict: Literal["overconfident", "calibrated", "underconfident", "too few"]
    inflation: Angle | None
    semi_axis_deg: Angle | None
    energy_deg: Angle | None


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
    penalised_deg: Angle | None
    penalised_interval: Interval | None
    uncertainty: UncertaintyForm
    results: Hash


class OverallForm(Form):
    """The headline."""

    complete: bool
    penalised_deg: Angle | None
    penalised_interval: Interval | None


class RequestForm(Form):
    """How long a request took."""

    unit: Literal["highlight", "frame"]
    n: Count
    median_ms: Angle | None
    max_ms: Angle | None


class TimingForm(Form):
    """What is of the machine alone."""

    request: RequestForm


class CertificateForm(Form):
    """The whole content, without its own hash."""

    kind: Text
    format: int
    suite: SuiteForm
    cases: dict[str, Hash]
    seeds: SeedsForm
    core: CoreForm
    environment: EnvironmentForm
    parts: Annotated[dict[str, PartForm], Field(min_length=1)]
    overall: OverallForm
    timing: TimingForm

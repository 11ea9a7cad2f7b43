"""The frames of a run or a dataset, rendered again from their seeds, and what was exported of them (export.json)."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Protocol

import numpy as np
import polars as pl
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, model_validator

from simtest.calibration import Calibration
from simtest.conventions import ON_INSTRUMENT
from simtest.dataset.manifest import NAME as MANIFEST
from simtest.dataset.reader import open_manifest, read_samples
from simtest.dataset.sample_calibration import calibration_of, picture_sensor, stored_picture
from simtest.dataset.shard_writer import maker_of
from simtest.errors import InputError
from simtest.estimators import AnyEstimator
from simtest.reconstruction import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import Session
from simtest.runtime import provenance
from simtest.runtime.arrays import Image
from simtest.runtime.files import read_json, require_plain, write_json
from simtest.simulation.frame import RenderedView
from simtest.spec import Experiment, Scene
from simtest.spec.recipes import CoreRegions, Dataset
from simtest.spec.sensor import Sensor
from simtest.spec.spec_model import validate
from simtest.validation.case_work import gallery_cases, realiser_of
from simtest.validation.cases import Case, expand, swept_example
from simtest.validation.columns import Row, Value
from simtest.validation.fingerprints import definition
from simtest.validation.realisation import answer, keep_frame, realise
from simtest.validation.run_folder import EXPORT
from simtest.validation.run_summary import ExperimentSummary, summarise_run
from simtest.validation.statistics import ANATOMY, summarise

# What was exported --------------------------------------------------------------------------------------------------

Format = Literal["simtest export, version 1"]
FORMAT: Format = "simtest export, version 1"

Coordinate = Annotated[float, Field(allow_inf_nan=False)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ExportedFrame(_Model):
    """One frame: SHA-256 of its values, its camera's table, and peaks and boxes of the detections in it, px."""

    sha256: str
    camera: str
    peaks: tuple[tuple[Coordinate, Coordinate], ...]
    boxes: tuple[tuple[int, int, int, int], ...]

    @model_validator(mode="after")
    def _has_pairs(self) -> "ExportedFrame":
        if len(self.peaks) != len(self.boxes):
            raise ValueError(f"has {len(self.peaks)} peaks and {len(self.boxes)} boxes")
        return self


class Use(_Model):
    """What a frame shows. One frame may stand for several realisations that look the same."""

    frame: str
    case: int
    setting: str
    realisation: int


class Record(_Model):
    """Content of export.json."""

    format: Format = FORMAT
    kind: Literal["run", "dataset"]  # what the frames are of
    version: str  # of simtest
    fingerprint: str  # of the run whose folder this is; of a dataset its manifest's source
    definition: str  # hash of the experiment and its scenes; of a dataset that of its specification
    variant: str  # of Mitsuba
    # the experiment, with all values that the command replaced; empty for a dataset, whose manifest has it
    experiment: dict[str, JsonValue]
    cameras: dict[str, dict[str, JsonValue]]  # table of each camera, by name
    frames: dict[str, ExportedFrame]  # by name
    uses: tuple[Use, ...]  # in the order of cases and realisations

    @model_validator(mode="after")
    def _is_whole(self) -> "Record":
        if lost := {frame.camera for frame in self.frames.values()} - self.cameras.keys():
            raise ValueError(f"has no camera {sorted(lost)[0]}")
        if lost := {use.frame for use in self.uses} - self.frames.keys():
            raise ValueError(f"has no frame {sorted(lost)[0]}")
        return self

    def names(self) -> dict[int, dict[int, str]]:
        """Return the frames' names by case and realisation."""
        names: dict[int, dict[int, str]] = {}
        for use in self.uses:
            names.setdefault(use.case, {})[use.realisation] = use.frame
        return names

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of each frame by name."""
        return {name: frame.sha256 for name, frame in self.frames.items()}

    def write(self, folder: Path) -> None:
        """Write export.json into the folder of the run or dataset."""
        write_json(folder / EXPORT, self.model_dump(mode="json"), compact=True)


def read_record(folder: Path) -> Record:
    """Read export.json of a run or dataset; raise `InputError` where there is none, or one that cannot be used."""
    path = Path(folder) / EXPORT
    if not path.parent.is_dir():
        what = "is a file" if path.parent.exists() else "no such folder"
        raise InputError(f"{folder}: {what}; must be the folder of the run or dataset whose frames were exported")
    if not path.is_file() and (path.parent / "frames.csv").is_file() and (path.parent / "cameras").is_dir():
        raise InputError(
            f"{folder}: holds the exported frames (frames.csv); must be the folder of the run or dataset that "
            "they were exported from, which holds export.json"
        )
    again = "give the command again with --export DIR" if not (path.parent / MANIFEST).is_file() else (
        f"give simtest dataset export {folder} --out DIR"
    )  # fmt: skip
    try:
        text = require_plain(path, "manifest_bytes").read_bytes()
    except InputError as error:
        raise InputError(f"{error}; nothing was exported: {again}") from None
    try:
        return Record.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "whole"
        raise InputError(f"{path}: no record of an export ({where}: {first['msg']}); {again}") from error


def image_hash(image: Image) -> str:
    """Return the SHA-256 of a frame's shape and values, as float32."""
    values = np.ascontiguousarray(image, dtype="<f4")
    return hashlib.sha256(str(values.shape).encode() + values.tobytes()).hexdigest()


# Frames -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ShownFrame:
    """One frame as reconstruction sees it, without the truth."""

    # index of the experiment's case and number of the realisation; of a dataset 0 and the sample's index
    case: int
    realisation: int
    setting: str  # of the experiment; of a dataset the split
    image: Image  # the frame as the estimators see it, float32, shape (H, W) or (H, W, 3)
    sensor: Sensor  # the sensor as whose values it is encoded
    calibration: Calibration
    full_scale: float
    isolated: bool  # whether isolated highlights alone are detected and counted

    def detections(self) -> Sequence[Specularity]:
        """Detect the frame's highlights as a run does, without any estimator; none where no light reaches it."""
        if self.full_scale <= 0:
            return []
        return reconstruct(self.image, self.calibration, {}, isolated=self.isolated, detector="peaks")


@dataclass(frozen=True)
class RenderedFrame(ShownFrame):
    """One frame, with the view that it is of."""

    seed: int  # of the frame's noise
    view: RenderedView  # the rendered scene: truth, true highlights, calibration
    session: Session  # at the scene, until the next frame is taken
    swept: Mapping[str, Value]  # swept, pooled and drawn values by key path
    anatomy: str = ""  # name of the dataset's anatomy that it shows; empty in a run
    name: str = ""  # as in frames.csv, where it was exported


class Frames(Protocol):
    """Some frames of a run or a dataset; can be sent to another process."""

    @property
    def key(self) -> int:
        """Index of the case, or number of the shard."""

    @property
    def case(self) -> int:
        """Index of the case; of a dataset 0."""

    @property
    def variant(self) -> str:
        """Mitsuba's."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[RenderedFrame]: ...

    def shown(self) -> Iterator[ShownFrame]:
        """Yield the frames in the same order; rendered only where they are not stored."""

    def score(self, frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], item: Path | None) -> list[Row]:
        """Score the estimators' answers to one of the frames; keep it for the gallery where `item` names a file."""


@dataclass(frozen=True)
class CaseFrames:
    """The frames of one case of an experiment; `variant` is Mitsuba's."""

    experiment: Experiment
    described: Case
    case: int
    variant: str

    @property
    def key(self) -> int:
        """Index of the case."""
        return self.case

    def __len__(self) -> int:
        return len(self.described.numbers())

    def __iter__(self) -> Iterator[RenderedFrame]:
        experiment, case, realiser = self.experiment, self.described, realiser_of(self.variant)
        for number in case.numbers():
            view, drawn = realiser.view(experiment, case, number)
            seed = case.noise_seed(experiment, number)
            yield RenderedFrame(
                self.case, number, case.setting, view.frame(seed), view.scene.sensor, view.calibration, view.full_scale,
                case.isolated, seed, view, realiser.session, {**case.swept, **drawn},
            )  # fmt: skip

    shown = __iter__  # nothing is stored

    def score(self, frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], item: Path | None) -> list[Row]:
        """Score one of the frames as a run does."""
        of_run = (frame.session, self.experiment, self.described)
        scored = realise(*of_run, frame.realisation, frame.view, frame.swept, estimators)
        if item is not None:
            keep_frame(item, *of_run, scored)
        return scored.rows


@dataclass(frozen=True)
class ShardFrames:
    """The frames of one shard, a file, of a dataset, of which there are `count`; `variant` is Mitsuba's.

    The dataset's own estimators are not needed, and may not even be installed.
    """

    dataset: Dataset
    shard: Path
    key: int
    count: int
    variant: str
    case: int = 0

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[RenderedFrame]:
        maker = maker_of(self.dataset.model_dump_json(), self.variant)
        for index in maker.plan.shards[self.key].indices:
            drawn, view, session = maker.view(index)
            values: dict[str, Value] = {
                key: value if isinstance(value, bool | int | float | str) else str(value)
                for key, value in drawn.values.items()
            }
            sensor, anatomy = drawn.scene.sensor, drawn.anatomy
            picture = np.divide(stored_picture(view.frame(sensor.seed), sensor), np.float32(255), dtype=np.float32)
            yield RenderedFrame(
                self.case, index, maker.plan.split(index), picture, picture_sensor(sensor), view.calibration,
                view.full_scale, True, sensor.seed, view, session, values, f"{anatomy.family}.{anatomy.number}",
            )  # fmt: skip

    def shown(self) -> Iterator[ShownFrame]:
        """Yield the frames as the shard holds them."""
        for sample in read_samples(self.shard.parent, fields=["image"], shards=[self.shard.name]):
            meta, sensor = sample.meta, picture_sensor(Scene.model_validate(sample.meta["scene"]).sensor)
            picture, told = np.divide(sample.images["image"], np.float32(255), dtype=np.float32), calibration_of(meta)
            yield ShownFrame(self.case, meta["index"], meta["split"], picture, sensor, told, meta["full_scale"], True)

    def score(self, frame: RenderedFrame, estimators: Mapping[str, AnyEstimator], item: Path | None) -> list[Row]:
        """Score one of the frames as the dataset's maker does; no dataset has a gallery."""
        maker = maker_of(self.dataset.model_dump_json(), self.variant)
        answers = answer(frame.view, frame.image, estimators)
        rows = maker.score(frame.realisation, frame.session, frame.view, answers, estimators)
        return [row | {ANATOMY: frame.anatomy} for row in rows]


def frames_of_cases(experiment: Experiment, cases: Sequence[Case], variant: str) -> list[Frames]:
    """Return the rendered cases of an experiment; those of the published protocol render nothing and are left out.

    Raises `InputError` where nothing else is there.
    """
    parts: list[Frames] = [
        CaseFrames(experiment, case, index, variant) for index, case in enumerate(cases) if not case.is_paper
    ]
    if not parts:
        what = "follows the published protocol, which renders no frames"
        raise InputError(f"experiment {experiment.name}: {what}; choose an experiment on scenes")
    return parts


# Sources ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Source:
    """A run or dataset whose frames can be rendered again."""

    folder: Path  # of the run or dataset
    parts: Sequence[Frames]
    kind: Literal["run", "dataset"]
    # as in `Record`
    version: str
    fingerprint: str
    definition: str
    variant: str
    recipe: Experiment | Dataset  # what was run or made; of an experiment with its `cases`
    cases: Sequence[Case] = ()

    @property
    def shown_cases(self) -> set[int]:
        """Indices of the cases of which the gallery shows a frame."""
        return gallery_cases(list(self.cases)) if self.cases else set()

    @property
    def swept_example(self) -> Mapping[str, Value]:
        """An example of each value that results gain a column for."""
        if isinstance(self.recipe, Experiment):
            return swept_example(list(self.cases), self.recipe.regions)
        return {ON_INSTRUMENT: False, ANATOMY: ""}

    def with_regions(self, regions: CoreRegions | None) -> "Source":
        """Return it with the calibrations by which answers get regions, its own left out; a dataset takes none."""
        if not isinstance(self.recipe, Experiment):
            if regions is None:
                return self
            raise InputError(f"{self.folder}: is a dataset; --regions is for answers to the frames of a run")
        recipe = self.recipe.model_copy(update={"regions": regions})
        return replace(self, recipe=recipe, parts=frames_of_cases(recipe, self.cases, self.variant))

    def summary(self, results: pl.DataFrame, described: Mapping[str, str]) -> ExperimentSummary:
        """Return what summary.json says of results; `described` are the estimators."""
        recipe = self.recipe
        if isinstance(recipe, Experiment):
            return summarise_run(recipe, [case for case in self.cases if not case.is_paper], results, described)
        return ExperimentSummary(
            title=recipe.title or recipe.name, description=recipe.description, estimators={**described},
            settings=summarise(results),
        )  # fmt: skip


def source_of_run(folder: Path, experiment: Experiment) -> Source:
    """Return a finished run as a source of frames."""
    run, cases = _read_summary(folder), expand(experiment)
    version, fingerprint, variant = run["version"], run["fingerprint"], run["variant"]
    parts, is_of = frames_of_cases(experiment, cases, variant), definition(experiment, list(cases))
    return Source(folder, parts, "run", version, fingerprint, is_of, variant, experiment, cases)


def source_of_dataset(folder: Path) -> Source:
    """Return a dataset as a source of frames; raise `InputError` where there is none, or one of another version."""
    manifest = open_manifest(folder)
    plan, variant = manifest.plan(), str(manifest.origin["variant"])
    bare = plan.dataset.model_copy(update={"estimators": ()})
    parts = [
        ShardFrames(bare, folder / shard.name, number, len(shard.indices), variant)
        for number, shard in enumerate(plan.shards)
    ]
    is_of = hashlib.sha256(plan.dataset.model_dump_json().encode()).hexdigest()
    version, source = provenance.version(), str(manifest.origin["source"])
    return Source(folder, parts, "dataset", version, source, is_of, variant, plan.dataset)


def _read_summary(folder: Path) -> Mapping[str, str]:
    """Return how a finished run was made, from its summary.json; raise `InputError` where there is none."""
    path = folder / "summary.json"
    try:
        run = read_json(path)["run"]
        return {key: str(run[key]) for key in ("version", "fingerprint", "variant")}
    except InputError as error:
        raise InputError(f"{folder}: no finished run ({error})") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: is no summary of a run; give the simtest validate command again") from error


def open_source(folder: Path, record: Record) -> Source:
    """Return the run or dataset that a record is of, ready to be rendered again."""
    here = provenance.version()
    if record.version != here:
        raise InputError(
            f"{folder}: made by simtest {record.version}, this is {here}; score with that version, or run and "
            "export again"
        )
    if record.kind == "dataset":
        source = source_of_dataset(folder)
    else:
        experiment = validate(Experiment, dict(record.experiment), f"{folder / EXPORT}: experiment")
        source = source_of_run(folder, experiment)
    changed = "fingerprint" if record.fingerprint != source.fingerprint else "definition"
    if getattr(record, changed) != getattr(source, changed):
        what = "the run was made anew since its frames were exported" if changed == "fingerprint" else (
            "scenes or meshes have changed since its frames were exported"
        )  # fmt: skip
        raise InputError(f"{folder}: {what}; export again")
    return source


def named(frame: RenderedFrame, folder: Path, names: Mapping[int, str], hashes: Mapping[str, str]) -> RenderedFrame:
    """Return a frame that was rendered again with its name, `names` by realisation; `hashes` are those of the exported.

    Raises `InputError` where it was not exported, or comes out otherwise.
    """
    name = names.get(frame.realisation)
    if name is None:
        raise InputError(f"{folder}: {frame.setting} was not exported as a whole; export again")
    if image_hash(frame.image) != hashes[name]:
        raise InputError(
            f"{folder}: frame {name} comes out otherwise than it was exported; score where it was exported, "
            "with the same package versions and processor, or export again"
        )
    return replace(frame, name=name)


def scored_frames(folder: Path | str) -> Iterator[RenderedFrame]:
    """Render the exported frames of a run or dataset again, in the order of its cases, or of its shards.

    A frame that stands for several realisations comes once for each.
    """
    folder = Path(folder)
    record = read_record(folder)
    source, names, hashes = open_source(folder, record), record.names(), record.hashes
    # Not a generator itself, so that a folder that cannot be used raises at the call.
    return (named(each, folder, names.get(part.case, {}), hashes) for part in source.parts for each in part)

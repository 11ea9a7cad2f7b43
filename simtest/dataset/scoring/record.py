"""What was exported of a run or a dataset, as the run keeps it: frames by name, their hashes, what they show."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, model_validator

from simtest.dataset.manifest import NAME as MANIFEST
from simtest.dataset.reader import open_manifest
from simtest.dataset.scoring.views import ShardViews, Views, views_of_cases
from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.arrays import Image
from simtest.runtime.files import read_json, require_plain, write_json
from simtest.spec import Experiment
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate
from simtest.validation.cases import Case, expand
from simtest.validation.fingerprints import definition
from simtest.validation.run_folder import EXPORT

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
    """Content of export.json.

    Parameters
    ----------
    format : str
        Of this file.
    kind : {"run", "dataset"}
        What the frames are of.
    version : str
        Of simtest.
    fingerprint : str
        Of the run whose folder this is; of a dataset its manifest's source.
    definition : str
        Hash of the experiment and its scenes; of a dataset that of its specification.
    variant : str
        Of Mitsuba.
    experiment : dict
        The experiment, with all values that the command replaced; empty for a dataset, whose manifest has it.
    cameras : dict
        Table of each camera, by name.
    frames : dict
        By name.
    uses : tuple of Use
        In the order of cases and realisations.
    """

    format: Format = FORMAT
    kind: Literal["run", "dataset"]
    version: str
    fingerprint: str
    definition: str
    variant: str
    experiment: dict[str, JsonValue]
    cameras: dict[str, dict[str, JsonValue]]
    frames: dict[str, ExportedFrame]
    uses: tuple[Use, ...]

    @model_validator(mode="after")
    def _is_whole(self) -> "Record":
        if lost := {frame.camera for frame in self.frames.values()} - self.cameras.keys():
            raise ValueError(f"has no camera {sorted(lost)[0]}")
        if lost := {use.frame for use in self.uses} - self.frames.keys():
            raise ValueError(f"has no frame {sorted(lost)[0]}")
        return self

    def names(self) -> dict[tuple[int, int], str]:
        """Return the frame's name by case and realisation."""
        return {(use.case, use.realisation): use.frame for use in self.uses}

    def write(self, folder: Path) -> None:
        """Write export.json into the folder of the run or dataset."""
        write_json(folder / EXPORT, self.model_dump(mode="json"), compact=True)


@dataclass(frozen=True)
class Source:
    """A run or dataset whose frames can be rendered again.

    Parameters
    ----------
    folder : Path
        Of the run or dataset.
    views : sequence of Views
        All frames.
    kind : {"run", "dataset"}
        What it is.
    version, fingerprint, definition, variant : str
        As in `Record`.
    experiment : Experiment, optional
        Of a run; with its `cases`.
    dataset : Dataset, optional
        Of a dataset.
    """

    folder: Path
    views: Sequence[Views]
    kind: Literal["run", "dataset"]
    version: str
    fingerprint: str
    definition: str
    variant: str
    experiment: Experiment | None = None
    cases: Sequence[Case] = ()
    dataset: Dataset | None = None


def source_of_run(folder: Path, experiment: Experiment, cases: Sequence[Case]) -> Source:
    """Return a finished run as a source of frames."""
    run = read_summary(folder)
    version, fingerprint, variant = run["version"], run["fingerprint"], run["variant"]
    views, is_of = views_of_cases(experiment, cases, variant), definition(experiment, list(cases))
    return Source(folder, views, "run", version, fingerprint, is_of, variant, experiment, cases)


def source_of_dataset(folder: Path) -> Source:
    """Return a dataset as a source of frames; raise `InputError` where there is none, or one of another version."""
    manifest = open_manifest(folder)
    plan, variant = manifest.plan(), str(manifest.origin["variant"])
    bare = plan.dataset.model_copy(update={"estimators": ()})
    views = [ShardViews(bare, number, len(shard.indices), variant) for number, shard in enumerate(plan.shards)]
    is_of = hashlib.sha256(plan.dataset.model_dump_json().encode()).hexdigest()
    version, source = provenance.version(), str(manifest.origin["source"])
    return Source(folder, views, "dataset", version, source, is_of, variant, dataset=plan.dataset)


def read_summary(folder: Path) -> Mapping[str, str]:
    """Return how a finished run was made, from its summary.json; raise `InputError` where there is none."""
    path = folder / "summary.json"
    try:
        run = read_json(path)["run"]
        return {key: str(run[key]) for key in ("version", "fingerprint", "variant")}
    except InputError as error:
        raise InputError(f"{folder}: no finished run ({error})") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: is no summary of a run; give the simtest validate command again") from error


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
        source = source_of_run(folder, experiment, expand(experiment))
    changed = "fingerprint" if record.fingerprint != source.fingerprint else "definition"
    if getattr(record, changed) != getattr(source, changed):
        what = "the run was made anew since its frames were exported" if changed == "fingerprint" else (
            "scenes or meshes have changed since its frames were exported"
        )  # fmt: skip
        raise InputError(f"{folder}: {what}; export again")
    return source


def image_hash(image: Image) -> str:
    """Return the SHA-256 of a frame's shape and values, as float32."""
    values = np.ascontiguousarray(image, dtype="<f4")
    return hashlib.sha256(str(values.shape).encode() + values.tobytes()).hexdigest()


def check_frame(folder: Path, name: str, expected: str, image: Image) -> None:
    """Raise `InputError` where a frame that was rendered again differs from the exported one."""
    if image_hash(image) != expected:
        raise InputError(
            f"{folder}: frame {name} comes out otherwise than it was exported; score where it was exported, "
            "with the same package versions and processor, or export again"
        )

"""Exports the frames of a run or a dataset for those who estimate elsewhere: pictures, cameras, priors and no truth."""

import csv
import hashlib
import io
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from pydantic import BaseModel, TypeAdapter, ValidationError

from simtest.dataset.scoring.dense.truth import MOST_KEPT, keep_truth, kept_file, truth_of_view
from simtest.dataset.scoring.frames import (
    ExportedFrame,
    Frames,
    Record,
    RenderedFrame,
    ShownFrame,
    Source,
    Use,
    frames_of_cases,
    image_hash,
    source_of_dataset,
    source_of_run,
)
from simtest.errors import InputError
from simtest.reconstruction.images import scale_picture
from simtest.runtime import provenance
from simtest.runtime.arrays import Image
from simtest.runtime.files import are_nested, write_atomically, write_json
from simtest.runtime.locks import LOCK, exclusive_folder
from simtest.runtime.processes import Engine, OnStep
from simtest.simulation.frame import brightest_mm
from simtest.simulation.frame_files import encoded_png
from simtest.simulation.sensor import displayed
from simtest.spec import Experiment, calibration_toml, camera_table
from simtest.spec.sensor import Sensor
from simtest.validation.cases import expand
from simtest.validation.run_folder import EXPORTING, TRUTH, remove_folder
from simtest.validation.runner import Progress
from simtest.validation.scoring import peak_px

FRAMES, PREVIEWS, CAMERAS = "frames", "previews", "cameras"
TABLES = {
    "frames.csv": ("frame", "file", "preview", "width", "height", "channels", "camera"),
    "highlights.csv": (
        "frame", "specularity", "peak_x_px", "peak_y_px", "box_x_px", "box_y_px", "box_width_px", "box_height_px",
    ),
}  # fmt: skip
README = "README.md"
NAME_DIGITS = 16


class WrittenFrame(BaseModel):
    """A frame that has been written: its picture, the table of its camera, and what the run's record keeps of it."""

    file: str
    width: int
    height: int
    channels: int
    table: dict[str, Any]
    kept: ExportedFrame
    use: Use

    @property
    def name(self) -> str:
        """Name of the frame."""
        return self.use.frame

    @property
    def preview(self) -> str:
        """File of its preview."""
        return f"{PREVIEWS}/{self.name}.png"

    @property
    def files(self) -> tuple[str, str, str]:
        """Its files in the export."""
        return self.file, self.preview, self.kept.camera


_WRITTEN = TypeAdapter(list[WrittenFrame])


@dataclass(frozen=True)
class ExportPart:
    """Frames that one task writes into the folder `out`.

    `kept` is the file that it lists them in, `truth` the folder of their truths, if these are kept.
    """

    frames: Frames
    out: Path
    kept: Path
    truth: Path | None


def check_exportable(experiment: Experiment) -> None:
    """Raise `InputError` where an experiment renders no frames: before it is run."""
    frames_of_cases(experiment, expand(experiment), "")


def check_export(experiment: Experiment, folder: Path, out: Path) -> None:
    """Raise `InputError` where a run in a folder could not be exported to another one: before it is run."""
    check_exportable(experiment)
    _check_apart(folder, out, "--export")
    if out.exists():
        _check_folder(out, "--export")


def export_run(
    folder: Path, experiment: Experiment, out: Path, engine: Engine, progress: Progress | None = None
) -> Path:
    """Export the frames of a finished run.

    Parameters
    ----------
    folder : Path
        The run's; export.json is written there.
    experiment : Experiment
        What was run.
    out : Path
        Folder of the export: empty, new or that of an earlier export.
    engine : Engine
        Runs the tasks; the files do not depend on it.
    progress : callable, optional
        Called with frames done, frames in all, and what is being done.

    Returns
    -------
    Path
        README.md of the export.
    """
    source = source_of_run(folder, experiment)
    return _export(source, experiment.model_dump(mode="json"), out, engine, progress, "--export")


def export_dataset(folder: Path, out: Path, engine: Engine, progress: Progress | None = None) -> Path:
    """Export the pictures of a dataset, of 8 bits as its samples store them; see `export_run`."""
    source = source_of_dataset(folder)
    with exclusive_folder(folder, "DATASET"):
        return _export(source, {}, out, engine, progress, "--out")


def _export(
    source: Source, experiment: dict[str, Any], out: Path, engine: Engine, progress: Progress | None, option: str
) -> Path:
    _check_apart(source.folder, out, option)
    with exclusive_folder(out, option):
        _check_folder(out, option)
        made = _write_frames(source, out, engine, progress)
        _write_tables(out, made)
        _write_record(source, experiment, made)
        _set_one_time(out)
    return out / README


def _write_frames(source: Source, out: Path, engine: Engine, progress: Progress | None) -> list[WrittenFrame]:
    """Write what is missing of frames, previews and cameras; return all frames in the order of cases and realisations.

    Each task lists what it has written, so that a stopped export goes on.
    """
    kept = source.folder / EXPORTING
    for folder in (kept, *(out / name for name in (FRAMES, PREVIEWS, CAMERAS))):
        folder.mkdir(parents=True, exist_ok=True)
    origin = hashlib.sha256(f"{source.fingerprint} {source.definition} {provenance.source_hash()}".encode()).hexdigest()
    total = sum(len(frames) for frames in source.parts)
    truth = source.folder / TRUTH if source.kind == "run" and total <= MOST_KEPT else None
    parts = [ExportPart(frames, out, kept / f"{origin[:12]}-{frames.key:05d}.json", truth) for frames in source.parts]
    done = {number: made for number, part in enumerate(parts) if (made := _written(part)) is not None}
    missing = [number for number in range(len(parts)) if number not in done]
    if truth and not done:
        remove_folder(truth)
    count = sum(map(len, done.values()))

    def step() -> None:
        nonlocal count
        count += 1
        if progress:
            progress(count, total, "exporting frames")

    for task, made in engine.run(write_part, [parts[number] for number in missing], step):
        done[missing[task]] = made
    # Lists of a stopped export of something else go too.
    for file in kept.iterdir():
        file.unlink()
    kept.rmdir()
    return [each for _, made in sorted(done.items()) for each in made]


def _written(part: ExportPart) -> list[WrittenFrame] | None:
    """Return the frames that a stopped export has written of a part; None where some are missing."""
    try:
        made = _WRITTEN.validate_json(part.kept.read_bytes())
    except (OSError, ValidationError):
        return None
    files = {part.out / path for each in made for path in each.files}
    return made if all(file.is_file() for file in files) else None


def _write_tables(out: Path, made: Sequence[WrittenFrame]) -> None:
    """Write frames.csv, highlights.csv and the README; remove frames of an earlier export.

    Frames stand in the order of their names, which are hashes, so that the order tells nothing.
    """
    frames = sorted({each.name: each for each in made}.items())
    listed: list[Sequence[object]] = [
        (name, each.file, each.preview, each.width, each.height, each.channels, each.kept.camera)
        for name, each in frames
    ]
    found: list[Sequence[object]] = [
        (name, number, *peak, *box)
        for name, each in frames
        for number, (peak, box) in enumerate(zip(each.kept.peaks, each.kept.boxes, strict=True))
    ]
    own = {path for _, each in frames for path in each.files}
    for name in (FRAMES, PREVIEWS, CAMERAS):
        for path in (out / name).iterdir():
            if f"{name}/{path.name}" not in own:
                path.unlink()
    for (name, columns), rows in zip(TABLES.items(), (listed, found), strict=True):
        _write_text(out / name, _csv(columns, rows))
    _write_text(out / README, _readme(len(frames), len(found)))


def _set_one_time(out: Path) -> None:
    """Set one time of change for all files: in the order in which they were written, the settings follow each other."""
    moment = time.time_ns()
    for path in (file for file in out.rglob("*") if file.is_file()):
        os.utime(path, ns=(moment, moment))


def _readme(frames: int, highlights: int) -> str:
    """Return what a stranger is told: the files, and what to send back."""
    env = Environment(
        loader=PackageLoader("simtest.dataset", "."), undefined=StrictUndefined, keep_trailing_newline=True
    )
    text = env.get_template("export.md.j2")
    return text.render(frames=frames, highlights=highlights, version=provenance.version())


def _csv(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table as CSV; numbers read back as the same."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def _write_record(source: Source, experiment: dict[str, Any], made: Sequence[WrittenFrame]) -> None:
    Record(
        kind=source.kind,
        version=source.version,
        fingerprint=source.fingerprint,
        definition=source.definition,
        variant=source.variant,
        experiment=experiment,
        cameras={each.kept.camera: each.table for each in made},
        frames={each.name: each.kept for each in made},
        uses=tuple(each.use for each in made),
    ).write(source.folder)


def _check_apart(folder: Path, out: Path, option: str) -> None:
    """Raise `InputError` where an export would lie in the folder of its run or dataset, or hold that folder."""
    if are_nested(folder, out):
        raise InputError(f"{option} {out}: must be neither {folder} nor inside or around it")


def _check_folder(out: Path, option: str) -> None:
    """Raise `InputError` if a folder holds something that is no part of an export."""
    held = {path.name for path in out.iterdir()} - {LOCK}
    strangers = sorted(held - {FRAMES, PREVIEWS, CAMERAS, README, *TABLES})
    # Folders of those names alone may be anyone's, and an export removes what it does not list.
    if not strangers and held and "frames.csv" not in held and {FRAMES, PREVIEWS, CAMERAS} - held:
        strangers = sorted(held)
    if strangers:
        what = f"holds {strangers[0]}, which is no part of an export"
        raise InputError(f"{option} {out}: {what}; must be empty or hold an export")


# In a worker --------------------------------------------------------------------------------------------------------


def write_part(part: ExportPart, on_step: OnStep) -> list[WrittenFrame]:
    """Write the frames of a part, each with its preview and camera; call `on_step` after each."""
    made = []
    for each in part.frames.shown():
        made.append(_write_frame(each, part.out))
        if part.truth and isinstance(each, RenderedFrame):
            name, view = made[-1].name, each.view
            path = kept_file(part.truth, name, view.scene, part.frames.variant)
            truth = truth_of_view(name, view, each.session, image=each.image)
            keep_truth(path, truth, brightest_mm(view.highlights))
        on_step()
    write_json(part.kept, [each.model_dump(mode="json") for each in made], compact=True)
    return made


def _write_frame(each: ShownFrame, out: Path) -> WrittenFrame:
    """Write a frame, its preview and its camera."""
    image, sensor, told = each.image, each.sensor, each.calibration
    calibration = calibration_toml(told)
    name, camera = frame_name(image, calibration, each.isolated), _camera_name(calibration)
    file, data = _encoded(name, image, sensor)
    ok, small = cv2.imencode(".png", np.rint(displayed(image, sensor)[:, :, ::-1] * 255).astype(np.uint8))
    assert ok
    write_atomically(out / file, lambda part: part.write_bytes(data))
    write_atomically(out / PREVIEWS / f"{name}.png", lambda part: part.write_bytes(bytes(small)))
    _write_text(out / camera, calibration)
    detections = each.detections()
    height, width = image.shape[:2]
    return WrittenFrame(
        file=file,
        width=width,
        height=height,
        channels=1 if image.ndim == 2 else image.shape[2],
        table=json.loads(json.dumps(camera_table(told.camera))),
        kept=ExportedFrame(
            sha256=image_hash(image),
            camera=camera,
            peaks=tuple(peak_px(found).tolist() for found in detections),
            boxes=tuple(tuple(map(int, found.region.box)) for found in detections),
        ),
        use=Use(frame=name, case=each.case, setting=each.setting, realisation=each.realisation),
    )


def frame_name(image: Image, calibration: str, isolated: bool) -> str:
    """Return the name of a frame: a hash of all that an estimator sees of it, so that it tells nothing else.

    Realisations that look the same to an estimator share one frame.
    """
    seen = f"{image_hash(image)} {calibration} {isolated}"
    # No row of digits alone, which a program that reads a table would take for a number.
    return "f" + hashlib.sha256(seen.encode()).hexdigest()[:NAME_DIGITS]


def _camera_name(calibration: str) -> str:
    return f"{CAMERAS}/c{hashlib.sha256(calibration.encode()).hexdigest()[:NAME_DIGITS]}.toml"


def _encoded(name: str, image: Image, sensor: Sensor) -> tuple[str, bytes]:
    """Return the file of a frame and its content: PNG where it holds the very values, else NPY of float32."""
    if sensor.encodes:
        data = encoded_png(image, sensor)
        read = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
        values = None if read is None else scale_picture(read, name)
        if values is not None:
            values = values if values.ndim == 2 else values[:, :, ::-1]
            if image_hash(values) == image_hash(image):
                return f"{FRAMES}/{name}.png", data
    content = io.BytesIO()
    np.save(content, np.ascontiguousarray(image, dtype="<f4"), allow_pickle=False)
    return f"{FRAMES}/{name}.npy", content.getvalue()


def _write_text(path: Path, text: str) -> None:
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))

"""Reconstruction of a folder of pictures or a video: frame by frame, with tracks; a stopped run goes on."""

import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.reconstruction.description import COLUMNS, rows, write_csv
from simtest.reconstruction.image_sources import SequenceFrame, Source, open_source
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.picture import picture_document
from simtest.reconstruction.sequence_page import write_sequence_page
from simtest.reconstruction.single import Options, check_camera_given, completed, read_camera
from simtest.reconstruction.tracking import Tracker
from simtest.runtime.files import make_folder, write_atomically, write_json
from simtest.runtime.resources import shown

Progress = Callable[[int, int, str], None]

TIMELINE = ("frame", "time_s", "track", *COLUMNS)
DRAWN = ("isophotes", "ellipses", "cones", "curves")
"""What a frame's JSON does without: points that are there to be drawn."""


@dataclass(frozen=True)
class SequenceResult:
    """What came of a sequence.

    Parameters
    ----------
    frames, failed, specularities, tracks : int
        Counts; a track is of two frames or more.
    files : list of Path
    """

    frames: int
    failed: int
    specularities: int
    tracks: int
    files: list[Path]


def reconstruct_sequence(
    path: Path,
    out: Path,
    camera_file: Path | None = None,
    fov_deg: float | None = None,
    options: Options | None = None,
    progress: Progress | None = None,
) -> SequenceResult:
    """Reconstruct the frames of a folder or a video.

    Parameters
    ----------
    path : Path
        Folder of pictures, in the order of their names, or a video that OpenCV reads.
    out : Path
        Folder: run.json, frames/NNNNNN.json and .jpg, timeline.csv, tracks.json, index.html. Frames that are there
        already are not done again.
    camera_file, fov_deg
        As of `simtest.reconstruction.picture.reconstruct_picture`.
    options : Options, optional
        How.
    progress : callable, optional
        Called with frames done, frames in all, and the frame's name; what it raises stops the run, and what is done
        is kept.

    Returns
    -------
    SequenceResult

    Raises
    ------
    InputError
        If the source or the camera is malformed, no frame can be read, or `out` holds a run of other settings.
    """
    options = options or Options()
    check_camera_given(camera_file, fov_deg)
    source = open_source(path)
    folder = out / "frames"
    make_folder(folder)
    _check_settings(out / "run.json", path, camera_file, fov_deg, options)
    run = _Run(source, folder, (camera_file, fov_deg), options)
    for frame in source.frames():
        if progress is not None:
            progress(frame.index, max(source.count, frame.index + 1), frame.name)
        run.take(frame)
    if not run.documents:
        raise InputError(f"{shown(path)}: no frame could be read ({run.first_error or 'it has none'})")
    if source.is_video and run.taken < source.count - 1:
        warnings.warn(
            f"{shown(path)}: ends after {run.taken} of {source.count} frames; what was read is kept", stacklevel=2
        )
    files = _write(out, run.documents)
    if progress is not None:
        progress(run.taken, run.taken, "")
    spots = [spot for document in run.documents for spot in document["specularities"]]
    tracks = tracks_of(run.documents)
    return SequenceResult(run.taken, run.failed, len(spots), sum(len(t["frames"]) > 1 for t in tracks), files)


class _Run:
    """The frames done so far."""

    def __init__(
        self, source: Source, folder: Path, camera: tuple[Path | None, float | None], options: Options
    ) -> None:
        self.source, self.folder, self.camera, self.options = source, folder, camera, options
        self.documents: list[dict[str, Any]] = []
        self.taken = self.failed = 0
        self.first_error = ""
        self._calibration: Calibration | None = None
        self._cautions: list[str] = []
        self._tracker: Tracker | None = None

    def take(self, frame: SequenceFrame) -> None:
        """Reconstruct a frame, or read what an earlier run made of it."""
        self.taken += 1
        stem = self.folder / f"{frame.index:06d}"
        document = _read_done(stem.with_suffix(".json"), frame.name)
        if document is None:
            try:
                document = self._reconstruct(frame, stem)
            except InputError as error:
                # The first frame tells of a wrong camera or estimator; a file that is no picture is passed over.
                if not self.documents and self._calibration is not None:
                    raise
                self.failed += 1
                self.first_error = self.first_error or str(error)
                warnings.warn(f"frame {frame.index}: {error}", stacklevel=3)
                return
        else:
            self._numbers(document, tuple(document["size"]))
        self.documents.append(document)

    def _reconstruct(self, frame: SequenceFrame, stem: Path) -> dict[str, Any]:
        picture = frame.read()
        size = (picture.shape[1], picture.shape[0])
        if self._calibration is None:
            calibration, self._cautions = read_camera(*self.camera, size)
            for caution in self._cautions:
                warnings.warn(caution, stacklevel=5)
            self._calibration = completed(calibration, self.options.encoding)
        document = picture_document(frame.name, picture, self._calibration, self.options, self._cautions)
        document |= {"frame_index": frame.index, "time_s": frame.time_s, "size": list(size)}
        numbers = self._numbers(document, size)
        overlay = draw_overlay(picture, document["specularities"], [str(n) for n in numbers])
        write_atomically(stem.with_suffix(".jpg"), lambda part: cv2.imwrite(str(part), overlay))
        for spot in document["specularities"]:
            for result in spot["estimates"].values():
                for key in DRAWN:
                    result.pop(key, None)
        # Last: a frame whose JSON is there is done.
        write_json(stem.with_suffix(".json"), document, compact=True)
        return document

    def _numbers(self, document: dict[str, Any], size: tuple[int, ...]) -> list[int]:
        if self._tracker is None:
            self._tracker = Tracker((size[0], size[1]))
        spots = document["specularities"]
        numbers = self._tracker.update([_place(spot) for spot in spots])
        for spot, number in zip(spots, numbers, strict=True):
            spot["track"] = number
        return numbers


def _place(spot: dict[str, Any]) -> Sequence[float]:
    x, y, width, height = spot["box_px"]
    return spot["peak_px"] or (x + width / 2, y + height / 2)


def _read_done(path: Path, name: str) -> dict[str, Any] | None:
    """Give what an earlier run made of a frame; None where it did nothing, or what it left cannot be used."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    usable = isinstance(document, dict) and document.get("image") == name and "size" in document
    return document if usable else None


def _check_settings(
    path: Path, source: Path, camera_file: Path | None, fov_deg: float | None, options: Options
) -> None:
    """Write the run's settings, or raise `InputError` where another run's stand."""
    settings = json.loads(
        json.dumps({"source": str(source), "camera": camera_file and str(camera_file), "fov_deg": fov_deg,
                    **asdict(options)})
    )  # fmt: skip
    if path.is_file():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            before = None
        if before != settings:
            keys = [k for k in settings if not isinstance(before, dict) or before.get(k) != settings[k]]
            raise InputError(
                f"--out {shown(path.parent)}: holds a run with another {', '.join(keys) or 'set of settings'}; "
                "give another folder"
            )
        return
    write_json(path, settings)


def tracks_of(documents: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give each track: its frames, positions and best normals, in order."""
    tracks: dict[int, dict[str, Any]] = {}
    for document in documents:
        for spot in document["specularities"]:
            track = tracks.setdefault(
                spot["track"], {"track": spot["track"], "frames": [], "times_s": [], "peaks_px": [], "normals": []}
            )
            best = spot["estimates"].get(spot["best"]) if spot["best"] else None
            track["frames"].append(document["frame_index"])
            track["times_s"].append(document["time_s"])
            track["peaks_px"].append(spot["peak_px"])
            track["normals"].append(None if best is None else best["normal"])
    return [tracks[number] for number in sorted(tracks)]


def _frame_rows(document: dict[str, Any]) -> list[dict[str, Any]]:
    spots = document["specularities"]
    tracks = {spot["id"]: spot["track"] for spot in spots}
    frame = {"frame": document["frame_index"], "time_s": document["time_s"]}
    return [{**frame, "track": tracks[row["specularity"]], **row} for row in rows(spots)]


def _write(out: Path, documents: list[dict[str, Any]]) -> list[Path]:
    files = [out / name for name in ("timeline.csv", "tracks.json", "index.html")]
    table = [row for document in documents for row in _frame_rows(document)]
    tracks = tracks_of(documents)
    try:
        write_atomically(files[0], lambda part: write_csv(part, table, TIMELINE))
        write_json(files[1], tracks, compact=True)
        write_atomically(files[2], lambda part: write_sequence_page(part, documents, tracks))
    except OSError as error:
        raise InputError(f"--out {shown(out)}: cannot be written ({error.strerror})") from error
    return files

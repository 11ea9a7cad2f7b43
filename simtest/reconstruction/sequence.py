"""Reconstruction of a folder of pictures or a video: frame by frame, with tracks; a stopped run goes on."""

import hashlib
import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.estimators import Estimate
from simtest.reconstruction.assumptions import Assumption
from simtest.reconstruction.description import SpecularityRecord
from simtest.reconstruction.image_io import SequenceFrame, Source, open_source
from simtest.reconstruction.motion import (
    JUDGING,
    LEAST_MOTION,
    MOST_MOTION,
    NEEDED,
    check_priors,
    fits_flipped_axes,
    judge_by_motion,
)
from simtest.reconstruction.motion_record import COLUMNS as MOTION_COLUMNS
from simtest.reconstruction.output_files import COLUMNS, normals_rows, write_csv
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.picture import Options, read_calibration, reconstruct_values
from simtest.reconstruction.pipeline import default_estimators
from simtest.reconstruction.poses import Poses, read_poses
from simtest.reconstruction.result_page import write_sequence_page
from simtest.reconstruction.tracking import Track, TrackedFrame, Tracker, tracks_of
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import JsonObject, make_folder, read_json, write_atomically, write_json
from simtest.runtime.locks import exclusive_folder
from simtest.runtime.provenance import environment

Progress = Callable[[int, int, str], None]

SETTINGS = "run.json"
TIMELINE = ("frame", "time_s", "track", *COLUMNS)


@dataclass(frozen=True)
class SequenceResult:
    """How many frames, specularities and tracks of two frames or more a sequence gave, and the files written.

    `assumed` is what nobody gave of its frames; empty where all were done by an earlier run. `motion` says how many
    highlights' curvatures the poses tell, where these are known.
    """

    frames: int
    failed: int
    specularities: int
    tracks: int
    files: list[Path]
    assumed: Sequence[Assumption] = ()
    motion: str | None = None


@plain_errors
def reconstruct_sequence(path: Path, out: Path, options: Options, progress: Progress | None = None) -> SequenceResult:
    """Reconstruct the frames of a folder or a video.

    Parameters
    ----------
    path : Path
        Folder of pictures, in the order of their names, or a video that OpenCV reads.
    out : Path
        Folder: run.json, frames/NNNNNN.json and .jpg, timeline.csv, tracks.json, index.html. Frames that are there
        already are not done again.
    options : Options
        Camera, detector and estimators.
    progress : callable, optional
        Called with frames done, frames in all, and the frame's name; what it raises stops the run, and what is done
        is kept.
    """
    source = open_source(path)
    poses = None
    if options.poses is not None:
        poses, options = _checked_poses(options.poses, source, options)
    with exclusive_folder(out):
        return _reconstruct(source, out, options, progress, poses)


def _checked_poses(path: Path, source: Source, options: Options) -> tuple[Poses, Options]:
    """Read the poses, and return them with options that have the estimator of curvature.

    Whatever is wrong is found before the work: malformed poses, and a calibration that lacks what the method needs.
    """
    # Imported here: the models of files are slow to load.
    from simtest.spec.calibration_file import load_calibration

    if options.camera is None:
        raise InputError(f"--poses {path}: needs a calibration; give --camera in place of --fov")
    poses, calibration = read_poses(path), load_calibration(options.camera)
    check_priors(calibration.priors, options.camera)
    if source.is_video:
        # The count of a whole film may be off by one, that of one that is cut by more.
        poses = poses.of_film(1 if source.is_cut else source.count - 1)
    else:
        poses.of_files([file.name for file in source.files])
    names = options.estimators or default_estimators(calibration)
    return poses, replace(options, estimators=names if NEEDED in names else (*names, NEEDED))


def _reconstruct(
    source: Source,
    out: Path,
    options: Options,
    progress: Callable[[int, int, str], None] | None,
    poses: Poses | None,
) -> SequenceResult:
    path, settings = source.path, _settings(source.path, options)
    _check_settings(out / SETTINGS, settings)
    run = _Run(out, options, settings)
    if poses is not None and poses.names:
        run.strangers = frozenset(file.name for file in source.files) - frozenset(poses.names)
    for frame in source.frames():
        if progress is not None:
            progress(frame.index, max(source.count, frame.index + 1), frame.name)
        run.take(frame)
    # A run that read nothing is an error; one that ended early keeps what it has.
    if not run.frames:
        raise InputError(f"{path}: no frame could be read ({run.first_error or 'it has none'})")
    # The count of a whole film may be off by one.
    if source.is_video and (run.taken < source.count - 1 or source.is_cut):
        how = "its file is cut short; " if source.is_cut else ""
        warnings.warn(
            f"{path}: {how}ends after {run.taken} of {source.count} frames; what was read is kept", stacklevel=2
        )
    if poses is not None:
        # The count of a film is not known before it is read.
        if source.is_video and not source.is_cut and len(poses.world_from_camera) > run.taken:
            warnings.warn(
                f"--poses {poses.path}: {len(poses.world_from_camera)} poses for {run.taken} frames; the first "
                "ones are taken in their order",
                stacklevel=2,
            )
        run.judge_by_motion(poses)
    tracks = tracks_of(run.frames)
    files = _write(out, run.frames, tracks)
    if progress is not None:
        progress(run.taken, run.taken, "")
    found = sum(len(frame.specularities) for frame in run.frames)
    return SequenceResult(
        run.taken, run.failed, found, sum(len(track.frames) > 1 for track in tracks), files, run.assumed,
        _told_by_motion(run.frames, poses, run.is_flipped),
    )  # fmt: skip


class _Run:
    """The frames of a sequence that are done so far, with what carries over from one to the next."""

    def __init__(self, out: Path, options: Options, settings: JsonObject) -> None:
        self.out, self.folder, self.options, self.settings = out, out / "frames", options, settings
        self.frames: list[TrackedFrame] = []
        self.taken = self.failed = 0
        self.first_error = ""
        self.strangers: frozenset[str] = frozenset()  # files that the poses do not name, such as a contact sheet
        self.is_flipped = False
        self.assumed: Sequence[Assumption] = ()
        self._is_made = False  # a frame of this run; those behind it that an earlier one did have other tracks
        self._calibration: Calibration | None = None
        self._cautions: list[str] = []
        self._tracker: Tracker | None = None

    def take(self, frame: SequenceFrame) -> None:
        """Reconstruct a frame, or read what an earlier run made of it."""
        self.taken += 1
        stem = self.folder / f"{frame.index:06d}"
        # done by an earlier run: only the tracks are counted anew
        done = None if self._is_made else _read_done(stem.with_suffix(".json"), frame.name)
        if done is not None:
            self._keep(done, self._tracked(done.specularities, done.size, frame.index))
            return
        try:
            self._reconstruct(frame, stem)
            self._is_made = True
        except InputError as error:
            # The first frame shows a wrong camera or estimator; a file that is no picture is passed over.
            if not self.frames and self._calibration is not None and frame.name not in self.strangers:
                raise
            self.failed += 1
            self.first_error = self.first_error or str(error)
            warnings.warn(f"frame {frame.index}: {error}", stacklevel=3)

    def _reconstruct(self, frame: SequenceFrame, stem: Path) -> None:
        picture = frame.read()
        size = (picture.shape[1], picture.shape[0])
        # The first picture's size completes a camera that is known by its field of view alone.
        if self._calibration is None:
            self._calibration, self._cautions = read_calibration(self.options, picture)
            for caution in self._cautions:
                warnings.warn(caution, stacklevel=5)
        record = reconstruct_values(frame.name, picture, self._calibration, self.options, self._cautions)
        self.assumed = record.assumed
        spots = self._tracked(record.specularities, size, frame.index)
        overlay = draw_overlay(picture, spots)
        # Not before a frame is there: a run that reads nothing leaves nothing.
        if not self.folder.is_dir() or not (self.out / SETTINGS).is_file():
            make_folder(self.folder)
            write_json(self.out / SETTINGS, self.settings)
        write_atomically(stem.with_suffix(".jpg"), lambda part: cv2.imwrite(str(part), overlay))
        plain = [replace(spot, drawings={}) for spot in spots]
        entry = {"frame_index": frame.index, "time_s": frame.time_s, "size": size}
        # Last: a frame whose JSON is there is done.
        write_json(stem.with_suffix(".json"), replace(record, specularities=plain).to_json() | entry, compact=True)
        self._keep(TrackedFrame(frame.name, frame.index, frame.time_s, size, []), plain)

    def _keep(self, frame: TrackedFrame, spots: Sequence[SpecularityRecord]) -> None:
        """Keep of a frame what tracks and motion need: a film has thousands, and their files hold the rest."""
        needed = () if self.options.poses is None else JUDGING
        self.frames.append(replace(frame, specularities=[_slim(spot, needed) for spot in spots]))

    def judge_by_motion(self, poses: Poses) -> None:
        """Judge the highlights' curvatures by the poses, and add that to the frames' files."""
        # Imported here: the models of files are slow to load.
        from simtest.spec.calibration_file import load_calibration

        assert self.options.camera is not None
        names, indices = [frame.name for frame in self.frames], [frame.index for frame in self.frames]
        told = poses.of_frames(names, indices)
        priors = load_calibration(self.options.camera).priors
        self.frames = judge_by_motion(self.frames, told, poses.error, priors)
        self.is_flipped = fits_flipped_axes(self.frames, told, poses.error, priors)
        for frame in self.frames:
            path = self.folder / f"{frame.index:06d}.json"
            data = read_json(path)
            for entry, spot in zip(data["specularities"], frame.specularities, strict=True):
                entry["motion"] = spot.motion
            write_json(path, data, compact=True)

    def _tracked(self, spots: list[SpecularityRecord], size: tuple[int, int], index: int) -> list[SpecularityRecord]:
        self._tracker = self._tracker or Tracker(size)
        numbers = self._tracker.update([spot.position_px for spot in spots], index)
        return [replace(spot, track=number) for spot, number in zip(spots, numbers, strict=True)]


def _slim(spot: SpecularityRecord, needed: Sequence[str]) -> SpecularityRecord:
    """Return a specularity with the estimates that are needed, and of the best one the normal."""
    estimates = {name: spot.estimates[name] for name in needed if name in spot.estimates}
    if spot.best is not None and (best := spot.best_estimate) is not None:
        estimates.setdefault(spot.best, Estimate(best.normal, best.normal[None], best.look_px))
    return replace(spot, estimates=estimates, highlight=None)


def _read(path: Path) -> TrackedFrame:
    """Read the file of a frame."""
    return TrackedFrame.from_json(read_json(path))


def _read_done(path: Path, name: str) -> TrackedFrame | None:
    """Read what an earlier run wrote of a frame; None where there is nothing, or it cannot be used."""
    try:
        frame = _read(path)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return frame if frame.name == name else None


def _told_by_motion(frames: Sequence[TrackedFrame], poses: Poses | None, is_flipped: bool) -> str | None:
    """Return how many highlights' curvatures motion told, as a sentence; None without poses."""
    if poses is None:
        return None
    judged = [spot.motion for frame in frames for spot in frame.specularities if spot.motion is not None]
    shapes = Counter(each.shape for each in judged)
    counts = ", ".join(f"{count} {shape}" for shape, count in shapes.most_common())
    compared = [each for each in judged if each.distance2 is not None]
    misfits = sum(not each.fits for each in compared)
    error = poses.error
    stated = f"{error.translation:.1%} and {math.degrees(error.rotation):.2g} deg"
    told = (
        f"bends of {len(judged)} highlights: {counts}; {misfits} fit no curvature; "
        f"error of the poses {'given' if poses.error_told else 'assumed'}: {stated}"
    )
    if is_flipped:
        told += (
            "\nwarning: the frames fit clearly better with y and z of the camera reversed; the axes must be x right, "
            "y down, z forward, and OpenGL, Blender and NeRF have y up, z backward. Told signs may be wrong"
        )
    elif 2 * misfits > len(compared):
        told += "\nmost fit no curvature: are the poses world_from_camera, in mm, of these frames?"
    motions = [each.motions for each in judged if each.motions is not None]
    if motions and all(longest < LEAST_MOTION or shortest > MOST_MOTION for shortest, longest in motions):
        shortest, longest = min(least for least, _ in motions), max(most for _, most in motions)
        told += (
            f"\nmotions are {shortest:.2g} to {longest:.2g} of the distance, and {LEAST_MOTION:g} to {MOST_MOTION:g} "
            "are needed: is the unit of the poses right?"
        )
    return told


def _settings(source: Path, options: Options) -> JsonObject:
    """Return the run's settings, through JSON, so that paths and tuples compare with the text and lists of a file."""
    given = {key: value for key, value in asdict(options).items() if key != "poses" or value is not None}
    if options.camera is not None:
        # Imported here: the models of files are slow to load.
        from simtest.spec.calibration_file import load_calibration

        content = json.dumps(asdict(load_calibration(options.camera)), default=str)
        given["calibration"] = hashlib.sha256(content.encode()).hexdigest()
    return dict(
        json.loads(
            json.dumps(
                {"source": source, **given, "version": environment()["version"]},
                default=lambda value: str(value.resolve()) if isinstance(value, Path) else str(value),
            )
        )
    )


def _check_settings(path: Path, settings: JsonObject) -> None:
    """Raise `InputError` where the settings of another run stand."""
    if not path.is_file():
        return
    try:
        before = read_json(path)
    except (OSError, ValueError):
        before = None
    if before != settings:
        keys = [key for key in settings if not isinstance(before, dict) or before.get(key) != settings[key]]
        raise InputError(
            f"--out {path.parent}: holds a run with another {', '.join(keys) or 'set of settings'}; give another folder"
        )


def _write(out: Path, frames: list[TrackedFrame], tracks: list[Track]) -> list[Path]:
    files = [out / name for name in ("timeline.csv", "tracks.json", "index.html")]
    judged = any(spot.motion is not None for frame in frames for spot in frame.specularities)
    columns = (*TIMELINE, *MOTION_COLUMNS) if judged else TIMELINE
    table = (
        (frame.index, frame.time_s, spot.track, *row, *(() if spot.motion is None else spot.motion.row()))
        for frame in frames
        for spot, whole in zip(
            frame.specularities, _read(out / "frames" / f"{frame.index:06d}.json").specularities, strict=True
        )
        for row in normals_rows([whole])
    )
    write_atomically(files[0], lambda part: write_csv(part, columns, table))
    write_json(files[1], tracks, compact=True)
    write_atomically(files[2], lambda part: write_sequence_page(part, frames, tracks))
    return files

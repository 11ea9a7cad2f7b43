"""Reconstruction of a folder of pictures or a video: frame by frame, with tracks; a stopped run goes on.

What a frame gave stands in its JSON file alone, and the tables are made of these files: of a film of any length memory
holds its tracks.
"""

import contextlib
import hashlib
import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.reconstruction.assumptions import Assumption
from simtest.reconstruction.images import SequenceFrame, Source, header_size, open_source
from simtest.reconstruction.motion import COLUMNS as MOTION_COLUMNS
from simtest.reconstruction.motion import (
    LEAST_MOTION,
    MOST_MOTION,
    NEEDED,
    MotionRecord,
    TrackedHighlight,
    check_priors,
    fits_flipped_axes,
    judge_by_motion,
    motion_row,
)
from simtest.reconstruction.options import Options, calibration_for, default_estimators, stated_calibration
from simtest.reconstruction.outputs import COLUMNS, REGION_COLUMNS, normals_rows, write_csv
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.page import write_sequence_page
from simtest.reconstruction.pipeline import reconstruct_values
from simtest.reconstruction.poses import Poses, read_poses
from simtest.reconstruction.tracking import DoneFrame, Track, Tracker
from simtest.runtime.arrays import Image
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import JsonObject, make_folder, read_json, write_atomically, write_json
from simtest.runtime.locks import exclusive_folder
from simtest.runtime.provenance import environment, file_hash, version

Progress = Callable[[int, int, str], None]

SETTINGS = "run.json"
MOST_NAMES = 3
"""Pictures of another size than the camera's that a refusal names, of each size."""

TIMELINE = ("frame", "time_s", "track")


@dataclass(frozen=True)
class SequenceResult:
    """How many frames, specularities and tracks of two frames or more a sequence gave, and the files written.

    `assumed` is what nobody gave of its frames; empty where all were done by an earlier run. `motion` says how many
    highlights' curvatures the poses tell, where these are known. `not_named` are those of the failed that the poses do
    not name, such as a contact sheet. `sizes` counts the frames by their size, "640 x 480".
    """

    frames: int
    failed: int
    specularities: int
    tracks: int
    files: list[Path]
    assumed: Sequence[Assumption] = ()
    motion: str | None = None
    not_named: int = 0
    sizes: Mapping[str, int] = field(default_factory=dict)


@plain_errors
def reconstruct_sequence(path: Path, out: Path, options: Options, progress: Progress | None = None) -> SequenceResult:
    """Reconstruct the pictures of a folder, in the order of their names, or the frames of a video that OpenCV reads.

    The folder `out` gets run.json, frames/NNNNNN.json and .jpg, timeline.csv, tracks.json and index.html; frames that
    are there already are not done again. `progress` is called with frames done, frames in all, and the frame's name;
    what it raises stops the run, and what is done is kept.
    """
    options.require_camera()
    if isinstance(options.estimators, Mapping) or not isinstance(options.detector, str | None):
        raise InputError(f"{path}: the estimators and the detector of a folder or a film must be given by name")
    source, poses = open_source(path), None
    calibration = stated_calibration(options)
    if options.poses is not None:
        poses, options = _checked_poses(options.poses, source, options, calibration)
    if calibration is not None:
        named = set(poses.names) if poses is not None and poses.names else None
        _check_sizes([file for file in source.files if named is None or file.name in named], calibration, options)
    with exclusive_folder(out):
        return _reconstruct(source, out, options, calibration, progress, poses)


def _checked_poses(
    path: Path, source: Source, options: Options, calibration: Calibration | None
) -> tuple[Poses, Options]:
    """Read the poses, and return them with options that have the estimator of curvature.

    Whatever is wrong is found before the work: malformed poses, and a calibration that lacks what the method needs.
    """
    if options.camera is None or calibration is None:
        raise InputError(f"--poses {path}: needs a calibration; give --camera in place of --fov")
    poses = read_poses(path)
    check_priors(calibration.priors, options.camera)
    if source.is_video:
        # The count of a whole film may be off by one, that of one that is cut by more.
        poses = poses.of_film(1 if source.is_cut else source.count - 1)
    else:
        poses.of_files([file.name for file in source.files])
    names = tuple(options.estimators or default_estimators(calibration))
    return poses, replace(options, estimators=names if NEEDED in names else (*names, NEEDED))


def _check_sizes(files: Sequence[Path], calibration: Calibration, options: Options) -> None:
    """Raise `InputError` that names the pictures whose headers state another size than the camera's."""
    camera, others = calibration.camera, dict[tuple[int, int], list[str]]()
    for file in files:
        size = header_size(file)
        if size not in (None, (camera.width, camera.height)):
            others.setdefault(size, []).append(file.name)
    if not others:
        return
    listed, count = [], sum(map(len, others.values()))
    for (width, height), names in others.items():
        more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
        listed.append(f"{', '.join(names[:MOST_NAMES])}{more} ({width} x {height})")
    raise InputError(
        f"--camera {options.camera}: is of {camera.width} x {camera.height} px, and {count} of {len(files)} pictures "
        f"are of another size: {'; '.join(listed)}; give a folder of one size for each camera, or --fov, which takes "
        "each size"
    )


def _reconstruct(
    source: Source,
    out: Path,
    options: Options,
    calibration: Calibration | None,
    progress: Progress | None,
    poses: Poses | None,
) -> SequenceResult:
    path, settings = source.path, _settings(source.path, options, calibration)
    _check_settings(out / SETTINGS, settings)
    run = _Run(out, options, settings, calibration)
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
        told = f"{how}ends after {run.taken} of {source.count} frames; what was read is kept"
        warnings.warn(f"{path}: {told}", stacklevel=2)
    motion = None
    if poses is not None and calibration is not None:
        # The count of a film is not known before it is read.
        count = len(poses.world_from_camera)
        if source.is_video and not source.is_cut and count > run.taken:
            told = f"{count} poses for {run.taken} frames; the first ones are taken in their order"
            warnings.warn(f"--poses {poses.path}: {told}", stacklevel=2)
        motion = _judge_by_motion(run, poses, calibration)
    tracks = [run.tracks[number] for number in sorted(run.tracks)]
    files = _write(run, tracks)
    if progress is not None:
        progress(run.taken, run.taken, "")
    return SequenceResult(
        run.taken, run.failed, sum(frame.count for frame in run.frames), sum(len(track.frames) > 1 for track in tracks),
        files, run.assumed, motion, run.not_named, run.sizes,
    )  # fmt: skip


class _Run:
    """The frames of a sequence that are done so far, with what carries over from one to the next."""

    def __init__(self, out: Path, options: Options, settings: JsonObject, calibration: Calibration | None) -> None:
        self.out, self.folder, self.options, self.settings = out, out / "frames", options, settings
        self._stated, self._origin = calibration, environment()
        # By a field of view each size has a camera of its own, and cautions about it.
        self._known: dict[tuple[int, int], tuple[Calibration, list[str]]] = {}
        self.sizes: Counter[str] = Counter()
        self.frames: list[DoneFrame] = []
        self.tracks: dict[int, Track] = {}
        self.taken = self.failed = self.not_named = 0
        self.first_error = ""
        self.strangers: frozenset[str] = frozenset()  # files that the poses do not name, such as a contact sheet
        self.assumed: Sequence[Assumption] = ()
        self._is_made = False  # a frame of this run; those behind it that an earlier one did have other tracks
        self._warned: set[str] = set()
        self._tracker: Tracker | None = None

    def take(self, frame: SequenceFrame) -> None:
        """Reconstruct a frame, or read what an earlier run made of it."""
        self.taken += 1
        # done by an earlier run: only the tracks are counted anew
        done = None if self._is_made else _read_done(self.file(frame.index), frame.name)
        if done is not None:
            if self._stated is None and tuple(done["size"]) not in self._known:
                # A field of view is that of the first picture of a size, also of frames that are made in a later run.
                with contextlib.suppress(InputError):
                    self._calibration_of(frame.read())
            before = deepcopy(self._tracker)
            numbers = self._track_numbers(_positions(done), tuple(done["size"]), frame.index)
            if numbers == [spot["track"] for spot in done["specularities"]]:
                self._keep(frame.index, done, numbers)
                return
            # A frame before this one was lost since: its file and its picture have other numbers.
            self._tracker = before
        picture = None
        try:
            picture = frame.read()
            self._reconstruct(frame, picture)
            self._is_made = True
        except InputError as error:
            # The first frame shows a wrong camera or estimator; a file that is no picture is passed over.
            refused = picture is not None and (self._stated is not None or self._known)
            is_stranger = frame.name in self.strangers
            if refused and not self.frames and not is_stranger:
                raise
            self.failed += 1
            self.not_named += is_stranger
            self.first_error = self.first_error or str(error)
            warnings.warn(f"frame {frame.index}: {error}", stacklevel=3)

    def file(self, index: int) -> Path:
        """Return the JSON file of a frame."""
        return self.folder / f"{index:06d}.json"

    def _calibration_of(self, picture: Image) -> tuple[Calibration, list[str]]:
        """Return the calibration of pictures of this size, and cautions about it.

        The first picture of a size completes a camera that is known by its field of view alone.
        """
        if self._stated is not None:
            return self._stated, []
        size = (picture.shape[1], picture.shape[0])
        if size not in self._known:
            self._known[size] = calibration_for(self.options, picture)
        return self._known[size]

    def _reconstruct(self, frame: SequenceFrame, picture: Image) -> None:
        size = (picture.shape[1], picture.shape[0])
        calibration, cautions = self._calibration_of(picture)
        for caution in cautions:
            if caution not in self._warned:
                warnings.warn(caution, stacklevel=6)
        self._warned.update(cautions)
        found = reconstruct_values(frame.name, picture, calibration, self.options, cautions)
        self.assumed = found.choices.assumed
        numbers = self._track_numbers([spot.position_px for spot in found], size, frame.index)
        found[:] = [replace(spot, track=number) for spot, number in zip(found, numbers, strict=True)]
        overlay = cv2.imencode(".jpg", draw_overlay(picture, found))[1].tobytes()
        # Not before a frame is there: a run that reads nothing leaves nothing.
        if not self.folder.is_dir() or not (self.out / SETTINGS).is_file():
            make_folder(self.folder)
            write_json(self.out / SETTINGS, self.settings)
        file = self.file(frame.index)
        write_atomically(file.with_suffix(".jpg"), lambda part: part.write_bytes(overlay))
        entry = {**found.to_json(False, self._origin), "frame_index": frame.index, "time_s": frame.time_s, "size": size}
        # Last: a frame whose JSON is there is done.
        write_json(file, entry, compact=True)
        self._keep(frame.index, entry, numbers)

    def _keep(self, index: int, entry: JsonObject, numbers: Sequence[int]) -> None:
        """Add a frame to the tracks, in plain numbers: a film has thousands, and their files hold the rest."""
        time_s, spots = entry["time_s"], entry["specularities"]
        self.sizes["{} x {}".format(*entry["size"])] += 1
        self.frames.append(DoneFrame(index, entry["image"], time_s, len(spots)))
        for spot, number in zip(spots, numbers, strict=True):
            track = self.tracks.setdefault(number, Track(number))
            best = spot["best"] and spot["estimates"][spot["best"]]["normal"]
            track.frames.append(index)
            track.times_s.append(time_s)
            for values, value in ((track.peaks_px, spot["peak_px"]), (track.normals, best)):
                values.append(None if value is None else np.asarray(value).tolist())

    def _track_numbers(self, positions_px: Sequence[npt.ArrayLike], size: tuple[int, int], index: int) -> list[int]:
        self._tracker = self._tracker or Tracker(size)
        return self._tracker.update(positions_px, index, size)


def _positions(entry: JsonObject) -> list[npt.ArrayLike]:
    """Return where a frame's file has its specularities, px: their peaks, or the middles of their boxes."""
    spots = ((spot["peak_px"], spot["box_px"]) for spot in entry["specularities"])
    return [np.add(box[:2], np.divide(box[2:], 2)) if peak is None else peak for peak, box in spots]


def _read_done(path: Path, name: str) -> JsonObject | None:
    """Read what an earlier run wrote of a frame; None where there is nothing, or it cannot be used."""
    try:
        entry: JsonObject = read_json(path)
        # The tables, the tracks and the motion need what a frame's file must hold.
        tuple(_rows(entry, COLUMNS))
        np.asarray(_positions(entry), dtype=float).reshape(-1, 2)
        for spot in entry["specularities"]:
            TrackedHighlight.from_json(0, spot)
        return entry if (entry["image"], len(entry["size"])) == (name, 2) and "time_s" in entry else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _judge_by_motion(run: _Run, poses: Poses, calibration: Calibration) -> str:
    """Judge the highlights' curvatures by the poses, add that to the frames' files and the tracks, and say how many."""
    files = [(frame.index, run.file(frame.index)) for frame in run.frames]
    told = poses.of_frames([frame.name for frame in run.frames], [index for index, _ in files])
    pose_of = {index: pose for (index, _), pose in zip(files, told, strict=True)}
    highlights = [
        TrackedHighlight.from_json(index, entry) for index, file in files for entry in read_json(file)["specularities"]
    ]
    judged = judge_by_motion(highlights, pose_of, poses.error, calibration.priors)
    is_flipped = fits_flipped_axes(highlights, judged, pose_of, poses.error, calibration.priors)
    records = iter(judged)
    for _, file in files:
        data = read_json(file)
        for entry in data["specularities"]:
            entry["motion"] = next(records)
            run.tracks[entry["track"]].shapes.append(entry["motion"].shape)
        write_json(file, data, compact=True)
    return _told_by_motion(judged, poses, is_flipped)


def _told_by_motion(judged: Sequence[MotionRecord], poses: Poses, is_flipped: bool) -> str:
    """Return how many highlights' curvatures motion told, as a sentence."""
    shapes = Counter(each.shape for each in judged)
    counts = ", ".join(f"{count} {shape}" for shape, count in shapes.most_common())
    compared = [each for each in judged if each.distance2 is not None]
    misfits = sum(not each.fits for each in compared)
    stated = f"{poses.error.translation:.1%} and {math.degrees(poses.error.rotation):.2g} deg"
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


def _settings(source: Path, options: Options, calibration: Calibration | None) -> JsonObject:
    """Return the run's settings, through JSON, so that paths and tuples compare with the text and lists of a file."""
    later = ("poses", "regions")
    given = {key: value for key, value in asdict(options).items() if key not in later or value is not None}
    if (regions := options.regions) is not None:
        hashes = [file_hash(Path(file)) for file in regions.files]
        given["regions"] = {**regions.model_dump(mode="json"), "files": hashes}
    if calibration is not None:
        content = json.dumps(asdict(calibration), default=str)
        given["calibration"] = hashlib.sha256(content.encode()).hexdigest()
    settings = json.dumps(
        {"source": source, **given, "version": version()},
        default=lambda value: str(value.resolve()) if isinstance(value, Path) else str(value),
    )
    return dict(json.loads(settings))


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
        other = ", ".join(keys) or "set of settings"
        raise InputError(f"--out {path.parent}: holds a run with another {other}; give another folder")


def _write(run: _Run, tracks: Sequence[Track]) -> list[Path]:
    judged = any(track.shapes for track in tracks)
    files = [run.out / name for name in ("timeline.csv", "tracks.json", "index.html")]
    of_normals = COLUMNS if run.options.regions is None else (*COLUMNS, *REGION_COLUMNS)
    columns = (*TIMELINE, *of_normals, *(MOTION_COLUMNS if judged else ()))
    # One frame's file after the other: a film's rows do not fit into memory.
    rows = (row for frame in run.frames for row in _rows(read_json(run.file(frame.index)), of_normals))
    write_atomically(files[0], lambda part: write_csv(part, columns, rows))
    write_json(files[1], tracks, compact=True)
    write_atomically(files[2], lambda part: write_sequence_page(part, run.frames, tracks))
    return files


def _rows(frame: JsonObject, columns: Sequence[str]) -> Iterator[tuple[object, ...]]:
    """Yield the rows of timeline.csv of a frame's file."""
    for entry in frame["specularities"]:
        motion = motion_row(entry["motion"]) if "motion" in entry else ()
        for row in normals_rows([entry], columns):
            yield (frame["frame_index"], frame["time_s"], entry["track"], *row, *motion)

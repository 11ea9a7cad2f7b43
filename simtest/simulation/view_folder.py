"""The folder that `simtest views` writes: pictures, poses in several formats, and a sequence's film and labels."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.files import write_json
from simtest.simulation.sequence_labels import FILES, SequenceLabels
from simtest.simulation.view_files import FRAMES_PER_SECOND, ViewWriter
from simtest.simulation.viewpoints import Progress, SampledViews, sample_views, viewpoint_key
from simtest.spec import Scene
from simtest.spec.camera_formats.trajectories import COLMAP, TRANSFORMS, TUM, Trajectory, stack, write_trajectory

FPS = (0.1, 1000.0)
"""Frames a second that a sequence may have."""


def sample_into(
    folder: Path,
    scene: Scene,
    count: int,
    viewpoints: Iterable[int | float],
    variant: str | None,
    progress: Progress | None,
    sequence: bool,
    fps: float | None = None,
    labels: bool = False,
) -> SampledViews:
    """Sample views of a scene and write them into an existing folder (see `simtest.sample_views`)."""
    if fps is not None and not FPS[0] <= fps <= FPS[1]:
        raise InputError(f"fps = {fps:g}: must be {FPS[0]:g} to {FPS[1]:g} frames a second")
    rate = (fps or FRAMES_PER_SECOND) if sequence else None
    _remove_old(folder)
    labeller = SequenceLabels(folder) if labels else None
    with ViewWriter(folder, rate) as writer:
        label = None if labeller is None else labeller.add
        sampled = sample_views(scene, count, viewpoints, variant, progress, writer.add, rate, label)
        writer.close()
    if labeller is not None:
        labeller.close()
    left_out = _write_poses(folder, scene, sampled)
    write_json(folder / "views.json", sampled.to_json(viewpoint_key(scene)))
    return replace(sampled, poses_left_out=tuple(left_out))


def _write_poses(folder: Path, scene: Scene, sampled: SampledViews) -> list[str]:
    """Write the poses of views in other programs' formats; return why some cannot hold the camera."""
    views = sampled.views
    if not views:
        return []
    names = [view.written.picture for view in views if view.written is not None]
    times = [view.time_s for view in views if view.time_s is not None]
    poses = stack([view.world_from_camera for view in views])
    return write_trajectory(Trajectory(names, poses, times or None), scene.camera.model(), folder)[1]


def _remove_old(folder: Path) -> None:
    """Remove the poses of an earlier call, its list of views, and its labels."""
    colmap = [f"{COLMAP}/{name}.txt" for name in ("cameras", "images", "points3D")]
    for pattern in ("views.json", TUM, TRANSFORMS, *colmap, *FILES):
        for old in folder.glob(pattern):
            old.unlink()

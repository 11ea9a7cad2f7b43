"""Optical flow: what it adds to rendering a frame, and how exactly its cycle closes.

Each scene is a film's: two neighbouring frames along the colon's camera path, 640 x 480. The frame is that of
`simtest views`, without writing: radiance, true highlights, sensor. The flow is that of a sequence's frame: exact
depths, and the flow forward and backward with hidden points. Both take turns; the ratio is that of processor time.
"""

import statistics
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.measuring import Figure
from benchmarks.timing import times_in_turns
from simtest.rendering import Session
from simtest.simulation.flow import SEEN, Flow, SeenSurface, flow_between
from simtest.simulation.frame import render_view
from simtest.spec import Scene, load_scene

ROUNDS = 5
LIMIT = 0.3
SCENES = {
    "tissue, 16 samples a pixel": ("tissue_colon", {}, LIMIT),
    "smooth colon, 16 samples a pixel": ("anatomy", {"render.samples_per_pixel": 16, "render.adaptive": False}, None),
    "smooth colon, 1 sample a pixel": ("anatomy", {}, None),
}
SHARES = (0.4, 0.403)


def figures() -> list[Figure]:
    """Return the figures."""
    return [figure for name in SCENES for figure in _of_scene(name)]


def _of_scene(name: str) -> Iterator[Figure]:
    shipped, settings, limit = SCENES[name]
    scene = load_scene(shipped, {"surface.view": "wall", **settings})
    first, second = (_at(scene, share) for share in SHARES)
    session = Session(first)
    last = SeenSurface.of(session)
    session.update(second)

    def frame() -> None:
        render_view(session, second).frame(0)

    def flow() -> tuple[Flow, Flow]:
        # Depths are kept with the frame: traced anew in each round.
        session._forget()
        seen = SeenSurface.of(session)
        return flow_between(session, last, seen), flow_between(session, seen, last)

    def both() -> None:
        session._forget()
        frame()

    times = times_in_turns({"frame": both, "flow": flow}, ROUNDS, time.process_time)
    ratio = statistics.median(b / a for a, b in zip(times["frame"], times["flow"], strict=True))
    about = ", ".join(f"{key} {1e3 * statistics.median(value):.0f} ms" for key, value in times.items())
    yield Figure(f"flow over frame: {name}", ratio, limit, False, "x", about)
    closed = _cycle(session, last, SeenSurface.of(session))
    yield Figure(f"largest cycle error: {name}", float(np.nanmax(closed)), 1e-6, False, "px", f"{len(closed)} points")


def _cycle(session: Session, first: SeenSurface, second: SeenSurface) -> np.ndarray:
    """Return how far from their pixels points end that are cast back from where the flow takes them, px."""
    flow = flow_between(session, first, second)
    seen = flow.state == SEEN
    pose = second.world_from_camera
    directions = second.camera.unproject((first.camera.pixel_centres() + flow.flow_px)[seen]) @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    points = origins + directions * session.exact_distances(origins, directions)[:, None]
    return np.asarray(np.linalg.norm(first.project(points) - first.camera.pixel_centres()[seen], axis=1))


def _at(scene: Scene, share: float) -> Scene:
    surface = scene.surface.model_copy(update={"path_share": share})
    return scene.model_copy(update={"surface": surface})

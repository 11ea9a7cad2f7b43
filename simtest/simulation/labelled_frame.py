"""One labelled frame: picture, radiance, ground truth and highlights."""

from dataclasses import dataclass

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering import Progress, Radiance, Session, TruthMaps
from simtest.runtime.arrays import Image
from simtest.simulation.rendered_view import render_view
from simtest.simulation.true_highlights import TrueHighlight
from simtest.spec import Scene


@dataclass(frozen=True)
class LabelledFrame:
    """A rendered frame with its ground truth.

    Parameters
    ----------
    scene : Scene
        What was rendered.
    camera : Camera
        Calibration.
    image : ndarray of float32, shape (H, W) or (H, W, 3)
        The sensor's frame, full scale 1, as encoded by the sensor's response.
    radiance : Radiance
        Linear, split by its way.
    truth : TruthMaps
        At each pixel's centre, camera frame.
    highlights : list of TrueHighlight
        All of them; those with `isolated` count.
    full_scale : float
        Radiance behind the lens that became 1.
    variant : str
        Mitsuba variant.
    """

    scene: Scene
    camera: Camera
    image: Image
    radiance: Radiance
    truth: TruthMaps
    highlights: list[TrueHighlight]
    full_scale: float
    variant: str


def make_frame(scene: Scene, variant: str | None = None, progress: Progress | None = None) -> LabelledFrame:
    """Render a labelled frame (see `simtest.render`).

    Raises
    ------
    InputError
        If no pixel sees the surface.
    BackendError
        If the rendering backend cannot be used.
    """
    session = Session(scene, variant, labelled=True)
    # The frame's labels are not used, but the truth starts from their hits.
    radiance = session.frame(progress).radiance
    truth = session.truth()
    if not truth.mask.any():
        raise InputError(f"scene {scene.name}: no pixel sees the surface; move it, or widen the field of view")
    view = render_view(session, scene, radiance)
    image = view.frame(scene.sensor.seed)
    return LabelledFrame(
        scene, session.camera, image, radiance, truth, view.highlights, view.full_scale, session.variant
    )

"""One labelled frame: picture, radiance, ground truth and highlights."""

from collections.abc import Sequence
from dataclasses import dataclass

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering import HighlightPoint, Progress, Radiance, Session, TruthMaps
from simtest.runtime.arrays import Array, Image, short_repr
from simtest.simulation.rendered_view import render_view
from simtest.simulation.sensor import check_codec
from simtest.simulation.true_highlights import TrueHighlight
from simtest.simulation.visible_highlights import VisibleHighlight
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
    clouds : sequence of HighlightPoint
        Highlight points of the base, around which the glints of a relief lie; on a smooth surface the highlights.
    visible_highlights : list of VisibleHighlight
        The spots that can be seen in the noise-free frame, the brightest first.
    full_scale : float
        Radiance behind the lens that became 1.
    world_from_camera : ndarray, shape (4, 4)
        The camera's pose, mm; the world is the surface's own frame.
    variant : str
        Mitsuba variant.
    calibration : Calibration
        What reconstruction is told of camera, sensor, lights, distance and lobe.

    Examples
    --------
    >>> import simtest
    >>> frame = simtest.render("sphere", width=96, height=96)
    >>> found = simtest.reconstruct(frame.image, frame.calibration)
    >>> float(found[0].estimates["cone_axis"].normal @ frame.highlights[0].normal) > 0.999
    True
    """

    scene: Scene
    camera: Camera
    image: Image
    radiance: Radiance
    truth: TruthMaps
    highlights: list[TrueHighlight]
    clouds: Sequence[HighlightPoint]
    visible_highlights: list[VisibleHighlight]
    full_scale: float
    world_from_camera: Array
    variant: str
    calibration: Calibration

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the lit surface with its highlights, and what was rendered."""
        from simtest.pages.notebook import note_html, picture_html
        from simtest.simulation.preview import preview

        isolated = sum(truth.isolated for truth in self.highlights)
        what = "isolated highlight" if isolated == 1 else "isolated highlights"
        text = (
            f"{self.scene.name}: {self.scene.surface.type}, {self.scene.reflectance.type}; "
            f"{self.camera.width} x {self.camera.height} px; {isolated} {what}. "
            "Exposed for the eye; `image` holds the data."
        )
        return picture_html(preview(self), text) + note_html(text)


def make_frame(scene: Scene, variant: str | None = None, progress: Progress | None = None) -> LabelledFrame:
    """Render a labelled frame (see `simtest.render`)."""
    check_codec(scene.sensor.coding)
    session = Session(scene, variant, labelled=True)
    # The frame's labels are not used, but the truth starts from their hits.
    radiance = session.frame(progress).radiance
    truth = session.truth()
    if not truth.mask.any():
        raise InputError(f"scene {scene.name}: no pixel sees the surface; move it, or widen the field of view")
    view = render_view(session, scene, radiance)
    image = view.frame(scene.sensor.seed)
    return LabelledFrame(
        scene=scene,
        camera=session.camera,
        image=image,
        radiance=radiance,
        truth=truth,
        highlights=view.highlights,
        clouds=view.clouds,
        visible_highlights=view.visible_highlights,
        full_scale=view.full_scale,
        world_from_camera=session.surface.model_from_camera,
        variant=session.variant,
        calibration=view.calibration,
    )

"""What reconstruction may know of a sample's picture: the calibration that the recipe tells, never the truth."""

from simtest.calibration import Calibration
from simtest.dataset.metadata import SampleMeta
from simtest.simulation.frame_files import picture_calibration
from simtest.spec import Scene


def calibration_of(meta: SampleMeta) -> Calibration:
    """Return the calibration of the field ``image`` of a sample, from its metadata.

    It states camera, response and noise, and of lights, distance and lobe what the scene's ``known`` tells.
    `simtest.reconstruct` takes it with the picture.
    """
    scene = Scene.model_validate(meta["scene"])
    return picture_calibration(scene.calibration(), scene.sensor)

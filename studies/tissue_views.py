"""Frames of the recipe `endoscopy` as studies of stated regions take them: the view, its picture, what a user tells."""

import sys
import warnings

import numpy as np

from simtest.calibration import Calibration, Priors, Uniform
from simtest.dataset.plan import Plan
from simtest.errors import SimtestError
from simtest.geometry import Camera
from simtest.rendering import Session
from simtest.runtime.arrays import Image
from simtest.simulation.frame import RenderedView, render_view

SCOPES = {"colonoscope": (0, 1), "laparoscope": (2, 3)}
"""Families of the recipe by scope: colon and stomach, liver and gallbladder."""

ORGANS = ("colon", "stomach", "liver", "gallbladder")
"""By family."""

RANGES_MM = {"colonoscope": Uniform(8.0, 80.0), "laparoscope": Uniform(30.0, 150.0)}
"""Working range that a user would tell."""

TRIES, COLOUR = 4, "llvm_ad_rgb"


def rendered(plan: Plan, index: int) -> tuple[Session, RenderedView, int] | None:
    """Return a rendered frame and its family; None where no draw gives one."""
    for attempt in range(TRIES):
        drawn = plan.draw(index, attempt)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                session = Session(drawn.scene, COLOUR)
                return session, render_view(session, drawn.scene), drawn.anatomy.family
        except SimtestError as error:
            print(f"frame {index}: {error}", file=sys.stderr)
    return None


def in_8_bits(view: RenderedView) -> Image:
    """Return the picture of a frame, with the noise of its scene's seed."""
    return np.asarray(np.rint(255 * view.frame(view.scene.sensor.seed)) / 255, dtype=np.float32)


def told(view: RenderedView, family: int) -> Calibration:
    """Return what a user would tell of a frame's camera: the nominal lights and the scope's working range."""
    camera, lights = view.calibration.camera, view.calibration.priors.lights_mm
    plain = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    scope = next(name for name, families in SCOPES.items() if family in families)
    return Calibration(plain, priors=Priors(lights_mm=lights, distance_mm=RANGES_MM[scope]))

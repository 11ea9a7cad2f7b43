"""The error ladder: the error that remains when the input of each stage is replaced by the exact one.

`python -m studies.error_ladder` prints the table of docs/measured/error_ladder.md; seconds.

The scenes have closed forms, so the exact input of every stage is known: the frame without noise, the isophote between
the pixels, its cone, the normal itself. The light is at the camera.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import groupby

import numpy as np

from simtest.conventions import CIRCLE_POSE_ISOVALUE, CONE_AXIS_ISOVALUES, DEFAULT_SMOOTHING_PX, PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.dispatch import run
from simtest.estimators.protocol import Estimate, Estimator
from simtest.geometry import Camera, CirclePose, Patch
from simtest.geometry.cones import circle_pose as pose_of_cone
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime.arrays import Array, Image
from simtest.runtime.seeds import Stage, generator
from simtest.validation import laws

DISTANCE_MM = 10.0
EXPONENT = 50.0
NOISE = 0.05
REALISATIONS = 12
CAMERA = Camera(406, 406, 406.0, 406.0, 203.0, 203.0)

CONTOUR_POINTS = 240
REACH_PX = 110.0
"""Isophotes stay closer to the peak than this."""

HALVINGS = 60


@dataclass(frozen=True)
class ClosedScene:
    """A plane, or a cylinder convex towards the camera, with a Phong lobe, lit from the camera.

    Parameters
    ----------
    name : str
        For tables.
    tilt_deg : float
        Angle of the highlight from the optical axis.
    kd : float
        Distance over the cylinder's radius; 0: a plane.
    """

    name: str
    tilt_deg: float
    kd: float = 0.0

    @property
    def sightline(self) -> Array:
        """To the brightest point, unit, shape (3,), camera frame."""
        tilt = np.radians(self.tilt_deg)
        return np.array([np.sin(tilt), 0.0, np.cos(tilt)])

    def _hit(self, sightlines: Array) -> tuple[Array, Array]:
        """Compute distance, mm, and cosine between normal and view along unit sightlines, shape (..., 3)."""
        # Plane.
        along = sightlines @ self.sightline
        if not self.kd:
            return DISTANCE_MM / along, along
        radius = DISTANCE_MM / self.kd
        # Cylinder along y; its axis lies behind the brightest point. Nearer root of a quadratic in the distance.
        across = 1 - sightlines[..., 1] ** 2
        reach = (DISTANCE_MM + radius) * along
        under = reach**2 - across * ((DISTANCE_MM + radius) ** 2 - radius**2)
        distance = (reach - np.sqrt(np.maximum(under, 0))) / across
        cosine = np.sqrt(np.maximum(under, 0)) / radius
        return np.where(under > 0, distance, np.inf), np.where(under > 0, cosine, 0.0)

    def radiance(self, sightlines: Array) -> Array:
        """Compute the radiance along unit sightlines, shape (..., 3): cos(2 theta)^n over the squared distance."""
        distance, cosine = self._hit(sightlines)
        return np.asarray(np.maximum(2 * cosine**2 - 1, 0.0) ** EXPONENT / distance**2)

    def normal(self) -> Array:
        """Compute the normal at the brightest point from the surface's own gradient, unit, shape (3,)."""
        point = self._hit(self.sightline)[0] * self.sightline
        if not self.kd:
            return -self.sightline
        out = point - (DISTANCE_MM + DISTANCE_MM / self.kd) * self.sightline
        out[1] = 0.0
        return np.asarray(out / np.linalg.norm(out))

    def frame(self) -> Image:
        """Compute the noise-free frame, shape (H, W), with a peak of 1."""
        columns, rows = np.meshgrid(*(np.arange(n) + PIXEL_CENTRE for n in (CAMERA.width, CAMERA.height)))
        value = self.radiance(CAMERA.unproject(np.stack([columns, rows], axis=-1)))
        return np.asarray(value / self.radiance(self.sightline), dtype=np.float32)

    def contour(self, isovalue: float) -> Array:
        """Compute points of the exact isophote, px, shape (N, 2): where the radiance is t times its peak."""
        phase = np.linspace(0, 2 * np.pi, CONTOUR_POINTS, endpoint=False)
        directions = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        peak, level = CAMERA.project(self.sightline), isovalue * self.radiance(self.sightline)
        # Bisect along rays from the peak.
        low, high = np.zeros(CONTOUR_POINTS), np.full(CONTOUR_POINTS, REACH_PX)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            inside = self.radiance(CAMERA.unproject(peak + middle[:, None] * directions)) > level
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        return np.asarray(peak + low[:, None] * directions)

    def cone(self, isovalue: float) -> Array:
        """Compute the exact cone: its axis is the sightline, its half-axes are those of the principal sections."""
        # A plane's isophote is a circle about its normal; each principal section of the cylinder is a circle or a line.
        across, along = laws.isophote_half_width(isovalue, EXPONENT, np.array([self.kd, 0.0]))
        y = np.array([0.0, 1.0, 0.0])
        x = np.cross(y, self.sightline)
        s = self.sightline
        return np.asarray(np.outer(x, x) / across**2 + np.outer(y, y) / along**2 - np.outer(s, s))


SCENES = (
    ClosedScene("plane, 5° off the axis", 5.0),
    ClosedScene("plane, 20° off the axis", 20.0),
    ClosedScene("cylinder R = d, 10° off the axis", 10.0, 1.0),
)


@dataclass(frozen=True)
class ExactPatch(Patch):
    """A patch whose contours are not traced but computed from a scene."""

    scene: ClosedScene = SCENES[0]

    def crossings_of(self, isovalues: Sequence[float]) -> list[Array | Failure]:
        """Compute the exact isophotes (see `Patch.crossings_of`)."""
        return [self.scene.contour(t) for t in isovalues]

    @classmethod
    def of(cls, patch: Patch, scene: ClosedScene) -> "ExactPatch":
        """Make a patch with another's pixels and the exact contours and peak of a scene."""
        held = {field.name: getattr(patch, field.name) for field in fields(Patch) if field.init}
        fresh = {"peak_px": CAMERA.project(scene.sightline), "noise": None}
        return cls(**(held | fresh), scene=scene)


@dataclass(frozen=True)
class _Ladder:
    """An estimator, its isovalues, and its last stage, which turns poses into candidates, shape (K, 3)."""

    whole: Estimator
    isovalues: tuple[float, ...]
    last: Callable[[Sequence[CirclePose]], Array]


def _mean_axis(poses: Sequence[CirclePose]) -> Array:
    axis = np.sum([pose.axis for pose in poses], axis=0)
    return np.asarray(-axis[None] / np.linalg.norm(axis))


ESTIMATORS = {
    "circle_pose": _Ladder(circle_pose, (CIRCLE_POSE_ISOVALUE,), lambda poses: poses[0].normals),
    "cone_axis": _Ladder(cone_axis, CONE_AXIS_ISOVALUES, _mean_axis),
}

RUNGS = {
    "as it is": f"noisy frames (sigma {NOISE:g}), smoothed by {DEFAULT_SMOOTHING_PX:g} px, the whole pipeline",
    "no noise": "the frame replaced by the noise-free one, smoothed as before",
    "no smoothing": "the smoothed frame replaced by the noise-free one as it is",
    "exact contour": "the contour traced between pixels replaced by the exact isophote",
    "exact cone": "the cone of the fitted ellipse replaced by the exact one; what is left is the model's",
    "exact pose": "the pose's candidates replaced by the exact normal: nothing but rounding is left",
}
"""What is replaced at each rung, in addition to the rungs before it."""


@dataclass(frozen=True)
class Rung:
    """The error at one rung.

    Parameters
    ----------
    scene, estimator, name : str
        The rung's.
    errors_deg : ndarray, shape (n,)
        Angle between the true normal and the better candidate, for each realisation; one value without noise.
    failures : int
        Realisations without an answer, which are not among the errors.
    """

    scene: str
    estimator: str
    name: str
    errors_deg: Array
    failures: int = 0

    @property
    def mean_deg(self) -> float | None:
        """Mean error; None where nothing answered."""
        return float(self.errors_deg.mean()) if len(self.errors_deg) else None


def error_ladder(scenes: Sequence[ClosedScene] = SCENES, realisations: int = REALISATIONS, seed: int = 0) -> list[Rung]:
    """Compute the ladder of each scene and estimator, with the rungs in the order of `RUNGS`.

    The first rung takes `realisations` noisy frames, drawn with `seed`.
    """
    return [rung for scene in scenes for rung in _of_scene(scene, realisations, seed)]


def _of_scene(scene: ClosedScene, realisations: int, seed: int) -> Iterator[Rung]:
    # Frames: noisy, smoothed, and as they are.
    clean = scene.frame()
    frames = []
    for number in range(realisations):
        rng = generator(seed, "error ladder", scene.name, number, Stage.SENSOR)
        frames.append(clean + np.float32(NOISE) * rng.standard_normal(clean.shape, dtype=np.float32))
    noisy = [_whole(frame, DEFAULT_SMOOTHING_PX)[0] for frame in frames]
    smoothed, _ = _whole(clean, DEFAULT_SMOOTHING_PX)
    sharp, patch = _whole(clean, 0.0)
    # Its contours replaced by the exact ones.
    exact = None if isinstance(patch, Failure) else ExactPatch.of(patch, scene)
    # Rungs: the candidates that each replaced input leads to.
    for name, estimator in ESTIMATORS.items():
        steps: tuple[list[Array | None], ...] = (
            [found[name] for found in noisy], [smoothed[name]], [sharp[name]],
            [None if exact is None else _candidates(run(estimator.whole, exact, CAMERA))],
            [_of_cones(estimator, scene)], [scene.normal()[None]],
        )  # fmt: skip
        for rung, candidates in zip(RUNGS, steps, strict=True):
            yield _rung(scene, name, rung, candidates)


def _rung(scene: ClosedScene, estimator: str, name: str, found: Sequence[Array | None]) -> Rung:
    errors = [float(angle_deg(candidates, -scene.sightline).min()) for candidates in found if candidates is not None]
    return Rung(scene.name, estimator, name, np.array(errors), len(found) - len(errors))


def _whole(frame: Image, smoothing_px: float) -> tuple[dict[str, Array | None], Patch | Failure]:
    """Reconstruct a frame as a user would; return the candidates by estimator, and the patch.

    A frame without a peak is a fault of the tested code: it counts as one without an answer.
    """
    whole = (0, 0, CAMERA.width, CAMERA.height)
    (found,) = reconstruct(frame, CAMERA, list(ESTIMATORS), whole, smoothing_px)
    return {name: _candidates(found.estimates[name]) for name in ESTIMATORS}, found.patch


def _of_cones(estimator: _Ladder, scene: ClosedScene) -> Array | None:
    poses = [pose_of_cone(scene.cone(t)) for t in estimator.isovalues]
    sound = [pose for pose in poses if not isinstance(pose, Failure)]
    return estimator.last(sound) if len(sound) == len(poses) else None


def _candidates(result: Estimate | Failure) -> Array | None:
    return None if isinstance(result, Failure) else result.candidates


def main() -> None:
    """Print the mean error at each rung, by scene and estimator."""
    head = ("scene", "estimator", *RUNGS)
    lines = [head, tuple("---" for _ in head)]
    for (scene, estimator), rungs in groupby(error_ladder(), lambda rung: (rung.scene, rung.estimator)):
        means = [rung.mean_deg for rung in rungs]
        lines.append((scene, estimator, *("none" if mean is None else f"{mean:.2g}" for mean in means)))
    print("\n".join(f"| {' | '.join(line)} |" for line in lines))


if __name__ == "__main__":
    main()

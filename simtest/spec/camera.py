"""The camera of a scene, where it stands and how it moves; camera files."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from simtest.errors import InputError
from simtest.geometry.camera import Camera, FovExtent, ViewMask, focal_of_view
from simtest.geometry.lenses import BrownConrady, Distortion, KannalaBrandt, Scaramuzza
from simtest.geometry.vectors import rotation
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import as_path
from simtest.spec.spec_model import UNSAID, Spec, validate
from simtest.spec.toml_files import read_toml

Speed = Annotated[float, Field(ge=-1e4, le=1e4)]
AngularSpeed = Annotated[float, Field(ge=-3600, le=3600)]


class Motion(Spec):
    """Camera and rig move evenly during the exposure; the frame is the mean of the radiance over it.

    All truth (labels, highlights, poses) is that of the middle of the exposure. Camera frame of that moment: x right,
    y down, z forward.
    """

    velocity_mm_s: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="of the camera's centre, mm/s")
    angular_velocity_deg_s: tuple[AngularSpeed, AngularSpeed, AngularSpeed] = Field(
        (0.0, 0.0, 0.0), description="the camera turns about this axis through its centre, right-handed, deg/s"
    )
    exposure_s: float = Field(1 / 60, gt=0, le=10, description="how long the shutter is open, s; 1/60 is a video field")
    steps: int = Field(
        16,
        ge=2,
        le=1024,
        description="moments at which the radiance is taken; they share the pixel's samples, at least one each. The "
        "picture should move by little more than a pixel from one to the next",
    )

    @property
    def moves(self) -> bool:
        """Whether any velocity differs from 0."""
        return any((*self.velocity_mm_s, *self.angular_velocity_deg_s))

    @property
    def times_s(self) -> Array:
        """The moments, shape (steps,), s from the middle of the exposure: the middles of equal parts of it."""
        return np.asarray(((np.arange(self.steps) + 0.5) / self.steps - 0.5) * self.exposure_s)

    def poses(self) -> Array:
        """Return the camera's poses, shape (steps, 4, 4), at `times_s`: middle_from_moment, mm.

        The centre moves along a straight line, and the camera turns about a fixed axis.
        """
        poses = np.tile(np.eye(4), (self.steps, 1, 1))
        poses[:, :3, 3] = self.times_s[:, None] * np.array(self.velocity_mm_s)
        turn = np.radians(self.angular_velocity_deg_s)
        poses[:, :3, :3] = [rotation(time * turn) for time in self.times_s]
        return poses


Length = Annotated[float, Field(ge=-1e3, le=1e3)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class Moved(Spec):
    """Camera and rig stand elsewhere than where the surface's own keys put them; in the camera frame of that place."""

    translation_mm: tuple[Length, Length, Length] = Field((0.0, 0.0, 0.0), description="of the camera's centre, mm")
    rotation_deg: tuple[Angle, Angle, Angle] = Field(
        (0.0, 0.0, 0.0), description="the camera is turned about this axis through its centre, right-handed, deg"
    )

    def pose(self) -> Array:
        """Return unmoved_from_moved, shape (4, 4), mm."""
        pose = np.eye(4)
        pose[:3, :3] = rotation(np.radians(self.rotation_deg))
        pose[:3, 3] = self.translation_mm
        return pose


class Views(Spec):
    """Further views of the same surface, from a camera moved with its lights: for an experiment on motion.

    The first view is that of the scene. Each further one is moved by `length_mm` across the optical axis.
    """

    count: int = Field(2, ge=2, le=16, description="number of views, the scene's own included")
    length_mm: float = Field(1.0, ge=0, le=100, description="of the motion from the first view to each other one, mm")
    direction_deg: Angle = Field(0.0, description="image direction of the first motion, deg from x to y")
    turn_deg: Angle = Field(90.0, description="by how much the direction of each next motion is turned on, deg")
    translation_error: float = Field(
        0.0,
        ge=0,
        le=1,
        description="standard deviation of the told translation along each axis, share of length_mm",
    )
    rotation_error_deg: float = Field(
        0.0, ge=0, le=45, description="standard deviation of the told rotation about each axis, deg"
    )
    errors_told: bool = Field(True, description="whether the method is told these standard deviations, rather than 0")

    def moved(self) -> list[Moved]:
        """Return where the camera of each further view stands, from the first one."""
        angles = np.radians(self.direction_deg + self.turn_deg * np.arange(self.count - 1))
        return [
            Moved(translation_mm=(float(self.length_mm * np.cos(a)), float(self.length_mm * np.sin(a)), 0.0))
            for a in angles
        ]


SHORTEST, LONGEST = 0.004, 1000.0
"""Focal lengths over the longer side of the image, for fields of view of 179 and 0.06 deg."""

ASPECT = 20.0
"""Largest ratio of the focal lengths along x and y."""

OUTSIDE = 4.0
"""How far outside the image the principal point may lie, in sides of it: a picture may be a part of a larger one."""

SMALL = 64
"""px; an image that is smaller may be a part of one of this size."""

Coefficient = Annotated[float, Field(ge=-1e6, le=1e6)]
PrincipalPoint = Annotated[float, Field(ge=-1e6, le=1e6)]

NOT_OF_THE_CAMERA = frozenset({"vignetting", "emission", "response", "sensor", "rig", "surface", "uncertainty"})
"""Tables that a calibration file may hold beside the camera; `simtest.spec.calibration_spec` describes them."""


class _Lens(Spec):
    lens: ClassVar[type[Distortion]]

    def model(self) -> Distortion:
        """Return the lens as the geometry package uses it."""
        return self.lens(**self.model_dump(exclude={"type"}))


class BrownConradySpec(_Lens):
    """A perspective lens: OpenCV's models of 5 and 8 coefficients, ROS' plumb_bob and rational_polynomial.

    With x = X/Z, y = Y/Z, u = x^2 + y^2, x and y are multiplied by
    (1 + k1 u + k2 u^2 + k3 u^3) / (1 + k4 u + k5 u^2 + k6 u^3); then 2 p1 x y + p2 (u + 2 x^2) is added to x, and
    p1 (u + 2 y^2) + 2 p2 x y to y.
    """

    lens = BrownConrady

    type: Literal["brown_conrady"] = "brown_conrady"
    k1: Coefficient = Field(0.0, description="radial")
    k2: Coefficient = Field(0.0, description="radial")
    p1: Coefficient = Field(0.0, description="tangential")
    p2: Coefficient = Field(0.0, description="tangential")
    k3: Coefficient = Field(0.0, description="radial")
    k4: Coefficient = Field(0.0, description="radial, of the denominator")
    k5: Coefficient = Field(0.0, description="radial, of the denominator")
    k6: Coefficient = Field(0.0, description="radial, of the denominator")


class KannalaBrandtSpec(_Lens):
    """A fisheye: OpenCV's fisheye model, ROS' equidistant.

    A direction at theta from the axis is imaged at theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal
    lengths from the principal point, also at 90 deg and beyond. All coefficients 0 is the equidistant lens.
    """

    lens = KannalaBrandt

    type: Literal["kannala_brandt"] = "kannala_brandt"
    k1: Coefficient = 0.0
    k2: Coefficient = 0.0
    k3: Coefficient = 0.0
    k4: Coefficient = 0.0


class ScaramuzzaSpec(_Lens):
    """An omnidirectional lens: the model of OCamCalib, of MATLAB's fisheye calibration and of C3VD.

    The image point (x, y) sees the direction (x, y, 1 + k2 r^2 + k3 r^3 + k4 r^4), r its distance from the centre, and
    lies (c x + d y, e x + y) focal lengths from the principal point. Of the coefficients in pixels, fx = fy = a0,
    k2 = a2 a0, k3 = a3 a0^2 and k4 = a4 a0^3. It images angles of 90 deg and beyond.
    """

    lens = Scaramuzza

    type: Literal["scaramuzza"] = "scaramuzza"
    k2: Coefficient = 0.0
    k3: Coefficient = 0.0
    k4: Coefficient = 0.0
    c: float = Field(1.0, gt=0, le=1e3, description="of the matrix ((c, d), (e, 1))")
    d: float = Field(0.0, ge=-1e3, le=1e3, description="of the matrix")
    e: float = Field(0.0, ge=-1e3, le=1e3, description="of the matrix")


DistortionSpec = Annotated[BrownConradySpec | KannalaBrandtSpec | ScaramuzzaSpec, Field(discriminator="type")]


class ViewMaskSpec(Spec):
    """The field of view of an endoscope, a circle or a rectangle with cut corners; outside, pixels see nothing."""

    radius: float = Field(gt=0, le=1e6, description="of the circle, or half width of the rectangle, px")
    corner: float | None = Field(
        None, ge=0, le=1e6, description="what the cuts take off the sides of a rectangle, px; default a circle"
    )
    half_height: float | None = Field(None, gt=0, le=1e6, description="of the rectangle, px; default radius: a square")
    cx: PrincipalPoint | None = Field(None, description="centre, px; default the image's centre")
    cy: PrincipalPoint | None = Field(None, description="centre, px; default the image's centre")


class CameraSpec(Spec):
    """A camera: a pinhole, or a lens with distortion; pixel centres at integer + 0.5."""

    width: int = Field(406, ge=1, le=16384, description="px")
    height: int = Field(406, ge=1, le=16384, description="px")
    fx: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along x, px")
    fy: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along y, px")
    fov_deg: float | None = Field(
        None, ge=0.05, le=360, description="instead of fx and fy: field of view of the lens, deg, with square pixels"
    )
    fov_of: FovExtent = Field("width", description="what fov_deg spans: the image's width, height or diagonal")
    cx: PrincipalPoint | None = Field(None, description="principal point, px; default the image's centre")
    cy: PrincipalPoint | None = Field(None, description="principal point, px; default the image's centre")
    skew: float = Field(0.0, ge=-1e6, le=1e6, description="px")
    distortion: DistortionSpec | None = Field(
        None, description="the lens; default none, a pinhole. It must not fold over inside the image or the view mask"
    )
    view_mask: ViewMaskSpec | None = Field(None, description="default: the whole image is seen")

    @model_validator(mode="after")
    def _focal_lengths(self) -> "CameraSpec":
        if self.fov_deg is None:
            if "fov_of" in self.model_fields_set:
                raise ValueError(f"fov_of = {self.fov_of!r}: needs fov_deg")
            return self
        if self.skew != 0:
            raise ValueError(f"skew = {self.skew:g}: must be 0 with fov_deg, which means square pixels")
        if given := sorted({"fx", "fy"} & self.model_fields_set):
            raise ValueError(f"fov_deg and {' and '.join(given)} exclude each other; give one of them")
        lens = None if self.distortion is None else self.distortion.model()
        focal = focal_of_view(self.fov_deg, (self.width, self.height), self._centre_px, lens, self.fov_of)
        # Known from here on; a frozen model has no other way.
        self.__dict__.update(fx=focal, fy=focal)
        return self

    @model_serializer(mode="wrap")
    def _one_focal_length(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write the field of view or the focal lengths, never both: they exclude each other when they are read."""
        table: dict[str, Any] = handler(self)
        for key in ("fov_deg", "fov_of") if self.fov_deg is None else ("fx", "fy"):
            table.pop(key, None)
        return table

    @model_validator(mode="after")
    def _plausible(self) -> "CameraSpec":
        side = max(self.width, self.height)
        for name, focal in (("fx", self.fx), ("fy", self.fy)):
            if not SHORTEST * side <= focal <= LONGEST * max(side, SMALL):
                raise ValueError(
                    f"{name} = {focal:g}: must be {SHORTEST * side:g} to {LONGEST * max(side, SMALL):g} px, for a "
                    f"field of view between 0.06 and 179 deg of an image of {self.width} x {self.height} px"
                )
        if not 1 / ASPECT <= self.fx / self.fy <= ASPECT:
            raise ValueError(f"fx = {self.fx:g} and fy = {self.fy:g}: must differ by a factor of {ASPECT:g} at most")
        if abs(self.skew) > self.fx:
            raise ValueError(f"skew = {self.skew:g}: must be at most fx = {self.fx:g} in size")
        for name, size in (("cx", self.width), ("cy", self.height)):
            centre, reach = getattr(self, name), OUTSIDE * max(size, SMALL)
            if centre is not None and not -reach <= centre <= size + reach:
                raise ValueError(
                    f"{name} = {centre:g}: far outside the image; must be {-reach:g} to {size + reach:g} px"
                )
        return self

    @model_validator(mode="after")
    def _possible(self) -> "CameraSpec":
        # The lens must not fold over inside the image, which only the geometry package can say.
        if self.distortion is not None or self.view_mask is not None:
            try:
                self.model()
            except InputError as error:
                # The path of the key is put before the message.
                raise ValueError(str(error).removeprefix("camera.")) from None
        return self

    @property
    def _centre_px(self) -> tuple[float, float]:
        return _centre(self.cx, self.cy, (self.width / 2, self.height / 2))

    def model(self) -> Camera:
        """Return the camera as the geometry package uses it."""
        middle = (self.width / 2, self.height / 2)
        cx, cy = self._centre_px
        lens = None if self.distortion is None else self.distortion.model()
        mask = None
        if self.view_mask is not None:
            told = self.view_mask
            mask = ViewMask(*_centre(told.cx, told.cy, middle), told.radius, told.corner, told.half_height)
        return _camera(self.width, self.height, self.fx, self.fy, cx, cy, self.skew, lens, mask)


class SceneCamera(CameraSpec):
    """The camera of a scene: that of a camera file, and how it moves."""

    motion: Motion | None = Field(None, description="during the exposure; default none")
    moved: Moved | None = Field(None, description="from where the surface's keys put it; default not", **UNSAID)

    @property
    def moving(self) -> Motion | None:
        """The motion, where it moves the camera at all."""
        return self.motion if self.motion is not None and self.motion.moves else None

    @property
    def still(self) -> "SceneCamera":
        """The same camera without its motion."""
        return self if self.motion is None else self.model_copy(update={"motion": None})


@lru_cache(maxsize=16)
def _camera(*values: Any) -> Camera:
    """Return the camera of some values; an experiment checks the scenes of all its settings, which share one."""
    return Camera(*values)


def _centre(cx: float | None, cy: float | None, middle: tuple[float, float]) -> tuple[float, float]:
    return middle[0] if cx is None else cx, middle[1] if cy is None else cy


@plain_errors
def load_camera(path: str | Path, view_radius_px: float | None = None) -> Camera:
    """Read a camera file; the half pixel between conventions is added or subtracted here (docs/howto/cameras.md).

    Parameters
    ----------
    path : str or Path
        A camera file of OpenCV, ROS, MATLAB, COLMAP, NeRF, Kalibr, Vicalib, OCamCalib or C3VD, recognised by what it
        holds, or TOML with the keys of `CameraSpec`, at top level or under ``[camera]``. FILE#ID names one camera of
        several.
    view_radius_px : float, optional
        Radius of a round view about the image's centre, where the file states none.

    Raises
    ------
    InputError
        If the file is missing or malformed, or describes a lens that simtest does not know.

    Examples
    --------
    >>> import simtest, tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "camera.toml"
    >>> simtest.save_camera(simtest.Camera.from_fov(70.0, 640, 480), path)
    >>> simtest.load_camera(path) == simtest.Camera.from_fov(70.0, 640, 480)
    True
    """
    # Imported on demand: scenes need no format but TOML.
    from simtest.spec.camera_formats.files import read_table, recognise

    path = as_path(path)
    if recognise(path) != "toml":
        return _validated(_with_view(read_table(path), view_radius_px, path), path, HOW_TO_MASK)
    # The camera's keys under [camera], or at top level beside the other tables of a calibration file
    data = {key: value for key, value in read_toml(path).items() if key not in NOT_OF_THE_CAMERA}
    table = data.get("camera", data)
    # A scene's camera has a default size and focal length; a file of its own must state them.
    told = table if isinstance(table, Mapping) else {}
    missing = [key for key in ("width", "height", *(() if "fov_deg" in told else ("fx", "fy"))) if key not in told]
    # A mistyped key is named before the one that is missing because of it.
    if missing and set(told) <= set(CameraSpec.model_fields):
        raise InputError(f"{path}: {missing[0]}: missing; a camera needs width, height, and fx and fy or fov_deg")
    return _validated(_with_view(told, view_radius_px, path), path)


HOW_TO_MASK = "; simtest camera convert FILE --view-radius PX --to toml --out FILE.toml states one"


def _with_view(table: Mapping[str, Any], radius_px: float | None, path: Path) -> Mapping[str, Any]:
    """Return a camera's table with a round view where one is given and the table has none."""
    if radius_px is None:
        return table
    if table.get("view_mask") is not None:
        raise InputError(f"{path}: view_mask: stated in the file; leave the view's radius out")
    return {**table, "view_mask": {"radius": radius_px}}


def _validated(table: Mapping[str, Any], path: Path, how: str = "") -> Camera:
    try:
        return validate(CameraSpec, table, str(path)).model()
    except InputError as error:
        # A file of another program has no place for the mask that would help.
        if how and "folds over" in str(error):
            raise InputError(f"{error}{how}") from None
        raise


@plain_errors
def save_camera(
    camera: Camera, path: str | Path, format: str | None = None, poses: Sequence[tuple[str, Array]] | None = None
) -> None:
    """Write a camera file that `load_camera` reads back.

    Parameters
    ----------
    camera : Camera
        What to write.
    path : str or Path
        The file; replaced if it exists.
    format : {"toml", "opencv", "ros", "colmap", "transforms", "matlab"}, optional
        Default by the suffix: .toml is simtest's own; .yml, .yaml, .xml and .json are OpenCV's, .txt is COLMAP's
        cameras.txt, .mat MATLAB's. "ros" is a camera_info file (.yml, .yaml), "transforms" transforms.json.
    poses : list of (str, ndarray), optional
        Names of frames and their world_from_camera, shape (4, 4), OpenCV axes, where the format holds poses.

    Raises
    ------
    InputError
        If format and suffix do not fit, the format cannot hold the camera, or the file cannot be written.

    Examples
    --------
    >>> import simtest, tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "camera.toml"
    >>> simtest.save_camera(simtest.Camera.from_fov(70.0, 640, 480), path)
    >>> simtest.load_camera(path) == simtest.Camera.from_fov(70.0, 640, 480)
    True
    """
    # Imported on demand, as in `load_camera`.
    from simtest.spec.camera_formats.files import write_camera

    write_camera(camera, path, format, poses)

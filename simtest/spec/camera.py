"""The camera of a scene, and camera files."""

from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.spec.reading import Spec, read_toml, validate


class CameraSpec(Spec):
    """A pinhole camera; pixel centres at integer + 0.5."""

    width: int = Field(406, ge=1, le=16384, description="px")
    height: int = Field(406, ge=1, le=16384, description="px")
    fx: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along x, px")
    fy: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along y, px")
    cx: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, px; default the image's centre")
    cy: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, px; default the image's centre")
    skew: float = Field(0.0, ge=-1e6, le=1e6, description="px")

    def model(self) -> Camera:
        """Give the camera as the geometry package uses it."""
        cx = self.width / 2 if self.cx is None else self.cx
        cy = self.height / 2 if self.cy is None else self.cy
        return Camera(self.width, self.height, self.fx, self.fy, cx, cy, self.skew)


def load_camera(path: str | Path) -> Camera:
    """Read a camera file: a TOML table with the keys of `CameraSpec`, at top level or under ``[camera]``.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    Camera

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    data = read_toml(Path(path))
    table = data.get("camera", data)
    missing = [key for key in ("width", "height", "fx", "fy") if not isinstance(table, Mapping) or key not in table]
    if missing:
        raise InputError(f"{path}: {missing[0]}: missing; a camera needs width, height, fx, fy")
    return validate(CameraSpec, table, str(path)).model()

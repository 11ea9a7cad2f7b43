"""The options of a command that reconstructs a picture: what is known of the camera, and how highlights are taken."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from simtest.cli.options import Estimators, named

if TYPE_CHECKING:
    from simtest.reconstruction.picture import Options


@Parameter(name="*")
@dataclass(frozen=True)
class PictureOptions:
    """The options that `reconstruct` and `twin` share; twins are reconstructed as the picture is."""

    camera: Annotated[
        Path | None,
        Parameter(help="Calibration: the camera and what else is known of it; TOML, or a file of OpenCV, ROS, MATLAB."),
    ] = None
    fov: Annotated[
        float | None,
        Parameter(help="Field of view in deg across the whole picture, where there is no calibration; see --fov-of."),
    ] = None
    fov_of: Annotated[
        Literal["width", "height", "diagonal", "view"],
        Parameter(
            help="What --fov spans: a side or the diagonal of the whole picture, or the round view found in it. "
            "Makers of endoscopes mostly state the diagonal."
        ),
    ] = "width"
    estimators: Estimators = None
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        Parameter(help="How the picture's values are encoded, where the calibration does not say; default srgb."),
    ] = None
    detector: Annotated[
        str,
        named(
            "detectors",
            help="colour: by the tissue's colour; peaks; or the name of another package's. "
            "auto: by colour where there is any.",
        ),
    ] = "auto"
    smoothing: Annotated[float | None, Parameter(help="Smoothing in px; default 1 where found by colour, else 2.")] = (
        None
    )
    target: Annotated[
        Literal["fine", "base"],
        Parameter(help="Whose normals: the fine surface's, or the base's, with the relief's slope in the uncertainty."),
    ] = "fine"
    every: Annotated[
        bool,
        Parameter(
            name="--all",
            negative="",
            help="Take peaks too that the border cuts or whose shape is not that of one point highlight.",
        ),
    ] = False

    def checked(self, roi: tuple[int, int, int, int] | None = None, poses: Path | None = None) -> "Options":
        """Return them as the reconstruction takes them; raise `InputError` where they are malformed.

        Parameters
        ----------
        roi : tuple of int, optional
            Region of interest: column, row, width, height, px.
        poses : Path, optional
            Of the camera over a sequence.
        """
        from simtest.reconstruction.picture import Options

        names = None if self.estimators is None else tuple(self.estimators)
        return Options(
            self.camera, self.fov, names, roi, self.encoding, self.every, self.detector, self.smoothing, self.target,
            self.fov_of, poses,
        )  # fmt: skip


DEFAULTS = PictureOptions()
"""None of them given."""

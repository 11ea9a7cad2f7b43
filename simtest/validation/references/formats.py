"""What the maps of public data sets of endoscopy mean: unit, direction, axes, and which values stand for none.

Units and directions are those that a data set's own files or loaders state. A unit that they leave open is None, and
the user must state it.
"""

from dataclasses import dataclass

from simtest.errors import InputError
from simtest.runtime.boundary import suggestion


@dataclass(frozen=True)
class MapFormat:
    """How a data set writes its maps. Depths of all of them are along the optical axis (z).

    Parameters
    ----------
    title : str
        The data set, with the article that describes it.
    depth_type : str
        NumPy's name of the type of a depth's count.
    step_mm : float, optional
        mm of one count; None if the data set does not tell, so that the user must (``--depth-scale``).
    empty : tuple of int
        Counts that stand for no depth.
    size_px : tuple of int
        Width and height of a frame.
    channels : int
        Of a depth map; several are equal in the first three, a fourth is not read.
    normals : str, optional
        End of the file name of a normal map, None where the data set has none. Such a map has three channels of 16
        bits, -1 to 1 over the whole range; all three are 0 where there is no normal. It stands beside the depth map.
    normal_axes : str
        The camera's axes that red, green and blue hold (`simtest.geometry.vectors`).
    depths : str
        End of the file name of a depth map.
    cautions : tuple of str
        What a user must know of the maps.
    """

    title: str
    depth_type: str
    step_mm: float | None
    size_px: tuple[int, int]
    empty: tuple[int, ...] = (0,)
    channels: int = 1
    normals: str | None = None
    normal_axes: str = "x,y,z"
    depths: str = ".png"
    cautions: tuple[str, ...] = ()


FORMATS = {
    "c3vd": MapFormat(
        "C3VD and C3VDv2 (Bobrow et al. 2023): phantoms, registered to a video",
        "uint16",
        100 / (2**16 - 1),
        (1350, 1080),
        empty=(0, 2**16 - 1),
        normals="_normals.tiff",
        depths="_depth.tiff",
        cautions=("the registration is off by 0.3 mm and 0.2 deg in the mean, by its authors' simulation",),
    ),
    "simcol3d": MapFormat(
        "SimCol3D (Rau et al. 2023): rendered colons, 0 to 20 cm",
        "uint16",
        200 / (255 * 256),
        (475, 475),
    ),
    "ucl": MapFormat(
        "UCL synthetic colon (Rau et al. 2019): rendered colons of 8 bits",
        "uint8",
        None,
        (256, 256),
    ),
    "endoslam": MapFormat(
        "EndoSLAM, part UnityCam (Ozyoruk et al. 2021): rendered organs, relative depths of 8 bits",
        "uint8",
        None,
        (320, 320),
        channels=4,
        cautions=("users report that depth maps of UnityCam are shifted against their frames",),
    ),
}


def map_format(name: str) -> MapFormat:
    """Return a format by name; raise `InputError` for one that is not known."""
    if name not in FORMATS:
        raise InputError(
            f"--reference-format {name}: unknown; allowed: {', '.join(FORMATS)}{suggestion(name, list(FORMATS))}"
        )
    return FORMATS[name]

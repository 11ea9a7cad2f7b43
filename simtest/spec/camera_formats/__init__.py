"""Camera files of other programs: a module a format, which `files` chooses by what a file holds.

Each module states its format's pixel convention and axes. `read_table` gives the table of a `CameraSpec`, `read_poses`
the poses that a file holds beside its camera.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.spec.camera_formats.files import read_poses, read_table, recognise
    from simtest.spec.camera_formats.writing import FORMATS, write_camera

__getattr__, __dir__, __all__ = lazy_names(__name__)

"""What the page shows beside the night, the verdict and the history."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Extras:
    """Further parts of the page; each may be absent.

    Parameters
    ----------
    gallery : tuple of Path
        Gallery items (.npz), the worst first (see `simtest.validation.worst`).
    damaged : tuple of str
        A line for each file of the history that was skipped: its name and what is wrong with it.
    files : tuple of str
        Names of the files for machines that lie beside the page, to link.
    """

    gallery: tuple[Path, ...] = ()
    damaged: tuple[str, ...] = ()
    files: tuple[str, ...] = ()

"""Reads and writes calibration files: a camera, and what is known beside it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.calibration import Calibration
from simtest.errors import InputError
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import as_path
from simtest.spec.camera import NOT_OF_THE_CAMERA, load_camera
from simtest.spec.camera_formats.files import FOREIGN_SUFFIXES, recognise
from simtest.spec.spec_model import validate
from simtest.spec.toml_files import read_toml


@plain_errors
def load_calibration(
    path: str | Path, photometric: str | Path | None = None, view_radius_px: float | None = None
) -> Calibration:
    """Read a calibration file, or a camera file.

    Parameters
    ----------
    path : str or Path
        TOML with the tables of `CalibrationSpec`, the camera's keys under ``[camera]`` or at top level; or anything
        else that `load_camera` reads.
    photometric : str or Path, optional
        EndoMapper's photometric calibration: response, vignetting and light, which the first file then leaves out.
    view_radius_px : float, optional
        As `load_camera` takes it.

    Returns
    -------
    Calibration
        What the file does not state is unknown: no response, no falloff, no noise model.

    Raises
    ------
    InputError
        If a file is missing or malformed, or both state the same.

    Examples
    --------
    >>> import simtest, tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "calibration.toml"
    >>> simtest.save_calibration(simtest.Calibration(simtest.Camera.from_fov(70.0, 640, 480)), path)
    >>> simtest.load_calibration(path).camera.width
    640
    """
    path = as_path(path)
    # camera
    camera = load_camera(path, view_radius_px)
    # everything else, which only TOML holds
    data = read_toml(path) if recognise(path) == "toml" else {}
    if not isinstance(data.get("camera"), Mapping):
        # The camera's keys stand at top level, before the other tables.
        data = {key: value for key, value in data.items() if key in NOT_OF_THE_CAMERA}
    if photometric is not None:
        data = _with_photometry(data, as_path(photometric, "photometric"), path)
    if not data.keys() - {"camera"}:
        return Calibration(camera)
    # Imported here: the models of sensor and lobe are slow to load, and a camera alone needs none.
    from simtest.spec.calibration_spec import CalibrationSpec

    # The camera's own table has been read, by its own rules.
    return validate(CalibrationSpec, {**data, "camera": {}}, str(path)).calibration(camera)


def _with_photometry(data: Mapping[str, Any], photometric: Path, path: Path) -> dict[str, Any]:
    """Return the tables of a calibration file with those of a photometric calibration."""
    from simtest.spec.camera_formats.omnidirectional import read_photometric

    made = dict(data)
    for name, table in read_photometric(photometric).items():
        told = data.get(name, {}) if name == "rig" else {}
        if (name in data and name != "rig") or (isinstance(told, Mapping) and set(told) & set(table)):
            raise InputError(f"{path}: {name}: {photometric} states it too; leave it out in one of them")
        made[name] = {**told, **table}
    return made


@plain_errors
def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration file that `load_calibration` reads back as the same calibration.

    Parameters
    ----------
    calibration : Calibration
        What to write; what it does not know is left out.
    path : str or Path
        The file, TOML; replaced if it exists.

    Raises
    ------
    InputError
        If the calibration holds what no file states (such as a log-uniform distance), or the file cannot be written.

    Examples
    --------
    >>> import simtest, tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "calibration.toml"
    >>> simtest.save_calibration(simtest.Calibration(simtest.Camera.from_fov(70.0, 640, 480)), path)
    >>> simtest.load_calibration(path).camera.width
    640
    """
    path = as_path(path)
    if not isinstance(calibration, Calibration):
        raise InputError(f"calibration is a {type(calibration).__name__}: must be a simtest.Calibration")
    if path.suffix.lower() in FOREIGN_SUFFIXES:
        raise InputError(f"{path}: a calibration is TOML, not {path.suffix}; name it .toml")
    # Imported on demand: reading needs neither.
    from simtest.runtime.files import write_atomically
    from simtest.spec.calibration_spec import calibration_toml

    text = calibration_toml(calibration)
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))

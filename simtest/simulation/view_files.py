"""Writes pictures of views: one of each, a sheet of all of them, and a film of a sequence."""

import math
import os
from pathlib import Path

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Picture
from simtest.runtime.files import write_atomically
from simtest.simulation.frame import RenderedView
from simtest.simulation.frame_files import encoded_png
from simtest.simulation.sensor import to_uint8
from simtest.simulation.viewpoints import WrittenView

FRAMES_PER_SECOND = 25.0
"""Of a sequence whose frame rate is not given."""
SHEET_WIDTH = 1600
SHEET_COLUMNS = 10

FILM, PART = "film.avi", ".film.part.avi"
"""The film, and its name until it is finished: OpenCV knows its format by the suffix."""


class ViewWriter:
    """Writes views as they come.

    Parameters
    ----------
    folder : Path
        An existing folder; pictures of an earlier call are removed.
    fps : float, optional
        Frames a second of film.avi; default no film.
    """

    def __init__(self, folder: Path, fps: float | None = None) -> None:
        self._folder, self._fps = folder, fps
        self._thumbnails: list[Picture] = []
        self._film: cv2.VideoWriter | None = None
        for old in (*folder.glob("view_*.png"), folder / "sheet.png", folder / FILM, folder / PART):
            old.unlink(missing_ok=True)

    def __enter__(self) -> "ViewWriter":
        """Return the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Remove a film that is not finished."""
        if self._film is not None:
            self._film.release()
        (self._folder / PART).unlink(missing_ok=True)

    def add(self, view: RenderedView) -> WrittenView:
        """Write the frame of a view.

        Each has noise of its own, whose seeds count up from the scene's: a film's noise must not stand still.
        """
        sensor = view.scene.sensor
        seed = sensor.seed + len(self._thumbnails)
        frame = view.frame(seed)
        name = f"view_{len(self._thumbnails):04d}.png"
        data = encoded_png(frame, sensor)
        write_atomically(self._folder / name, lambda part: part.write_bytes(data))
        # Film and sheet show sRGB, whatever the sensor's response.
        shown = to_uint8(sensor.response.model().decode(frame).astype(np.float32))
        shown = np.ascontiguousarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR) if shown.ndim == 2 else shown[:, :, ::-1])
        if self._fps is not None:
            self._write(shown, self._fps)
        self._thumbnails.append(thumbnail(np.asarray(shown, dtype=np.uint8)))
        return WrittenView(name, seed)

    def _write(self, picture: Picture, fps: float) -> None:
        if self._film is None:
            # Motion JPEG is the codec that OpenCV writes everywhere.
            file, codec = str(self._folder / PART), cv2.VideoWriter.fourcc(*"MJPG")
            self._film = cv2.VideoWriter(file, codec, fps, (picture.shape[1], picture.shape[0]))
            if not self._film.isOpened():
                raise InputError(f"{self._folder / FILM}: no film can be written here (OpenCV has no Motion JPEG)")
        self._film.write(picture)

    def close(self) -> list[Path]:
        """Finish the film and write the sheet; return sheet.png and film.avi where there are any."""
        if self._film is not None:
            self._film.release()
            os.replace(self._folder / PART, self._folder / FILM)
        if self._thumbnails:
            write_sheet(self._folder / "sheet.png", self._thumbnails)
        return [file for name in ("sheet.png", FILM) if (file := self._folder / name).is_file()]


def thumbnail(picture: Picture) -> Picture:
    """Return a picture, shape (H, W, 3), at the size it has on a sheet."""
    width = SHEET_WIDTH // SHEET_COLUMNS
    size = (width, round(width * picture.shape[0] / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def write_sheet(path: Path, pictures: list[Picture]) -> None:
    """Write pictures of one size, blue first, as a sheet."""
    ok, data = cv2.imencode(".png", _sheet(pictures))
    assert ok
    write_atomically(path, lambda part: part.write_bytes(bytes(data)))


def _sheet(pictures: list[Picture]) -> Picture:
    """Arrange pictures of one size in rows, in order."""
    height, width = pictures[0].shape[:2]
    columns = min(SHEET_COLUMNS, len(pictures))
    rows = math.ceil(len(pictures) / columns)
    sheet = np.zeros((rows * height, columns * width, 3), dtype=np.uint8)
    for i, picture in enumerate(pictures):
        row, column = divmod(i, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = picture
    return sheet

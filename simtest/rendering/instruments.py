"""The instruments of a session's scene: where they are, which pixels they cover, and which highlights they hide."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.rendering.frames import HighlightPoint, Labels, TruthMaps
from simtest.rendering.instrument_kernel import InstrumentKernel
from simtest.rendering.placement_checks import check_instruments
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.lights import is_at_camera
from simtest.spec.surfaces import DEFAULT_DEPTH_SHARE, Instrument
from simtest.surfaces.instrument import round_cones

if TYPE_CHECKING:
    from simtest.rendering.session import Session

SEARCH_PX = 16
"""Spacing of the sightlines among which the nearest one to a tip is taken that meets the surface."""

ROUNDING = 1e-6
"""An instrument nearer to a point than this share of the distance touches it, and does not hide it."""


def place(session: "Session") -> InstrumentKernel | None:
    """Return the kernel of a scene's instruments at their places; None without any."""
    shown = session.scene.shown_instruments
    if not shown:
        return None
    cones = round_cones(shown, {index: _tip(session, index, one) for index, one in shown.items()})
    check_instruments(session.scene, session.camera, cones)
    return InstrumentKernel(session.mi, cones.moved(session.surface.model_from_camera), shown)


def _tip(session: "Session", index: int, instrument: Instrument) -> Array:
    """Return where an instrument's tip is, shape (3,), camera frame, mm."""
    camera, where = session.camera, f"scene {session.scene.name}: instruments.{index}"
    pixel = np.array(instrument.tip) * [camera.width, camera.height]
    sightline = camera.unproject(pixel[None])[0]
    if not np.isfinite(sightline).all():
        raise InputError(f"{where}.tip = {list(instrument.tip)}: no sightline leads there; must be nearer the middle")
    if instrument.depth_mm is not None:
        return np.asarray(instrument.depth_mm * sightline)
    # The surface's distance there, or where it is nearest in the picture.
    grid = camera.pixel_centres()[SEARCH_PX // 2 :: SEARCH_PX, SEARCH_PX // 2 :: SEARCH_PX].reshape(-1, 2)
    pixels = np.concatenate([pixel[None], grid, [[camera.width / 2, camera.height / 2]]])
    distance = session.exact_hits(*session.sightlines.in_model(pixels)).distance
    hit = np.flatnonzero(np.isfinite(distance))
    if not len(hit):
        raise InputError(f"{where}.depth_share: no sightline meets the surface; must be depth_mm where none does")
    nearest = hit[np.argmin(np.linalg.norm(pixels[hit] - pixel, axis=1))]
    share = DEFAULT_DEPTH_SHARE if instrument.depth_share is None else instrument.depth_share
    return np.asarray(share * distance[nearest] * sightline)


@dataclass(frozen=True)
class Cover:
    """What instruments cover of a frame, on the rays through the pixels' centres.

    Parameters
    ----------
    instrument : ndarray of int, shape (H, W)
        Index in the scene's list of the instrument that is seen; -1 where the surface or nothing is.
    distance : ndarray, shape (H, W)
        Along the ray, mm.
    position, normal : ndarray, shape (H, W, 3)
        Camera frame, mm and unit; like `distance` they hold where an instrument is seen.
    """

    instrument: IntArray
    distance: Array
    position: Array
    normal: Array

    @property
    def seen(self) -> Mask:
        """Where an instrument is seen, shape (H, W)."""
        return np.asarray(self.instrument >= 0)

    @property
    def numbers(self) -> npt.NDArray[np.uint8]:
        """1 + the index, 0 where no instrument is seen, shape (H, W)."""
        return (self.instrument + 1).astype(np.uint8)

    def labels(self, labels: Labels) -> Labels:
        """Return the labels of a frame with those of the instruments over those of the surface."""
        seen, vector = self.seen, self.seen[..., None]
        normal = np.where(vector, self.normal, labels.normal).astype(np.float32)
        smooth = labels.normal_base is labels.normal
        unknown = {
            name: np.where(seen, np.float32(np.nan), getattr(labels, name))
            for name in ("k_min", "k_max", "k_min_base", "k_max_base")
        }
        return replace(
            labels,
            depth=np.where(seen, self.distance, labels.depth).astype(np.float32),
            position=np.where(vector, self.position, labels.position).astype(np.float32),
            normal=normal,
            geometric_normal=np.where(vector, self.normal, labels.geometric_normal).astype(np.float32),
            normal_base=normal if smooth else np.where(vector, self.normal, labels.normal_base).astype(np.float32),
            pool=labels.pool & ~seen,
            instance=np.where(seen, self.instrument + 1, labels.instance).astype(np.int32),
            face=np.where(seen, 0, labels.face).astype(np.int32),
            **unknown,
        )

    def truth(self, truth: TruthMaps, stride: int = 1) -> TruthMaps:
        """Return the truth of every `stride`-th pixel with that of the instruments over that of the surface."""
        own = Cover(*(values[::stride, ::stride] for values in vars(self).values()))
        seen, vector = own.seen, own.seen[..., None]
        of_normal = ("normal", "shading_normal", "geometric_normal", "normal_base")
        unknown = ("direction_min", "direction_max", "k_min", "k_max", "k_min_base", "k_max_base")
        maps: dict[str, Array] = {name: np.where(vector, own.normal, getattr(truth, name)) for name in of_normal}
        for name in unknown:
            values = getattr(truth, name)
            maps[name] = np.where(vector if values.ndim == 3 else seen, np.nan, values)
        return replace(
            truth,
            depth=np.where(seen, own.distance, truth.depth),
            position=np.where(vector, own.position, truth.position),
            pool=truth.pool & ~seen,
            mask=truth.mask | seen,
            instrument=own.numbers,
            **maps,
        )


def cover_of(session: "Session", kernel: InstrumentKernel, depth: Image) -> Cover:
    """Return what instruments cover of a frame whose surface is at `depth`, shape (H, W), mm; NaN: there is none."""
    camera = session.camera
    pixels = camera.pixel_centres().reshape(-1, 2)
    distance, normal, instrument = kernel.cast(*session.sightlines.in_view(pixels))
    # In single precision, as the frame decides.
    nearer = distance.astype(np.float32) < np.nan_to_num(np.ravel(depth), nan=np.inf).astype(np.float32)
    size = (camera.height, camera.width)
    reached = np.where(nearer, distance, np.nan)
    position = reached[:, None] * camera.unproject(pixels)
    normal = normal @ session.surface.model_from_camera[:3, :3]
    index = np.where(nearer, instrument, -1).reshape(size)
    return Cover(index, reached.reshape(size), position.reshape(*size, 3), normal.reshape(*size, 3))


def shade(session: "Session", kernel: InstrumentKernel, points: list[HighlightPoint]) -> list[HighlightPoint]:
    """Return highlight points of the surface; those are not lit that instruments hide or keep the light from."""
    if not points:
        return []
    positions = np.stack([point.position for point in points])
    hidden = _blocked(session, kernel, np.zeros(3), positions)
    shaded = np.zeros(len(points), dtype=bool)
    lights = np.array([point.light for point in points])
    for index, source in enumerate(session.scene.rig.true_mm()):
        own = lights == index
        if own.any() and not is_at_camera(source):
            shaded[own] = _blocked(session, kernel, source, positions[own])
    return [
        replace(point, lit=point.lit and not (behind or dark), hidden=bool(behind))
        for point, behind, dark in zip(points, hidden.tolist(), shaded.tolist(), strict=True)
    ]


def _blocked(session: "Session", kernel: InstrumentKernel, source: Array, positions: Array) -> Mask:
    """Return which positions, shape (N, 3), an instrument hides from a source, shape (3,), camera frame, mm."""
    towards = positions - source
    distance = np.linalg.norm(towards, axis=1)
    directions = towards / distance[:, None] @ session.surface.model_from_camera[:3, :3].T
    return np.asarray(kernel.cast(session.to_model(source[None]), directions)[0] < distance * (1 - ROUNDING))

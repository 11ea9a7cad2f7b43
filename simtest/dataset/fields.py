"""Images of a sample: what each holds, its unit, frame and sign, and how it is encoded.

Compression was chosen by measurement (docs/howto/datasets.md): PNG without a row filter for pictures, with one for the
smooth maps of 16 bits.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from io import BytesIO
from typing import Literal

import cv2
import numpy as np

from simtest.dataset.metadata import SampleMeta, has_debris, has_relief
from simtest.dataset.png import decode, encode
from simtest.runtime.arrays import AnyArray

DEPTH_LEVELS = 2**22 - 1
"""Steps from the camera to a sample's farthest point. Normals by differences of neighbouring depths are then right to
0.002 to 0.004 deg in the median, with 16 bits to 0.1 to 0.2 (docs/howto/datasets.md); float32 ends at 24 bits."""

CURVATURE_SCALE = 1e-4
"""1/mm; 16 bits then reach 3.2767 per mm, a radius of 0.3 mm."""

LEVELS = 65535
OFFSET = 32768


@dataclass(frozen=True)
class Codec:
    """How an image is held by a shard's member."""

    text: str  # how a reader without this package decodes it
    encode: Callable[[AnyArray], bytes]  # array to bytes
    decode: Callable[[bytes, SampleMeta], AnyArray]  # bytes and the sample's metadata to the array


@dataclass(frozen=True)
class Field:
    """One image of a sample."""

    # of the decoded array
    name: str
    suffix: str  # of the member in the shard, after the sample's key
    shape: str
    dtype: str
    unit: str
    meaning: str  # what it holds, with frame and sign
    codec: Codec  # how the member holds it
    # which samples store it: all, those with a relief, polyps, listed instruments or what covers tissue, or those of
    # datasets that ask for it, by a key of its name
    stored: Literal["always", "relief", "polyps", "instruments", "covered", "asked"] = "always"
    # what it is where that says no: the field of this name, or this number everywhere
    otherwise: str | int | None = None

    def is_required(self, meta: SampleMeta) -> bool:
        """Return whether a sample must store it, by its scene."""
        return {
            "always": True,
            "relief": has_relief(meta),
            "polyps": bool(meta.get("polyps")),
            "instruments": bool(meta["scene"].get("instruments")),
            # Datasets from before the map have captions without it.
            "covered": has_debris(meta),
            "asked": False,
        }[self.stored]


# Depth ---------------------------------------------------------------------------------------------------------------


def depth_scale_mm(depth: AnyArray) -> float:
    """Return the step, mm, in which a depth map, mm, is counted: by its farthest point, which has the last level."""
    return float(np.nanmax(depth, initial=0.0)) / DEPTH_LEVELS or 1.0


def _encode_depth(depth: AnyArray) -> bytes:
    # Adding one half makes the conversion to integers round; NaN becomes 0, no surface.
    counts = np.asarray(depth, dtype=float) / depth_scale_mm(depth) + 0.5
    octets = np.nan_to_num(counts, copy=False, nan=0.0).astype("<u4").view(np.uint8).reshape(*counts.shape, 4)
    return encode(np.concatenate([octets[..., k] for k in (2, 1, 0)]), "up")


def _decode_depth(data: bytes, meta: SampleMeta) -> AnyArray:
    # The high octets stand above the middle and the low ones; float32 holds their whole numbers exactly.
    high, middle, low = np.split(decode(data), 3)
    depth = high.astype(np.float32)
    for octets in (middle, low):
        depth *= 256
        depth += octets
    absent = depth == 0
    depth *= meta["depth_scale_mm"]
    np.copyto(depth, np.nan, where=absent)
    return depth


# Normals -------------------------------------------------------------------------------------------------------------


def encode_octahedral(normal: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Map unit vectors, shape (..., 3), to two coordinates in [-1, 1], each of shape (...); (0, 0, -1) to (0, 0).

    The octahedral map: (u, v) = (x, y) / (abs(x) + abs(y) + abs(z)); where z > 0,
    (u, v) = (1 - abs(v), 1 - abs(u)) times their signs. Camera-facing normals lie around the middle of the square.
    """
    x, y, z = (np.asarray(normal[..., k], dtype=np.float32) for k in range(3))
    scale = 1 / (np.abs(x) + np.abs(y) + np.abs(z))
    u, v = x * scale, y * scale
    _fold(u, v, z > 0)
    return u, v


def decode_octahedral(pair: AnyArray) -> AnyArray:
    """Map two coordinates in [-1, 1], shape (2, H, W), overwritten, back to unit vectors, shape (H, W, 3).

    NaN stays NaN.
    """
    u, v = pair
    z = np.abs(u)
    work = np.abs(v)
    z += work
    z -= 1
    # Where z > 0 the corners are folded back: 1 - abs(v) is abs(u) - z, and 1 - abs(u) is abs(v) - z.
    np.maximum(z, 0, out=work)
    u -= np.copysign(work, u)
    v -= np.copysign(work, v)
    np.multiply(z, z, out=work)
    for coordinate in (u, v):
        work += coordinate * coordinate
    np.sqrt(work, out=work)
    # Three times as fast as NumPy's stack.
    return np.asarray(cv2.merge([u / work, v / work, z / work]))


def _fold(u: AnyArray, v: AnyArray, outer: AnyArray) -> None:
    """Fold the corners of the square over where z > 0; changes its arguments."""
    # Few pixels see a surface turned so far from the optical axis.
    if outer.any():
        a, b = u[outer], v[outer]
        u[outer] = np.copysign(1 - np.abs(b), a)
        v[outer] = np.copysign(1 - np.abs(a), b)


NORMAL_LEVELS = 16383
"""14 bits for each of the two coordinates: errors of at most 0.015 deg, and files a third smaller than with 16 bits."""


def _encode_normal(normal: AnyArray) -> bytes:
    both = np.concatenate(encode_octahedral(normal), axis=0)
    # Levels count from 1; 0 stands for no surface.
    both *= (NORMAL_LEVELS - 1) / 2
    both += (NORMAL_LEVELS + 1) / 2 + 0.5
    return encode(np.nan_to_num(both, copy=False, nan=0.0).astype(np.uint16), "up")


ROWS_AT_ONCE = 64
"""Rows decoded together: their arrays then stay in the processor's cache, which halves the time."""


def _decode_normal(data: bytes, _: SampleMeta) -> AnyArray:
    # u stands above v
    counts = decode(data)
    height = len(counts) // 2
    counts = counts.reshape(2, height, -1)
    normal = np.empty((*counts.shape[1:], 3), np.float32)
    for first in range(0, height, ROWS_AT_ONCE):
        rows = counts[:, first : first + ROWS_AT_ONCE]
        pair = rows.astype(np.float32)
        pair -= (NORMAL_LEVELS + 1) / 2
        pair *= 2 / (NORMAL_LEVELS - 1)
        np.copyto(pair, np.nan, where=rows[0] == 0)
        normal[first : first + ROWS_AT_ONCE] = decode_octahedral(pair)
    return normal


# Curvature -----------------------------------------------------------------------------------------------------------


def _encode_curvature(curvature: AnyArray) -> bytes:
    # k_min above k_max
    both = np.concatenate([curvature[..., 0], curvature[..., 1]], axis=0, dtype=np.float32)
    both *= 1 / CURVATURE_SCALE
    both += OFFSET + 0.5
    # The ends stand for all curvatures beyond; 0 stays free for unknown.
    np.clip(both, 1, LEVELS, out=both)
    return encode(np.nan_to_num(both, copy=False, nan=0.0).astype(np.uint16), "up")


def _decode_curvature(data: bytes, _: SampleMeta) -> AnyArray:
    counts = decode(data)
    both = counts.astype(np.float32)
    both -= OFFSET
    both *= CURVATURE_SCALE
    np.copyto(both, np.nan, where=counts == 0)
    return np.asarray(cv2.merge(np.split(both, 2, axis=0)))


# Pictures and numbers ----------------------------------------------------------------------------------------------


def _encode_mask(mask: AnyArray) -> bytes:
    return encode(np.where(mask, np.uint8(255), np.uint8(0)), "none")


def _encode_numbers(numbers: AnyArray) -> bytes:
    if numbers.max(initial=0) > LEVELS:
        raise ValueError(f"{numbers.max()} highlights; 16 bits hold {LEVELS}")
    return encode(numbers.astype(np.uint16), "none")


def _encode_half(radiance: AnyArray) -> bytes:
    # Half precision ends at 65504; beyond it is infinity, which a picture must not hold.
    file = BytesIO()
    largest = float(np.finfo(np.float16).max)
    np.save(file, np.clip(radiance, 0, largest).astype(np.float16), allow_pickle=False)
    return file.getvalue()


PICTURE = Codec("8-bit PNG", lambda picture: encode(picture, "none"), lambda data, _: decode(data))
PART = replace(PICTURE, text="8-bit PNG, sRGB-encoded share of full scale, clipped")
MASK = Codec("8-bit PNG; 255: pool, 0: none", _encode_mask, lambda data, _: decode(data) > 0)
# PyTorch computes with few unsigned types.
NUMBERS = Codec("16-bit PNG", _encode_numbers, lambda data, _: decode(data).astype(np.int32))
HALF = Codec("NPY", _encode_half, lambda data, _: np.asarray(np.load(BytesIO(data), allow_pickle=False)))
DEPTHS = Codec(
    "8-bit PNG of 3 H rows: high above middle above low octets; (65536 high + 256 middle + low) times the sample's "
    "depth_scale_mm; 0: no surface",
    _encode_depth,
    _decode_depth,
)
OCTAHEDRAL = Codec(
    f"16-bit PNG of 2 H rows: u above v, each 2 (count - 1) / {NORMAL_LEVELS - 1} - 1; 0: no surface. "
    "z = abs(u) + abs(v) - 1; where z > 0, (u, v) = (1 - abs(v), 1 - abs(u)) times the signs of u and v; the normal is "
    "(u, v, z), made a unit vector",
    _encode_normal,
    _decode_normal,
)
CURVATURES = Codec(
    f"16-bit PNG of 2 H rows: k_min above k_max; k = (count - {OFFSET}) * {CURVATURE_SCALE:g}; 0: unknown; "
    f"1 and {LEVELS}: that or beyond",
    _encode_curvature,
    _decode_curvature,
)

INSTRUMENT, VISIBLE, POLYP, COVERING = "instrument", "visible", "polyp", "covering"
"""Fields of the pixels of instruments, of visible highlights, of polyps, and of what covers tissue."""

FIELDS = (
    Field("image", "image.png", "(H, W, 3)", "uint8", "sensor counts",
          "the sensor's frame, R G B: as its response and bits encode it, or sRGB-encoded where it has neither",
          PICTURE),
    Field("depth", "depth.png", "(H, W)", "float32", "mm",
          "distance from the camera centre along the pixel's ray (not z); NaN where there is no surface",
          DEPTHS),
    Field("normal", "normal.png", "(H, W, 3)", "float32", "1",
          "unit normal of the fine surface, camera frame (x right, y down, z forward); without a relief it faces the "
          "camera: N . ray < 0; NaN off the surface", OCTAHEDRAL),
    Field("curvature", "curvature.png", "(H, W, 2)", "float32", "1/mm",
          "principal curvatures k_min <= k_max of the fine surface, convex towards the camera positive; NaN where "
          "unknown", CURVATURES),
    Field("normal_base", "normal_base.png", "(H, W, 3)", "float32", "1",
          "unit normal of the base, without the relief, facing the camera; stored where there is a relief, elsewhere "
          "it is normal", OCTAHEDRAL, "relief", "normal"),
    Field("curvature_base", "curvature_base.png", "(H, W, 2)", "float32", "1/mm",
          "curvature of the base; stored where there is a relief, elsewhere it is curvature", CURVATURES, "relief",
          "curvature"),
    Field("pool", "pool.png", "(H, W)", "bool", "1",
          "where the liquid film fills a valley; stored where there is a relief, elsewhere it is false everywhere",
          MASK, "relief", 0),
    Field("specular", "specular.png", "(H, W, 3)", "uint8", "full scale",
          "direct light off the specular lobe, before lens and noise", PART),
    Field("diffuse", "diffuse.png", "(H, W, 3)", "uint8", "full scale",
          "direct light off the diffuse base, before lens and noise", PART),
    Field("indirect", "indirect.png", "(H, W, 3)", "uint8", "full scale",
          "light of more than one bounce, before lens and noise", PART),
    Field("instance", "instance.png", "(H, W)", "int32", "1",
          "0, or 1 + the index in the list highlights of the isolated highlight whose region this is: the connected "
          "pixels whose direct light off the lobe (specular, before it is clipped) is at least half of its peak. Where "
          "no pixel reaches that, as where it is smaller than one, there are none, and its entry in highlights says "
          "so (region)",
          NUMBERS),
    Field(VISIBLE, "visible.png", "(H, W)", "int32", "1",
          "0, or 1 + the index in the list visible_highlights of the visible highlight whose pixel this is: above half "
          "of its lobe's peak in the noise-free frame; only in datasets that keep it", NUMBERS, "asked"),
    Field(INSTRUMENT, "instrument.png", "(H, W)", "uint8", "1",
          "0, or 1 + the index in the scene's instruments of the metal instrument that is seen: depth and normals "
          "are its own there, curvature is NaN; stored where the scene lists instruments, elsewhere it is 0 everywhere",
          PICTURE, "instruments", 0),
    Field(POLYP, "polyp.png", "(H, W)", "uint8", "1",
          "0, or 1 + the index in the list polyps of the polyp that is seen: where it raises the wall by more than a "
          "tenth of its height; stored where the anatomy has polyps, elsewhere it is 0 everywhere",
          PICTURE, "polyps", 0),
    Field(COVERING, "covering.png", "(H, W)", "uint8", "1",
          "what covers the tissue: 1 stool, 2 bile, 3 text, boxes and insets, 0 nothing; stored where a scene has any",
          PICTURE, "covered", 0),
    Field("radiance", "radiance.npy", "(H, W, 3)", "float16", "full scale",
          "linear radiance before lens and noise, share of full scale; only in datasets that keep it", HALF, "asked"),
)  # fmt: skip
"""All fields, in the order of the members."""

BY_NAME = {field.name: field for field in FIELDS}
BY_SUFFIX = {field.suffix: field for field in FIELDS}

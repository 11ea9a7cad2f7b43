"""The images of a sample: what each holds, its unit, frame and sign, and how it is written.

Compression was chosen by measurement (docs/datasets.md): PNG without a row filter and with Huffman codes alone for the
noisy picture, with a row filter and the fastest deflate for the smooth maps.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

DEPTH_SCALES_MM = tuple(0.005 * 2**k for k in range(12))
"""A sample's depth is counted in the first of these with which its farthest point fits 16 bits."""

CURVATURE_SCALE = 1e-4
"""1/mm; 16 bits then reach 3.2767 per mm, a radius of 0.3 mm."""

LEVELS = 65535
OFFSET = 32768

_NOISY = [
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
]  # fmt: skip
_SMOOTH = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
_FLAT = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]


@dataclass(frozen=True)
class Field:
    """One image of a sample.

    Parameters
    ----------
    name : str
        Of the decoded array.
    suffix : str
        Of the member in the shard, after the sample's key.
    shape, dtype, unit : str
        Of the decoded array.
    meaning : str
        What it holds, with frame and sign.
    encoding : str
        How a reader without this package decodes it.
    encode : callable
        Array to bytes.
    decode : callable
        Bytes and the sample's metadata to the array.
    """

    name: str
    suffix: str
    shape: str
    dtype: str
    unit: str
    meaning: str
    encoding: str
    encode: Callable[[Array], bytes]
    decode: Callable[[bytes, dict[str, Any]], Array]

    def describe(self) -> dict[str, str]:
        """Give the entry of the field dictionary."""
        keys = ("name", "shape", "dtype", "unit", "meaning", "encoding")
        return {"member": f"KEY.{self.suffix}", **{key: getattr(self, key) for key in keys}}


def _png(image: Array, options: list[int]) -> bytes:
    ok, encoded = cv2.imencode(".png", image if image.ndim == 2 else image[:, :, ::-1], options)
    assert ok
    return encoded.tobytes()


def _pixels(data: bytes) -> Array:
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("no PNG")
    return np.asarray(image if image.ndim == 2 else image[:, :, ::-1])


# Depth ---------------------------------------------------------------------------------------------------------------


def depth_scale_mm(depth: Array) -> float:
    """Give the unit that a depth map, mm, is counted in; raise `ValueError` where it reaches too far for 16 bits."""
    largest = float(np.nanmax(depth, initial=0.0))
    for scale in DEPTH_SCALES_MM:
        if largest <= scale * LEVELS:
            return scale
    raise ValueError(f"depth reaches {largest:g} mm; 16 bits hold {DEPTH_SCALES_MM[-1] * LEVELS:g} mm at most")


def _encode_depth(depth: Array) -> bytes:
    counts = np.rint(np.nan_to_num(depth, nan=0.0) / depth_scale_mm(depth)).astype(np.uint16)
    return _png(counts, _SMOOTH)


def _decode_depth(data: bytes, meta: dict[str, Any]) -> Array:
    counts = _pixels(data)
    depth = counts * np.float32(meta["depth_scale_mm"])
    depth[counts == 0] = np.nan
    return depth


# Normals -------------------------------------------------------------------------------------------------------------


def encode_octahedral(normal: Array) -> Array:
    """Give unit vectors, shape (..., 3), as points of the unit square, shape (..., 2): (0.5, 0.5) is (0, 0, -1).

    The octahedral map: v = (x, y) / (abs(x) + abs(y) + abs(z)); where z > 0, v = (1 - abs(v_y, v_x)) sign(v). Then
    (v + 1) / 2. Camera-facing normals lie about the square's middle.
    """
    n = normal / np.sum(np.abs(normal), axis=-1, keepdims=True)
    v = n[..., :2]
    folded = (1 - np.abs(v[..., ::-1])) * np.where(v >= 0, 1, -1)
    return np.asarray((np.where(n[..., 2:] > 0, folded, v) + 1) / 2)


def decode_octahedral(square: Array) -> Array:
    """Give the unit vectors, shape (..., 3), of points of the unit square, shape (..., 2)."""
    v = 2 * square - 1
    z = np.abs(v).sum(axis=-1, keepdims=True) - 1
    folded = (1 - np.abs(v[..., ::-1])) * np.where(v >= 0, 1, -1)
    n = np.concatenate([np.where(z > 0, folded, v), z], axis=-1)
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


NORMAL_LEVELS = 16383
"""14 bits for each of the two coordinates: 0.015 deg at most, and a third smaller than 16 bits."""


def _encode_normal(normal: Array) -> bytes:
    counts = 1 + np.rint(encode_octahedral(normal) * (NORMAL_LEVELS - 1))
    counts = np.where(np.isfinite(counts), counts, 0).astype(np.uint16)
    return _png(np.concatenate([counts[..., 0], counts[..., 1]], axis=0), _SMOOTH)


def _decode_normal(data: bytes, _: dict[str, Any]) -> Array:
    first, second = np.split(_pixels(data), 2, axis=0)
    counts = np.stack([first, second], axis=-1).astype(np.float32)
    normal = decode_octahedral((counts - 1) / np.float32(NORMAL_LEVELS - 1)).astype(np.float32)
    normal[counts[..., 0] == 0] = np.nan
    return normal


# Curvature -----------------------------------------------------------------------------------------------------------


def _encode_curvature(curvature: Array) -> bytes:
    counts = np.clip(np.rint(curvature / CURVATURE_SCALE) + OFFSET, 1, LEVELS)
    counts = np.where(np.isfinite(counts), counts, 0).astype(np.uint16)
    return _png(np.concatenate([counts[..., 0], counts[..., 1]], axis=0), _SMOOTH)


def _decode_curvature(data: bytes, _: dict[str, Any]) -> Array:
    first, second = np.split(_pixels(data), 2, axis=0)
    counts = np.stack([first, second], axis=-1)
    curvature = (counts.astype(np.float32) - OFFSET) * np.float32(CURVATURE_SCALE)
    curvature[counts == 0] = np.nan
    return curvature


# Pictures ------------------------------------------------------------------------------------------------------------


def _plain(options: list[int]) -> tuple[Callable[[Array], bytes], Callable[[bytes, dict[str, Any]], Array]]:
    return lambda image: _png(image, options), lambda data, _: _pixels(data)


def _encode_half(radiance: Array) -> bytes:
    from io import BytesIO

    file = BytesIO()
    largest = float(np.finfo(np.float16).max)
    np.save(file, np.clip(radiance, 0, largest).astype(np.float16), allow_pickle=False)
    return file.getvalue()


def _decode_half(data: bytes, _: dict[str, Any]) -> Array:
    from io import BytesIO

    return np.asarray(np.load(BytesIO(data), allow_pickle=False))


_PART = "8-bit PNG, sRGB-encoded share of full scale, clipped"
_OCTAHEDRAL = (
    f"16-bit PNG of 2 H rows: u above v. 0: no surface. p = 2 (count - 1) / {NORMAL_LEVELS - 1} - 1 for both, "
    "z = abs(p_u) + abs(p_v) - 1; where z > 0, p = (1 - abs(p_v, p_u)) sign(p_u, p_v); the normal is (p_u, p_v, z), "
    "made a unit vector"
)
_CURVATURE = (
    f"16-bit PNG of 2 H rows: k_min above k_max; k = (count - {OFFSET}) * {CURVATURE_SCALE:g}; 0: unknown; "
    f"1 and {LEVELS}: that or beyond"
)

FIELDS = (
    Field("image", "image.png", "(H, W, 3)", "uint8", "sensor counts",
          "the sensor's frame, R G B, as its response encodes it", "8-bit PNG", *_plain(_NOISY)),
    Field("depth", "depth.png", "(H, W)", "float32", "mm",
          "distance from the camera centre along the pixel's ray (not z); NaN where there is no surface",
          "16-bit PNG; count times the sample's depth_scale_mm; 0: no surface", _encode_depth, _decode_depth),
    Field("normal", "normal.png", "(H, W, 3)", "float32", "1",
          "unit normal, camera frame (x right, y down, z forward), facing the camera: N . ray < 0; NaN off the surface",
          _OCTAHEDRAL, _encode_normal, _decode_normal),
    Field("curvature", "curvature.png", "(H, W, 2)", "float32", "1/mm",
          "principal curvatures k_min <= k_max, convex towards the camera positive; NaN where unknown",
          _CURVATURE, _encode_curvature, _decode_curvature),
    Field("specular", "specular.png", "(H, W, 3)", "uint8", "full scale",
          "direct light off the specular lobe, before lens and noise", _PART, *_plain(_FLAT)),
    Field("diffuse", "diffuse.png", "(H, W, 3)", "uint8", "full scale",
          "direct light off the diffuse base, before lens and noise", _PART, *_plain(_FLAT)),
    Field("indirect", "indirect.png", "(H, W, 3)", "uint8", "full scale",
          "light of more than one bounce, before lens and noise", _PART, *_plain(_FLAT)),
    Field("instance", "instance.png", "(H, W)", "uint8", "1",
          "0, or 1 + the place in the list highlights of the isolated highlight whose region at half height this is",
          "8-bit PNG", *_plain(_FLAT)),
    Field("radiance", "radiance.npy", "(H, W, 3)", "float16", "full scale",
          "linear radiance before lens and noise, share of full scale; only in datasets that keep it",
          "NPY", _encode_half, _decode_half),
)  # fmt: skip
"""All fields, in the order of the members."""

BY_NAME = {field.name: field for field in FIELDS}
BY_SUFFIX = {field.suffix: field for field in FIELDS}

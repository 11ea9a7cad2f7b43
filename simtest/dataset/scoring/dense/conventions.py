"""What the values of maps mean, by option or by default, and a warning where the truth says otherwise.

Axes are written as the camera's own axis (x right, y down, z forward) that each channel holds, with its sign:
"x,-y,-z" says that red holds x, green holds -y (up) and blue holds -z (towards the camera).
"""

from dataclasses import dataclass, field

import numpy as np

from simtest.dataset.scoring.dense.depth import KINDS, LEAST_PIXELS, DepthKind, depth_factor, spread
from simtest.dataset.scoring.dense.frame_truth import FrameTruth
from simtest.dataset.scoring.dense.map_files import (
    ENCODINGS,
    Encoding,
    RawMap,
    channel_vectors,
    decode_depth,
    length_error,
)
from simtest.errors import InputError
from simtest.geometry.axes import ALL, NAMED, described, matrix
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject

FRAME = "opencv"
DEPTH: DepthKind = "z"
"""Defaults; that of the encoding is "unit" for integers and "components" for others."""

MOST_PIXELS = 20_000
"""Of a frame, by which maps are compared with the truth, evenly spread."""

LONG = 0.1
"""Vectors whose length is off by more than this in the mean are no unit vectors."""

BETTER_COSINE, BETTER_SPREAD = 0.05, 0.9
"""Other axes are told that fit by so much more in the mean cosine, and the other kind of depths that leaves less than
such a share of the spread."""

_MATRICES = np.stack([matrix(axes) for axes in ALL])


@dataclass(frozen=True)
class MapOptions:
    """What a user states of the maps; None: the default.

    Parameters
    ----------
    name : str, optional
        Of the method, on the page.
    encoding : str, optional
        One of `ENCODINGS`; default "unit" for integers, "components" for others.
    frame : str, optional
        Axes of the channels: opencv (default), opengl, directx, or such as "x,-y,-z".
    depth : str, optional
        "z" (default) or "ray".
    unit_mm : float, optional
        mm of one unit of the depths; integers need it, for others 1.
    """

    name: str | None = None
    encoding: str | None = None
    frame: str | None = None
    depth: str | None = None
    unit_mm: float | None = None

    def check(self) -> None:
        """Raise `InputError` for what is not allowed."""
        if self.encoding is not None and self.encoding not in ENCODINGS:
            raise InputError(f"--encoding {self.encoding}: unknown; allowed: {', '.join(ENCODINGS)}")
        if self.frame is not None:
            parse_axes(self.frame)
        if self.depth is not None and self.depth not in KINDS:
            raise InputError(f"--depth {self.depth}: unknown; allowed: {', '.join(KINDS)}")
        if self.unit_mm is not None and not 1e-9 <= self.unit_mm <= 1e6:
            raise InputError(f"--unit-mm {self.unit_mm:g}: must be 1e-9 to 1e6 mm")

    @property
    def axes(self) -> str:
        """The axes of the channels."""
        return parse_axes(self.frame or FRAME)

    @property
    def along(self) -> DepthKind:
        """The kind of depths."""
        return next((kind for kind in KINDS if kind == self.depth), DEPTH)

    def encoding_of(self, raw: RawMap) -> Encoding:
        """Return how a normal map holds its components."""
        default: Encoding = "unit" if raw.is_encoded else "components"
        return next((name for name in ENCODINGS if name == self.encoding), default)

    def normals(self, raw: RawMap) -> Array:
        """Return the unit normals of a map, camera frame, shape (H, W, 3); NaN where there is no answer."""
        return to_camera(unit(channel_vectors(raw, self.encoding_of(raw))), self.axes)


@dataclass(frozen=True)
class Answer:
    """What a method answers for a frame: maps as their files hold them."""

    normal: RawMap | None = None
    depth: RawMap | None = None


@dataclass
class Fit:
    """How well the maps of all frames fit the truth as they are read, and read otherwise."""

    options: MapOptions
    encoding: Encoding | None = None
    lengths: list[float] = field(default_factory=list)
    """Mean error of the vectors' length, a frame."""
    correlation: Array = field(default_factory=lambda: np.zeros((3, 3)))
    """Sum over the pixels of true normals times channel vectors."""
    pixels: int = 0
    spreads: dict[DepthKind, list[float]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    """Spread of the depths' relative errors after an affine alignment, a frame: a shift would hide the kind."""

    def add(self, truth: FrameTruth, answer: Answer) -> None:
        """Add a frame's maps."""
        chosen = np.flatnonzero(truth.scored)
        chosen = chosen[:: max(1, len(chosen) // MOST_PIXELS)]
        if answer.normal is not None:
            self.encoding = self.options.encoding_of(answer.normal)
            vectors = channel_vectors(answer.normal, self.encoding).reshape(-1, 3)[chosen]
            # A frame without an answer says nothing.
            if np.isfinite(off := length_error(vectors)):
                self.lengths.append(off)
            vectors = unit(vectors)
            known = np.isfinite(vectors).all(axis=1)
            self.correlation += truth.normal["base"].reshape(-1, 3)[chosen][known].T @ vectors[known]
            self.pixels += int(known.sum())
        if answer.depth is not None:
            depth = decode_depth(answer.depth, self.options.unit_mm).ravel()[chosen]
            for kind in KINDS:
                true = (truth.distance * depth_factor(truth.camera, kind)).ravel()[chosen]
                known = np.isfinite(depth) & np.isfinite(true)
                if known.sum() >= LEAST_PIXELS:
                    self.spreads[kind].append(spread(depth[known], true[known]))

    @property
    def cosines(self) -> Array:
        """Mean cosine with the truth of each of the 48 assignments of axes, shape (48,): signed sums of one matrix."""
        return np.asarray(np.einsum("kij,ij->k", _MATRICES, self.correlation) / max(self.pixels, 1))

    def lines(self) -> list[str]:
        """Return what is told of the conventions, a line each; what the truth contradicts begins with "warning:"."""
        told, options = [], self.options
        if self.encoding is not None:
            how = "as stated" if options.encoding else "by default"
            told.append(f"normals: encoding {self.encoding} ({ENCODINGS[self.encoding]}), {how}")
            how = "as stated" if options.frame else "by default"
            axes, cosines = options.axes, self.cosines
            own, best = float(cosines[ALL.index(axes)]), int(np.argmax(cosines))
            told.append(f"normals: channels hold {described(axes)}, {how}; mean cosine with the truth {own:.4f}")
            if not self.pixels:
                told.append("warning: normals: no pixel holds a direction; all count as unanswered")
            elif cosines[best] > own + BETTER_COSINE:
                told.append(
                    f"warning: normals fit the truth better with --frame {ALL[best]}: mean cosine {cosines[best]:.4f}"
                )
            if self.lengths and (off := float(np.mean(self.lengths))) > LONG:
                told.append(
                    f"warning: normals: vectors are off from length 1 by {off:.2g} in the mean, and only their "
                    "direction counts; --encoding says how they are held"
                )
        if self.spreads[options.along]:
            along = {"z": "the axis (z)", "ray": "the ray"}
            told.append(f"depths: along {along[options.along]}, {'as stated' if options.depth else 'by default'}")
            own, other = (self._spread(kind) for kind in sorted(KINDS, key=lambda kind: kind != options.along))
            if other < BETTER_SPREAD * own:
                (name,) = (kind for kind in KINDS if kind != options.along)
                told.append(
                    f"warning: depths fit the truth better along {along[name]}, --depth {name}: the spread that an "
                    f"affine alignment leaves is {other:.3g} instead of {own:.3g}"
                )
        return told

    def _spread(self, kind: DepthKind) -> float:
        return float(np.mean(self.spreads[kind]))

    def to_json(self) -> JsonObject:
        """Return the conventions, whether the user said so, and how well they fit."""
        held: JsonObject = {}
        options, cosines = self.options, self.cosines
        if self.encoding is not None:
            best = int(np.argmax(cosines))
            held["normals"] = {
                "encoding": self.encoding, "encoding_stated": options.encoding is not None,
                "axes": options.axes, "axes_stated": options.frame is not None,
                "mean_cosine": float(cosines[ALL.index(options.axes)]),
                "best_axes": ALL[best], "best_mean_cosine": float(cosines[best]),
                "length_error": float(np.mean(self.lengths)) if self.lengths else None,
            }  # fmt: skip
        if self.spreads[options.along]:
            held["depths"] = {
                "along": options.along, "along_stated": options.depth is not None,
                "unit_mm": 1.0 if options.unit_mm is None else options.unit_mm,
                "unit_stated": options.unit_mm is not None,
                **{f"spread_{kind}": self._spread(kind) for kind in KINDS},
            }  # fmt: skip
        return held


def parse_axes(text: str) -> str:
    """Return axes such as "x,-y,-z" from these or their name; raise `InputError` for others."""
    axes = NAMED.get(text.strip().lower(), text.replace(" ", "").replace("+", "").lower())
    if axes not in ALL:
        raise InputError(
            f"--frame {text}: unknown; allowed: {', '.join(NAMED)}, or the axes of the three channels, such as x,-y,-z"
        )
    return axes


def to_camera(vectors: Array, axes: str) -> Array:
    """Return channel vectors, shape (..., 3), in the camera frame."""
    return vectors @ matrix(axes).T


def unit(vectors: Array, least: float = 1e-3) -> Array:
    """Return unit vectors, shape (..., 3); NaN where the length is below `least` or not finite."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isfinite(length) & (length >= least), vectors / length, np.nan)

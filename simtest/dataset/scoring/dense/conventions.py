"""What the values of maps mean: stated by options, or found out over all frames together, and told either way."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from simtest.dataset.scoring.dense.axes import AxesEvidence, parse_axes, to_camera, unit
from simtest.dataset.scoring.dense.depth import KINDS, DepthEvidence, DepthKind, depth_factor
from simtest.dataset.scoring.dense.frame_truth import FrameTruth
from simtest.dataset.scoring.dense.map_files import (
    ENCODINGS,
    Encoding,
    RawMap,
    candidates,
    channel_vectors,
    decode_depth,
    length_error,
)
from simtest.errors import InputError
from simtest.geometry.axes import described
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject

MOST_PIXELS = 20_000
"""Of a frame, by which conventions are found out, evenly spread."""

LONG = 0.1
"""Vectors whose length is off by more than this in the mean are no unit vectors."""


@dataclass(frozen=True)
class MapOptions:
    """What a user states of the maps; None: to be found out, or the default.

    Parameters
    ----------
    name : str, optional
        Of the method, on the page.
    encoding : str, optional
        One of `ENCODINGS`.
    frame : str, optional
        Axes of the channels: opencv, opengl, directx, or such as "x,-y,-z".
    depth : str, optional
        "z" or "ray".
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


@dataclass(frozen=True)
class Answer:
    """What a method answers for a frame: maps as their files hold them."""

    normal: RawMap | None = None
    depth: RawMap | None = None


@dataclass(frozen=True)
class Conventions:
    """How the maps of all frames are read."""

    encoding: Encoding
    axes: str
    depth: DepthKind

    def normals(self, raw: RawMap) -> Array:
        """Return the unit normals of a map, camera frame, shape (H, W, 3); NaN where there is no answer."""
        return to_camera(unit(channel_vectors(raw, self.encoding)), self.axes)


@dataclass
class Evidence:
    """What the frames so far say about the conventions that nobody stated."""

    options: MapOptions
    lengths: dict[Encoding, list[float]] = field(default_factory=dict)
    axes: dict[Encoding, AxesEvidence] = field(default_factory=dict)
    depth: DepthEvidence = field(default_factory=DepthEvidence)

    def add(self, truth: FrameTruth, answer: Answer) -> None:
        """Add a frame's maps."""
        chosen = np.flatnonzero(truth.scored)
        chosen = chosen[:: max(1, len(chosen) // MOST_PIXELS)]
        if answer.normal is not None:
            self._add_normals(answer.normal, truth.normal["base"].reshape(-1, 3)[chosen], chosen)
        if answer.depth is not None:
            depth = decode_depth(answer.depth, self.options.unit_mm).ravel()[chosen]
            known = np.isfinite(depth)
            factors = {kind: depth_factor(truth.camera, kind).ravel()[chosen][known] for kind in KINDS}
            self.depth.add(depth[known], truth.distance.ravel()[chosen][known], factors)

    def _add_normals(self, raw: RawMap, normal: Array, chosen: "np.typing.NDArray[np.intp]") -> None:
        for encoding in (self._stated,) if self._stated else candidates(raw):
            vectors = channel_vectors(raw, encoding).reshape(-1, 3)[chosen]
            # A frame without an answer says nothing.
            if np.isfinite(off := length_error(vectors)):
                self.lengths.setdefault(encoding, []).append(off)
            vectors = unit(vectors)
            known = np.isfinite(vectors).all(axis=1)
            self.axes.setdefault(encoding, AxesEvidence()).add(vectors[known], normal[known])

    @property
    def _stated(self) -> Encoding | None:
        return next((name for name in ENCODINGS if name == self.options.encoding), None)

    @property
    def encoding(self) -> Encoding:
        """The encoding stated, or whose vectors are nearest to length 1; the first where several are."""
        means = {name: float(np.mean(own)) for name, own in self.lengths.items()}
        if (stated := self._stated) is not None:
            return stated
        return min(means, key=lambda name: means[name]) if means else "unit"

    def provisional(self) -> Conventions:
        """Return the conventions that fit the frames so far, clear or not."""
        options, encoding = self.options, self.encoding
        axes = parse_axes(options.frame) if options.frame else self.axes.get(encoding, AxesEvidence()).best
        depth = next((kind for kind in KINDS if kind == options.depth), self.depth.best)
        return Conventions(encoding, axes, depth)

    def decide(self, what: str) -> Conventions:
        """Return the conventions of all frames; raise `InputError` where they are not clear. `what` names the maps."""
        encoding, found = self.encoding, self.provisional()
        axes = self.axes.get(encoding)
        if axes is not None and self.options.frame is None:
            found = Conventions(encoding, axes.decide(what), found.depth)
        if self.has_depths and self.options.depth is None:
            found = Conventions(found.encoding, found.axes, self.depth.decide(what))
        return found

    @property
    def has_depths(self) -> bool:
        """Whether any frame has depths."""
        return bool(self.depth.spreads[KINDS[0]])

    def lines(self, chosen: Conventions) -> list[str]:
        """Return what is told of the conventions, a line each."""
        told, axes = [], self.axes.get(chosen.encoding)
        if axes is not None and axes.cosines:
            how = "as stated" if self.options.frame else _how_clear(axes.to_json())
            told.append(f"normals: channels hold {described(chosen.axes)}, {how}")
            how = "as stated" if self.options.encoding else "found out by the length of the vectors"
            told.append(f"normals: encoding {chosen.encoding} ({ENCODINGS[chosen.encoding]}), {how}")
            off = float(np.mean(self.lengths[chosen.encoding]))
            if off > LONG:
                told.append(
                    f"normals: vectors are off from length 1 by {off:.2g} in the mean; only their direction counts"
                )
        if self.has_depths:
            how = "as stated" if self.options.depth else (
                "found out: spread of what an affine alignment leaves " + ", ".join(
                    f"{value:.3g} along the {'axis' if kind == 'spread_z' else 'ray'}"
                    for kind, value in self.depth.to_json().items()))  # fmt: skip
            told.append(f"depths: along the {'axis (z)' if chosen.depth == 'z' else 'ray'}, {how}")
        return told

    def to_json(self, chosen: Conventions) -> JsonObject:
        """Return the conventions, who said so, and the evidence."""
        held: JsonObject = {}
        axes = self.axes.get(chosen.encoding)
        if axes is not None and axes.cosines:
            held["normals"] = {
                "encoding": chosen.encoding, "encoding_stated": self.options.encoding is not None,
                "axes": chosen.axes, "axes_stated": self.options.frame is not None, "evidence": axes.to_json(),
                "length_error": float(np.mean(self.lengths[chosen.encoding])),
            }  # fmt: skip
        if self.has_depths:
            held["depths"] = {
                "along": chosen.depth, "along_stated": self.options.depth is not None,
                "unit_mm": 1.0 if self.options.unit_mm is None else self.options.unit_mm,
                "unit_stated": self.options.unit_mm is not None, "evidence": self.depth.to_json(),
            }  # fmt: skip
        return held


def _how_clear(found: Mapping[str, float | str]) -> str:
    return (
        f"found out: mean cosine with the truth {found['mean_cosine']:.4f}, {found['difference']:.2g} above "
        f"{described(str(found['next']))}"
    )

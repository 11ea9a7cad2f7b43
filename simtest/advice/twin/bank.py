"""The bank of one picture: rendered frames as its camera may have taken them, and the scored highlights in them."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.advice.twin.scenes import SceneDraws, make_pool
from simtest.advice.twin.scoring import ScoredSpot, score
from simtest.errors import SimtestError
from simtest.reconstruction.records import Specularities
from simtest.rendering import Session
from simtest.rendering.backend import colour_variant
from simtest.runtime.arrays import Array, Image, Mask, Picture, only_reading
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.sensor import luma

USUAL_PX = 640 * 480
FRAMES, FEWEST_FRAMES = 48, 12
"""Frames of a bank for a picture of so many pixels or fewer, and of a large one: their time goes with the pixels."""

FRAMES_PER_PATCH = 2
"""Views of a patch, at least: another patch is another mesh."""

Reconstructs = Callable[[Image], Specularities]
"""The reconstruction of a picture, as encoded, with what the user told."""

Progress = Callable[[int, int, str], None]
"""Called with what is done, how much there is, and what is done now; may raise to stop."""


@dataclass(frozen=True)
class BankFrame:
    """A rendered frame of the bank, as encoded, and the usable highlights in it."""

    picture: Picture
    spots: list[ScoredSpot]


def frames_for(pixels: int) -> int:
    """Return how many frames the bank of a picture of so many pixels has."""
    return int(np.clip(FRAMES * USUAL_PX / max(pixels, 1), FEWEST_FRAMES, FRAMES))


@dataclass(frozen=True)
class Subject:
    """A real picture that a bank is rendered for."""

    draws: SceneDraws
    pixels: Array  # shape (N, 2), peaks of its highlights, px: the patches stand where they are
    seen: Mask | None = None  # pixels of its view; twins are black outside of it too
    grey: bool = False  # it has no colours: twins are their luma then


def make_bank(
    subjects: Sequence[Subject],
    reconstructs: Reconstructs,
    count: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[BankFrame]:
    """Render a bank of `count` frames, and score it by the reconstruction of the real picture.

    Several subjects, of one camera, rig and organ, take turns.
    """
    frames: list[BankFrame] = []
    pool = make_pool(tissue=subjects[0].draws.tissue)
    # Frames of one patch come one after the other, since its kernels and its mesh then stay.
    used = min(len(pool), max(count // FRAMES_PER_PATCH, 1))
    order = (np.sort(np.arange(count) % used) + seed) % len(pool)
    # Even shares of the distances, in any order.
    shares = (from_integer(seed).permutation(count) + 0.5) / count
    session, at = None, -1
    for number, first in enumerate(order.tolist()):
        rng, subject = from_integer(seed * 100_003 + number), subjects[number % len(subjects)]
        # A patch that bends around a camera so far away has no view: another one then.
        tried = ((first + step) % len(pool) for step in range(len(pool)))
        share = float(shares[number])
        drawn = ((patch, subject.draws.draw(rng, pool[patch], subject.pixels, share)) for patch in tried)
        patch, scene = next(((patch, scene) for patch, scene in drawn if scene is not None), (at, None))
        if scene is not None:
            try:
                # Each frame has a relief of its own, tens of megabytes: none is kept in the user's cache.
                with warnings.catch_warnings(), only_reading("relief"):
                    warnings.simplefilter("ignore")
                    session = session if session is not None and patch == at else Session(scene, colour_variant())
                    at = patch
                    view = render_view(session, scene)
                    frames.append(_scored_frame(session, view, reconstructs, subject))
            except SimtestError:
                # Such as a camera or a light that a drawn view puts inside the tissue: it gives no frame.
                session = None
        if progress:
            progress(number + 1, count, "rendering twins")
    return frames


def _scored_frame(session: Session, view: RenderedView, reconstructs: Reconstructs, subject: Subject) -> BankFrame:
    """Take one picture of a rendered view, reconstruct and score it."""
    picture = view.frame(view.scene.sensor.seed)
    if subject.grey:
        picture = luma(picture)
    if (seen := subject.seen) is not None:
        picture = np.where(seen if picture.ndim == 2 else seen[..., None], picture, np.float32(0))
    spots = score(session, view, reconstructs(picture))
    return BankFrame(np.asarray(np.rint(255 * np.clip(picture, 0, 1)), dtype=np.uint8), spots)


def all_spots(bank: Sequence[BankFrame]) -> list[tuple[int, ScoredSpot]]:
    """Return all scored highlights of a bank with the number of their frame."""
    return [(number, spot) for number, frame in enumerate(bank) for spot in frame.spots]

"""How well a stated field of view alone holds the lenses of wide endoscopes.

    python -m studies.wide_fov

Over a round view of 480 px, the lens is drawn for each kind about the stated field of view: its own field with
`FOCAL_SD`, its centre with `CENTRE_SD_SHARE` of the picture's width. Where it sees a pixel, against where the guess of
`--fov DEG --fov-of view` sees it: share of draws in the 95 % region of the normal by the camera alone, and the radius
of that region, sqrt of the product of its half axes, deg, by the share of the view's radius. A field that a kind cannot
span (an orthographic lens 180 deg) is drawn again.
"""

import argparse

import numpy as np

from simtest.estimators.prior_parts import camera_part
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, ViewMask
from simtest.geometry.vectors import tangent_coordinates
from simtest.reconstruction.assumptions import CENTRE_SD_SHARE, FOCAL_SD, calibration_of_round_view
from simtest.runtime import chi_squared

FIELDS_DEG = (60.0, 90.0, 120.0, 140.0, 160.0, 170.0)
SHARES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
WIDTH, HEIGHT, RADIUS_PX = 640, 480, 240.0

KINDS = {
    "equidistant": (lambda angle: angle, lambda r: r, np.pi),
    "equisolid": (lambda angle: 2 * np.sin(angle / 2), lambda r: 2 * np.arcsin(r / 2), np.pi),
    "stereographic": (lambda angle: 2 * np.tan(angle / 2), lambda r: 2 * np.arctan(r / 2), np.pi),
    "orthographic": (np.sin, np.arcsin, np.pi / 2),
    "pinhole": (np.tan, np.arctan, np.pi / 2),
}
"""Image radius over the focal length by the angle from the axis, its inverse, and the largest angle."""


def seen_at(kind: str, fov_deg: float, pixels: Array, rng: np.random.Generator) -> Array:
    """Return the directions that drawn lenses of a kind see at pixels, shape (N, 2), one each; NaN beyond the lens."""
    radius_of, angle_of, most = KINDS[kind]
    stated = np.radians(fov_deg) / 2
    edge = np.full(len(pixels), np.inf)
    while (wide := edge >= most).any():
        edge[wide] = stated * (1 + FOCAL_SD * rng.standard_normal(int(wide.sum())))
    centre = np.array([WIDTH / 2, HEIGHT / 2]) + CENTRE_SD_SHARE * WIDTH * rng.standard_normal(pixels.shape)
    away = pixels - centre
    length = np.linalg.norm(away, axis=1)
    reach = length / RADIUS_PX * radius_of(edge)
    with np.errstate(invalid="ignore"):
        angle = angle_of(reach)
    across = away / length[:, None] * np.sin(angle)[:, None]
    return np.column_stack([across, np.cos(angle)])


def held(kind: str, fov_deg: float, share: float, draws: int) -> tuple[float, float]:
    """Return the share of draws in the 95 % region at a share of the view's radius, and the region's radius, deg."""
    rng = np.random.default_rng([52, int(fov_deg), int(100 * share)])
    view = ViewMask(WIDTH / 2, HEIGHT / 2, RADIUS_PX)
    guess = calibration_of_round_view(fov_deg, WIDTH, HEIGHT, view)
    turn = 0.6
    pixel = np.array([view.cx, view.cy]) + share * RADIUS_PX * np.array([np.cos(turn), np.sin(turn)])
    sightline = guess.camera.unproject(pixel)
    estimate = Estimate(-sightline, -sightline[None], pixel)
    part = camera_part(estimate, guess.camera, guess.priors.camera)
    true = seen_at(kind, fov_deg, np.tile(pixel, (draws, 1)), rng)
    # A lens that ends before the pixel, as some draws of an orthographic one do, shows nothing there.
    true = true[np.isfinite(true).all(axis=1)]
    off = np.array([tangent_coordinates(-sightline, -each) for each in true])
    limit = chi_squared.quantile(0.95, 2)
    inside = np.einsum("ni,ni->n", off, np.linalg.solve(part, off.T).T) <= limit
    return float(inside.mean()), float(np.degrees(np.sqrt(limit) * np.linalg.det(part) ** 0.25))


def main() -> None:
    """Print a table a field of view: shares held by kind and radius, and the width."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20000)
    draws = parser.parse_args().draws
    for fov_deg in FIELDS_DEG:
        print(f"\n--fov {fov_deg:g} --fov-of view: % held in the 95 % region, by the share of the view's radius")
        print(f"{'':<16}" + "".join(f"{share:>8g}" for share in SHARES) + f"{'least':>9}")
        for kind in KINDS:
            made = [held(kind, fov_deg, share, draws) for share in SHARES]
            shares = [100 * share for share, _ in made]
            print(f"{kind:<16}" + "".join(f"{share:>8.1f}" for share in shares) + f"{min(shares):>9.1f}")
        print(f"{'width, deg':<16}" + "".join(f"{width:>8.1f}" for _, width in made))


if __name__ == "__main__":
    main()

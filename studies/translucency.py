"""Compare the spread of light below the surface with Mitsuba's volumetric path: `python -m studies.translucency`.

A slab of a homogeneous, isotropically scattering medium is lit over one half by light from straight above, with a sharp
edge, and rendered from above by `volpath`. Its edge profile is compared with that of the transfer function
(`simtest.rendering.subsurface.transfer`), and with what the frame's `spread` makes of the same edge. A width is the
distance on the dark side over which the light falls to a quarter, a tenth and 3 % of the lit side's.

The slab's surface does not refract: `volpath` finds no path from a directional light through a smooth dielectric.
"""

from typing import Any

import numpy as np

from simtest.geometry import Camera
from simtest.rendering import backend
from simtest.rendering.subsurface import once_scattered, spread, transfer
from simtest.runtime.arrays import Array
from simtest.spec.reflectance import Translucency

CHANNELS = ("red", "green", "blue")
HALF_WIDTH_MM = 15.0
"""Half the slab's sides; it is as thick."""

SAMPLES = 256
PIXELS, ROWS = 120, 16
VIEW_MM = 6.0
"""Half the side of the patch that is seen."""

LEVELS = (0.25, 0.1, 0.03)


def edge_by_transfer(x: Array, scattering: float, absorption: float, index: float = 1.0) -> Array:
    """Return the response to light over x < 0: 1/2 - 1/pi int T(k) sin(k x)/k dk, shape of x, mm."""
    # T falls as 1/k^2 to the share that stays where it is.
    k = np.linspace(1e-4, 400, 80_000)
    share = once_scattered(scattering, absorption, index)
    integrand = (transfer(k, scattering, absorption, index) - share) / k
    diffused = [(1 - share) / 2 - np.trapezoid(integrand * np.sin(k * value), k) / np.pi for value in x]
    return np.array(diffused) + share * (x < 0)


def edge_by_spread(x: Array, channel: int, spec: Translucency) -> Array:
    """Return the same of the frame's blur, on a plane 20 mm away."""
    camera = Camera(640, 480, 400, 400, 320, 240)
    rays = camera.unproject(camera.pixel_centres())
    image = np.zeros((480, 640, 3), dtype=np.float32)
    image[:, :320] = 1
    normal = np.broadcast_to([0.0, 0.0, -1.0], rays.shape)
    after = spread(image, 20 / rays[..., 2], normal, camera, spec)[240, :, channel]
    return np.interp(x, (np.arange(640) + 0.5 - 320) * 20 / 400, after)


def edge_by_volpath(mi: Any, scattering: float, absorption: float, seed: int) -> tuple[Array, Array]:
    """Render the edge; return x, mm, and the mean over the patch's rows, relative to the same slab fully lit."""
    half, whole = (_render(mi, scattering, absorption, shade, seed + shade) for shade in (1, 0))
    x = (np.arange(PIXELS) + 0.5) / PIXELS * 2 * VIEW_MM - VIEW_MM
    edge = half.mean(axis=0) / whole.mean()
    # The camera looks down, and may have x the other way.
    return x, edge if edge[0] > edge[-1] else edge[::-1]


def _render(mi: Any, scattering: float, absorption: float, shade: int, seed: int) -> Array:
    T = mi.ScalarTransform4f
    total = scattering + absorption
    slab = {
        "type": "cube",
        "to_world": T().translate([0, 0, -HALF_WIDTH_MM]).scale(HALF_WIDTH_MM),
        "bsdf": {"type": "null"},
        "interior": {
            "type": "homogeneous",
            "sigma_t": {"type": "rgb", "value": [total] * 3},
            "albedo": {"type": "rgb", "value": [scattering / total] * 3},
        },
    }
    scene = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 400, "rr_depth": 50, "hide_emitters": True},
        "slab": slab,
        "sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0},
        "sensor": {
            "type": "orthographic",
            "to_world": T().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]).scale([VIEW_MM, VIEW_MM, 1]),
            # The patch is as much shorter along y as it has fewer rows.
            "film": {
                "type": "hdrfilm",
                "width": PIXELS,
                "height": ROWS,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": SAMPLES},
        },
    }
    if shade:
        # The shade lies above the camera, so that it hides nothing.
        scene["shade"] = {
            "type": "rectangle",
            "to_world": T().translate([2 * HALF_WIDTH_MM, 0, 5]).scale(2 * HALF_WIDTH_MM),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
        }
    image = np.array(mi.render(mi.load_dict(scene), seed=seed))
    return np.asarray(image[:, :, 0] if image.ndim == 3 else image)


def reach(x: Array, edge: Array, level: float) -> float:
    """Return how far on the dark side the light falls to a share of the lit side's, mm."""
    dark = x > 0
    below = np.flatnonzero(edge[dark] < level)
    if not len(below):
        return float("nan")
    i = max(int(below[0]), 1)
    return float(np.interp(-level, -edge[dark][i - 1 : i + 1], x[dark][i - 1 : i + 1]))


def main() -> None:
    """Print a row for each channel."""
    spec = Translucency(index=1.0)
    mi = backend.load()
    print("| channel | once scattered | volpath, mm | transfer function, mm | frame's spread, mm |")
    print("|---|---|---|---|---|")
    fine = np.linspace(-VIEW_MM, VIEW_MM, 482)
    for c, name in enumerate(CHANNELS):
        properties = spec.scattering_per_mm[c], spec.absorption_per_mm[c]
        edges = [
            edge_by_volpath(mi, *properties, seed=10 * c),
            (fine, edge_by_transfer(fine, *properties)),
            (fine, edge_by_spread(fine, c, spec)),
        ]
        cells = [" / ".join(f"{reach(x, edge, level):.2f}" for level in LEVELS) for x, edge in edges]
        print(f"| {name} | {once_scattered(*properties, 1.0):.2f} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()

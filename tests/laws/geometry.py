"""Laws of the geometry alone: nothing is rendered, and every expected number is computed by hand."""

import numpy as np

from simtest.errors import Failure
from simtest.geometry import Camera, Patch, circle_pose, cone_axes, cone_of_conic, ellipse_of_conic, fit_ellipse
from simtest.runtime.arrays import Array
from tests.laws.law import Law, law

FX, FY, CX, CY = 500.0, 480.0, 330.25, 229.75
"""Intrinsics of a camera whose numbers all differ."""


def sightlines() -> list[Law]:
    """Compare the sightlines of pixels with those computed from K by hand."""
    camera = Camera(640, 480, FX, FY, CX, CY)
    pixels = np.array([[CX, CY], [CX + 300.0, CY], [CX, CY - 200.0], [10.5, 470.5]])
    by_hand = np.array([[(x - CX) / FX, (y - CY) / FY, 1.0] for x, y in pixels.tolist()])
    by_hand /= np.sqrt((by_hand**2).sum(axis=1, keepdims=True))
    off = np.abs(camera.unproject(pixels) - by_hand).max()
    back = np.abs(camera.project(by_hand) - pixels).max()
    first = camera.pixel_centres()[0, 0]
    about = "K by hand; rounding is 1e-16 of a sightline and 1e-13 px"
    return [
        law("sightlines", "off", "", float(off), 1e-12, n=len(pixels), about=about),
        law("sightlines", "pixels_off", "px", float(back), 1e-9, n=len(pixels), about=about),
        law("sightlines", "first_centre", "px", float(first.mean()), 0.5, 0.5, about="centres at integer + 0.5"),
    ]


def conditioning() -> list[Law]:
    """Fit a circle of 3 px far from the origin, where plain moments would cancel."""
    phase = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    centre, radius = np.array([5000.0, 5000.0]), 3.0
    fitted = fit_ellipse(centre + radius * np.stack([np.cos(phase), np.sin(phase)], axis=1))
    off = np.nan
    if not isinstance(fitted, Failure):
        # In the fit's own coordinates, where its conic has all of its digits.
        ellipse = ellipse_of_conic(fitted.normalised)
        T = fitted.normalised_from_image
        scale = float(np.sqrt(np.linalg.det(T[:2, :2])))
        found = np.linalg.solve(T[:2, :2], ellipse.centre - T[:2, 2])
        radii = np.array([ellipse.semi_major, ellipse.semi_minor]) / scale
        off = float(max(np.abs(found - centre).max(), np.abs(radii - radius).max()))
    about = "circle of radius 3 px at (5000, 5000); the points themselves are rounded by 1e-12 px"
    return [law("conditioning", "circle_off", "px", float(off), 1e-9, n=len(phase), about=about)]


def ellipse() -> list[Law]:
    """Fit a turned ellipse from its own points, and compare centre, half-axes and direction with what drew it."""
    centre, major, minor, angle = np.array([41.0, 57.0]), 19.0, 7.0, 0.6
    phase = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    along, across = major * np.cos(phase), minor * np.sin(phase)
    points = np.stack(
        [along * np.cos(angle) - across * np.sin(angle), along * np.sin(angle) + across * np.cos(angle)], -1
    )
    fitted = fit_ellipse(centre + points)
    off, turned = np.nan, np.nan
    if not isinstance(fitted, Failure):
        found = ellipse_of_conic(fitted.image)
        axes = abs(found.semi_major - major), abs(found.semi_minor - minor)
        off, turned = max(*axes, *np.abs(found.centre - centre)), abs(found.angle - angle)
    about = "half-axes 19 and 7 px, turned by 0.6 rad from x to y"
    return [
        law("ellipse", "off", "px", float(off), 1e-9, n=len(phase), about=about),
        law("ellipse", "angle_off", "rad", float(turned), 1e-9, n=len(phase), about=about),
    ]


def pose() -> list[Law]:
    """Project a circle in space point by point, and compare its plane and its cone's axis with the true ones."""
    camera = Camera(640, 480, FX, FY, CX, CY)
    # A circle of radius 1.5 mm about a point 12 mm away, and its picture
    normal = np.array([0.3, -0.5, -0.8]) / np.sqrt(0.98)
    first = np.array([0.8, 0.0, 0.3]) / np.sqrt(0.73)
    second = np.cross(normal, first)
    phase = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    points = np.array([-1.5, 1.0, 12.0]) + 1.5 * (np.outer(np.cos(phase), first) + np.outer(np.sin(phase), second))
    x, y, z = points.T
    fitted = fit_ellipse(np.stack([FX * x / z + CX, FY * y / z + CY], axis=1))
    # Its plane, and the axis of its cone, from the fitted conic
    off, outside = np.nan, np.nan
    if not isinstance(fitted, Failure):
        cone = cone_of_conic(fitted, camera.K)
        found = circle_pose(cone)
        if not isinstance(found, Failure):
            off = min(_angle_deg(candidate, normal) for candidate in found.normals)
        # The axis is the eigenvector of the cone that lies inside of it.
        axis = cone_axes(cone)[1][:, 2]
        along = float(axis @ cone @ axis)
        outside = float(np.abs(cone @ axis - along * axis).max())
    about = "a circle of radius 1.5 mm 12 mm away, its picture by hand; rounding leaves 1e-8 deg"
    return [
        law("circle_pose", "normal_off", "deg", float(off), 1e-5, n=len(phase), about=about),
        law("circle_pose", "axis_off", "", float(outside), 1e-9, n=len(phase), about="residual of the eigenvector"),
    ]


WIDTH_PX, CENTRE_PX = 15.0, (50.3, 40.7)
"""Standard deviation and centre of the drawn spot."""


def isophotes() -> list[Law]:
    """Trace isophotes of a Gaussian spot, whose radii and centre are known."""
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(90) + 0.5)
    spot = np.exp(-((x - CENTRE_PX[0]) ** 2 + (y - CENTRE_PX[1]) ** 2) / (2 * WIDTH_PX**2))
    patch = Patch.cut(spot, (0, 0, 100, 90))
    radii, centres = [float("nan")], [float("nan")]
    if not isinstance(patch, Failure):
        # The peak, then a contour at each isovalue
        centres = [float(np.abs(patch.peak_px - CENTRE_PX).max())]
        radii = []
        for isovalue in (0.3, 0.5, 0.7):
            points = patch.crossings(isovalue)
            fitted = points if isinstance(points, Failure) else fit_ellipse(points)
            if isinstance(fitted, Failure):
                radii, centres = [float("nan")], [float("nan")]
                break
            ellipse = ellipse_of_conic(fitted.image)
            # The level is relative to the highest pixel, not to the spot's top.
            level = float(-2 * np.log(isovalue * patch.peak_value))
            mean = (ellipse.semi_major * ellipse.semi_minor) ** 0.5
            radii.append(abs(mean / (WIDTH_PX * level**0.5) - 1))
            centres.append(float(np.abs(ellipse.centre - CENTRE_PX).max()))
    about = "Gaussian spot of 15 px; linear interpolation between pixels leaves 1e-3 of the radius and 0.01 px"
    return [
        law("isovalue", "radius_off", "", float(np.max(radii)), 2e-3, n=3, about=about),
        law("sub_pixel", "place_off", "px", float(np.max(centres)), 0.02, n=4, about=about),
    ]


def _angle_deg(first: Array, second: Array) -> float:
    """Compute the angle between two unit vectors, not by the library's function, whose faults would cancel."""
    return float(np.degrees(2 * np.arcsin(min(float(np.linalg.norm(first - second)) / 2, 1.0))))

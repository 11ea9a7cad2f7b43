"""Frames through lenses: rays are distorted, not pictures; what is fitted on sightlines is what a pinhole gives."""

import dataclasses

import cv2
import numpy as np
import pytest

from simtest.detection import detect, estimate_noise
from simtest.errors import Failure, Reason
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.isophotes import fit_isophote_of_each
from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Patch, Scaramuzza, ViewMask, smooth
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.rendering.rays import is_pinhole
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import render_view
from simtest.simulation.sensor import expose
from simtest.spec import scene_from_dict

# A 140 degree fisheye: 70 deg from the axis lie 320 px away.
FOCAL = 320 / np.radians(70)
FISHEYE = {
    "width": 640, "height": 640, "fx": FOCAL, "fy": FOCAL, "distortion": {"type": "kannala_brandt"},
    "view_mask": {"radius": 320},
}  # fmt: skip
BARREL = {
    "width": 640, "height": 640, "fx": 500.0, "fy": 500.0, "view_mask": {"radius": 300},
    "distortion": {"type": "brown_conrady", "k1": -0.3, "k2": 0.05, "p1": 0.002, "p2": -0.001},
}  # fmt: skip
# The lens of a colonoscope as C3VD calibrates it, on a smaller sensor.
OMNI = {
    "width": 640, "height": 640, "fx": 364.7, "fy": 364.7, "view_mask": {"radius": 320},
    "distortion": {
        "type": "scaramuzza", "k2": -0.625, "k3": 0.370, "k4": -0.545, "c": 0.99999, "d": 0.00288, "e": -0.00296,
    },
}  # fmt: skip
PINHOLE = {"width": 320, "height": 320, "fx": FOCAL, "fy": FOCAL}


# The fit, without rendering --------------------------------------------------------------------------------------


class Ring:
    """Stands for a patch whose isophote is a circular cone of sightlines, seen through a lens."""

    def __init__(self, camera, axis, half_angle):
        first = np.cross(axis, [0.3, -0.5, 0.8])
        first /= np.linalg.norm(first)
        phase = np.linspace(0, 2 * np.pi, 80)[:, None]
        across = np.cos(phase) * first + np.sin(phase) * np.cross(axis, first)
        self.rays = np.cos(half_angle) * axis + np.sin(half_angle) * across
        self.points = camera.project(self.rays)

    def crossings(self, isovalue):
        return self.points[:-1]


LENSES = {
    "barrel": Camera(640, 640, 500.0, 480.0, 320.0, 310.0, 2.0, BrownConrady(-0.2, 0.03, 0.001, 0.002)),
    "fisheye": Camera(900, 900, 200.0, 190.0, 440.0, 455.0, 0.0, KannalaBrandt(-0.01), ViewMask(450, 450, 400)),
    "omni": Camera(
        900, 900, 240.0, 240.0, 440.0, 455.0, 0.0, Scaramuzza(-0.45, 0.1, -0.06, 0.999, 0.004, -0.006),
        ViewMask(450, 450, 400),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("lens", "angle"),
    [
        ("barrel", 5),
        ("barrel", 25),
        *((lens, angle) for lens in ("fisheye", "omni") for angle in (40, 80, 105)),
    ],
)
def test_a_circular_cone_is_found_through_a_lens(lens, angle):
    camera, u = LENSES[lens], np.radians(angle)
    axis = np.array([np.sin(u) * 0.6, np.sin(u) * 0.8, np.cos(u)])
    ring = Ring(camera, axis, np.radians(6))
    fitted = fit_isophote_of_each([ring], camera, 0.5)[0]
    assert fitted.conic is None
    pose = fitted.pose()
    np.testing.assert_allclose(pose.axis, axis, atol=1e-10)
    assert pose.axis_ratio == pytest.approx(1, abs=1e-9)
    # What is drawn lies on the isophote.
    drawn = fitted.ellipse_px(camera)
    gaps = np.linalg.norm(drawn[:, None] - ring.points, axis=-1).min(axis=1)
    spacing = np.linalg.norm(np.diff(ring.points, axis=0), axis=1).max()
    assert gaps.max() < spacing
    back = camera.unproject(drawn)
    np.testing.assert_allclose(back @ axis, np.cos(np.radians(6)), atol=1e-9)
    # Negative control: the same contour read as a pinhole's gives another axis.
    plain = dataclasses.replace(camera, distortion=None, view_mask=None)
    wrong = fit_isophote_of_each([ring], plain, 0.5)[0].pose()
    assert angle_deg(wrong.axis, axis) > (0.02 if angle == 5 else 0.5)


def test_an_isophote_as_wide_as_a_half_space_is_no_ellipse():
    ring = Ring(LENSES["fisheye"], np.array([0.0, 0.0, 1.0]), np.radians(5))
    ring.points[3] = LENSES["fisheye"].project([1.0, 0.0, -0.2])
    result = fit_isophote_of_each([ring], LENSES["fisheye"], 0.5)[0]
    assert isinstance(result, Failure)
    assert result.reason == Reason.NOT_AN_ELLIPSE
    # And one that leaves what the lens images.
    ring.points[3] = 5000.0
    assert fit_isophote_of_each([ring], LENSES["fisheye"], 0.5)[0].reason == Reason.NOT_FINITE


@pytest.mark.parametrize("lens", LENSES)
def test_isophotes_fitted_together_are_those_fitted_alone(lens):
    camera = LENSES[lens]
    axes = [np.array([np.sin(u) * 0.6, np.sin(u) * 0.8, np.cos(u)]) for u in np.radians([3, 12, 20, 24])]
    rings = [Ring(camera, axis, np.radians(2 + i)) for i, axis in enumerate(axes)]
    rings[1].points[3] = np.nan
    missing = Failure(Reason.NO_PEAK, "dark")
    short = Ring(camera, axes[0], np.radians(4))
    short.points = short.points[:5]
    together = fit_isophote_of_each([rings[0], missing, rings[1], short, *rings[2:]], camera, 0.5)
    assert together[1] is missing
    assert [together[i].reason for i in (2, 3)] == [Reason.NOT_FINITE, Reason.TOO_FEW_POINTS]
    for i, ring in ((0, rings[0]), (4, rings[2]), (5, rings[3])):
        alone = fit_isophote_of_each([ring], camera, 0.5)[0]
        np.testing.assert_allclose(together[i].cone, alone.cone, rtol=0, atol=1e-13)
        np.testing.assert_allclose(together[i].sightline, alone.sightline, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(together[i].points, ring.points[:-1])


# The view mask in detection --------------------------------------------------------------------------------------


def spot(camera, x, y, width, floor=0.3):
    pixels = camera.pixel_centres()
    return (floor + np.exp(-((pixels[..., 0] - x) ** 2 + (pixels[..., 1] - y) ** 2) / (2 * width**2))).astype(
        np.float32
    )


ROUND = Camera(200, 160, 300.0, 300.0, 100.0, 80.0, view_mask=ViewMask(100.0, 80.0, 70.0))


def masked(frame, noise=0.005, outside=0.0):
    rng = np.random.default_rng(0)
    return np.where(ROUND.seen, frame, outside) + rng.normal(0, noise, frame.shape).astype(np.float32)


def test_the_border_of_the_view_is_no_highlight():
    """A bright floor ends at the mask; a highlight outside, or cut by it, rises towards it."""
    for frame in (
        spot(ROUND, 0, 0, 9, 0.6),
        spot(ROUND, 100, 168, 12),
        spot(ROUND, 168, 80, 12),
        spot(ROUND, 100, 14, 8, 0),
    ):
        assert reconstruct(masked(frame), ROUND) == []
        # What lies outside, of a real endoscope's picture, does not matter.
        assert reconstruct(masked(frame, outside=1.0), ROUND) == []
    # Negative control: without the mask the cut highlight is taken for a whole one.
    plain = dataclasses.replace(ROUND, view_mask=None)
    assert len(reconstruct(masked(spot(ROUND, 168, 80, 12)), plain)) == 1


def test_a_highlight_beside_the_border_of_the_view_keeps_its_shape():
    clean = spot(ROUND, 150.3, 80.6, 6, 0.05)
    (found,) = reconstruct(masked(clean, 0.0, outside=7.0), ROUND, ["cone_axis"])
    (alone,) = reconstruct(clean, dataclasses.replace(ROUND, view_mask=None), ["cone_axis"])
    np.testing.assert_allclose(found.patch.peak_px, alone.patch.peak_px, atol=1e-3)
    assert angle_deg(found.estimates["cone_axis"].normal, alone.estimates["cone_axis"].normal) < 1e-3
    assert found.patch.seen.shape == found.patch.values.shape
    assert not found.patch.seen.all()


def test_noise_is_that_of_the_view():
    frame = masked(spot(ROUND, 100, 80, 20), noise=0.02)
    frame[~ROUND.seen] = 0
    assert estimate_noise(frame, ROUND.seen) == pytest.approx(0.02, rel=0.05)
    assert estimate_noise(frame) < 0.019
    assert estimate_noise(frame, np.zeros_like(ROUND.seen)) == 0


def test_smoothing_within_the_view():
    seen, constant = ROUND.seen, np.full((160, 200), 2.5, np.float32)
    smoothed = smooth(np.where(seen, constant, 9), 2.0, seen)
    np.testing.assert_allclose(smoothed[seen], 2.5, rtol=1e-5)
    assert (smoothed[~seen] == 0).all()
    assert detect(smoothed, 0.0, seen=seen) == []
    # An isophote that would run along the mask's border is not closed.
    patch = Patch.cut(smooth(spot(ROUND, 165, 80, 12), 2.0, seen), (130, 50, 50, 60), seen=seen)
    assert patch.isophote(0.5).reason == Reason.NO_CLOSED_ISOPHOTE


# Rendered --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session():
    return Session(scene_from_dict({"surface": {"type": "plane"}}))


def tilted(kind, angle, pointed):
    """Return a surface whose highlight is seen `angle` deg off the axis, or the same seen on it."""
    depth = 10 * np.cos(np.radians(angle)) if pointed else 10.0
    surface = {"type": kind, "distance_mm": float(depth), "tilt_deg": 0.0 if pointed else angle, "azimuth_deg": 30.0}
    # Tilted along its straight direction, a cylinder's nearest point moves by the tilt.
    return surface | ({"radius_mm": 5.0, "spin_deg": 120.0} if kind == "cylinder" else {})


def seen_through(session, camera, surface, sigma=0.0, seed=3):
    """Return frame, truth, and the estimate of the one highlight through the session's own lens or another."""
    seen = render_view(session, scene_from_dict({"surface": surface, "camera": camera}))
    (truth,) = [t for t in seen.highlights if t.isolated]
    # The true BP: the surface's point on its pixel's ray, where the normal is the reversed sightline.
    np.testing.assert_allclose(session.camera.project(truth.position), truth.bp_px, atol=1e-6)
    assert angle_deg(truth.normal, -session.camera.unproject(truth.bp_px)) < 1e-6
    frame = expose(seen.radiance.total, seen.full_scale, sigma, from_integer(seed))

    def estimate(**other):
        (found,) = reconstruct(frame, dataclasses.replace(session.camera, **other), ["cone_axis"])
        return found.estimates["cone_axis"]

    return truth, estimate


@pytest.mark.render
@pytest.mark.parametrize(("kind", "angle"), [("plane", 2.0), ("plane", 60.0), ("cylinder", 30.0), ("cylinder", 60.0)])
def test_normals_through_a_fisheye_equal_those_through_a_pinhole(session, kind, angle):
    """The same highlight, off the axis of a 140 deg fisheye and on the axis of a pinhole pointed at it."""
    for sigma in (0.0, 0.01):
        shapes = []
        for camera in (FISHEYE, PINHOLE):
            truth, estimate = seen_through(session, camera, tilted(kind, angle, camera is PINHOLE), sigma)
            found = estimate()
            # Against the true normal, so that the two cameras' frames are comparable.
            assert angle_deg(found.normal, truth.normal) < 0.025
            shapes.append(found.axis_ratio)
        assert shapes[0] == pytest.approx(shapes[1], rel=0.01)


@pytest.mark.render
@pytest.mark.parametrize(
    ("camera", "kind", "angle"),
    [(OMNI, "plane", 2.0), (OMNI, "plane", 45.0), (OMNI, "cylinder", 30.0), (BARREL, "plane", 20.0)],
)
def test_normals_through_a_lens_and_without_its_model(session, camera, kind, angle):
    """Without noise to 0.02 deg; wrong signs of an omnidirectional lens's small coefficients, or no lens, are seen."""
    truth, estimate = seen_through(session, camera, tilted(kind, angle, False))
    assert angle_deg(estimate().normal, truth.normal) < (0.02 if camera is OMNI else 0.01)
    if angle < 15:
        return
    assert angle_deg(estimate(distortion=None).normal, truth.normal) > (2 if camera is OMNI else 0.5)
    if camera is OMNI:
        wrong = dataclasses.replace(session.camera.distortion, d=-0.00296, e=0.00288)
        assert angle_deg(estimate(distortion=wrong).normal, truth.normal) > 0.05


@pytest.mark.render
@pytest.mark.slow
def test_normals_over_the_view_of_an_omnidirectional_lens(session):
    """Planes and cylinders all over the view, with noise: the median is that of the fisheye, 0.02 deg."""
    rng, errors = np.random.default_rng(8), []
    for i in range(24):
        kind, angle = ("plane", "cylinder")[i % 2], float(rng.uniform(0, 50))
        surface = tilted(kind, angle, False) | {"azimuth_deg": float(rng.uniform(0, 360))}
        truth, estimate = seen_through(session, OMNI, surface, 0.005, i)
        errors.append(angle_deg(estimate().normal, truth.normal))
    assert np.median(errors) < 0.02
    assert max(errors) < 0.05


SMALL = {"width": 160, "height": 120, "fx": 40.0, "fy": 40.0}
COLON = {"type": "anatomy", "path": "colon"}
VIEWS = [
    ({"type": "plane"}, {"distortion": None, "fx": 80.0}, 4),
    ({"type": "plane"}, {}, 1),
    ({"type": "sphere", "radius_mm": 30.0, "side": "inside"}, {}, 4),
    (
        {"type": "cylinder", "radius_mm": 20.0, "side": "inside"},
        {"distortion": {"type": "brown_conrady", "k1": -0.02}},
        1,
    ),
    ({"type": "quadric", "k1_per_mm": 0.02, "k2_per_mm": -0.03}, {}, 1),
    pytest.param(COLON, {}, 1, marks=pytest.mark.ci),
]


@pytest.mark.render
@pytest.mark.parametrize(("surface", "lens", "samples"), VIEWS, ids=str)
def test_frames_labels_and_truth_through_a_masked_lens(session, surface, lens, samples):
    """Each pixel's truth lies on its own sightline; outside the view there is neither radiance nor truth.

    A pixel is seen or not by its centre, whatever its samples.
    """
    mask = {"radius": 50, "cx": 83.0}
    camera = SMALL | {"distortion": {"type": "kannala_brandt"}, "view_mask": mask} | lens
    tables = {"surface": surface, "camera": camera, "render": {"samples_per_pixel": samples}}
    session.update(scene_from_dict({**tables, "reflectance": {"type": "phong", "diffuse": 0.3}}))
    assert session.sightlines.in_kernel == (not isinstance(session.camera.distortion, BrownConrady))
    model, frame, truth = session.camera, session.frame(), session.truth()
    x, y = model.pixel_centres().transpose(2, 0, 1)
    np.testing.assert_array_equal(model.seen, np.hypot(x - 83.0, y - 60.0) <= 50)
    assert not frame.radiance.total[~model.seen].any()
    assert frame.radiance.total[truth.mask].all()
    np.testing.assert_array_equal(frame.labels.mask[~model.seen], False)
    assert not truth.mask[~model.seen].any()
    assert truth.mask[model.seen].mean() > 0.4  # the quadric is a patch
    for name in ("depth", "position", "normal", "shading_normal", "geometric_normal", "k_min", "direction_max"):
        assert np.isnan(getattr(truth, name)[~model.seen]).all(), name
    for name in ("depth", "position", "normal", "k_min"):
        assert np.isnan(getattr(frame.labels, name)[~model.seen]).all(), name
    sightlines = model.unproject(model.pixel_centres())
    np.testing.assert_allclose((truth.position / truth.depth[..., None])[truth.mask], sightlines[truth.mask], atol=1e-5)
    both = truth.mask & frame.labels.mask
    np.testing.assert_allclose(
        (frame.labels.position / frame.labels.depth[..., None])[both], sightlines[both], atol=1e-4
    )
    assert all(model.contains(highlight.bp_px) for highlight in session.highlights(frame.radiance))


@pytest.mark.render
def test_pixels_in_view_are_those_of_the_whole_frame(session):
    """Those outside of the view are not traced; the others have the same sample points."""
    lens = {**SMALL, "width": 90, "height": 70, "distortion": {"type": "kannala_brandt"}}
    tables = {"surface": COLON, "reflectance": {"type": "phong", "diffuse": 0.3}, "render": {"samples_per_pixel": 3}}
    session.update(scene_from_dict({**tables, "camera": lens}))
    whole = session.radiance()
    session.update(scene_from_dict({**tables, "camera": lens | {"view_mask": {"radius": 31}}}))
    part, seen = session.radiance(), session.camera.seen
    for name in ("specular", "diffuse"):
        a, b = getattr(part, name), getattr(whole, name)
        np.testing.assert_allclose(a[seen], b[seen], rtol=1e-6)
        assert not a[~seen].any()
        assert b[~seen].any()


@pytest.mark.render
def test_a_view_of_one_pixel_is_that_pixel(session):
    camera = {"width": 40, "height": 30, "fx": 40.0, "fy": 40.0, "view_mask": {"radius": 0.6, "cx": 20.5, "cy": 15.5}}
    tables = {"surface": {"type": "plane"}, "reflectance": {"type": "phong", "diffuse": 1.0}}
    session.update(scene_from_dict({**tables, "camera": camera, "render": {"samples_per_pixel": 4}}))
    np.testing.assert_array_equal(session.radiance().total > 0, session.camera.seen)
    assert np.count_nonzero(session.camera.seen) == 1


@pytest.mark.render
@pytest.mark.parametrize("lens", [{}, {"distortion": {"type": "kannala_brandt"}}], ids=str)
@pytest.mark.parametrize("samples", [1, 3])
def test_rays_that_are_given_trace_as_those_made_in_the_kernel(session, samples, lens):
    tables = {"surface": {"type": "sphere", "radius_mm": 6.0}, "camera": {**PINHOLE, "skew": 1.5, **lens}}
    render = {"samples_per_pixel": samples, "seed": 2}
    session.update(scene_from_dict({**tables, "reflectance": {"type": "phong", "diffuse": 0.3}, "render": render}))
    expected = session.frame()
    assert session.sightlines.in_kernel
    session.sightlines.in_kernel = False
    given = session.frame()
    session.sightlines.in_kernel = True
    slope = -np.sum(expected.labels.normal * expected.labels.position, axis=-1) / expected.labels.depth
    inside = np.nan_to_num(slope) > np.cos(1.2)
    assert inside.sum() > 1000
    for part in ("specular", "diffuse"):
        a, b = getattr(given.radiance, part), getattr(expected.radiance, part)
        assert np.percentile(np.abs(a - b)[inside], 99) < 1e-5 * expected.radiance.total.max()
    np.testing.assert_allclose(given.labels.depth[inside], expected.labels.depth[inside], rtol=1e-4)


def test_only_a_pinhole_counts_as_one():
    """Whatever its class: a lens may turn its outer sightlines inwards, or have none beyond a radius."""

    class Lens(Camera):
        strength, reach = 0.0, np.inf

        def unproject(self, points_px):
            rays = super().unproject(points_px)
            squared = (rays[..., :2] ** 2).sum(axis=-1, keepdims=True)
            rays[..., :2] *= 1 - self.strength * squared
            return np.where(np.sqrt(squared) > self.reach, np.nan, rays)

    for values, plain in (({}, True), ({"strength": 1e-4}, False), ({"reach": 0.5}, False)):
        camera = type("Other", (Lens,), values)(90, 70, 80.0, 76.0, 44.0, 37.0, 1.5)
        assert is_pinhole(camera) == plain


@pytest.mark.render
def test_lines_are_bent_as_opencv_bends_them(session):
    """A rendered edge, the rim of a sphere, lies where OpenCV projects it."""
    camera = {**BARREL, "width": 400, "height": 400, "fx": 330.0, "fy": 320.0, "view_mask": {"radius": 190}}
    session.update(
        scene_from_dict({"surface": {"type": "sphere", "radius_mm": 4.0, "distance_mm": 8.0}, "camera": camera})
    )
    model = session.camera
    outline, _ = cv2.findContours(session.truth().mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rim = np.arcsin(4 / 12)
    phase = np.linspace(0, 2 * np.pi, 2000)
    rays = np.stack(
        [np.sin(rim) * np.cos(phase), np.sin(rim) * np.sin(phase), np.full_like(phase, np.cos(rim))], axis=-1
    )
    lens = np.array([-0.3, 0.05, 0.002, -0.001])
    K = model.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, lens)
    gaps = np.linalg.norm(outline[0][:, 0, None] - expected[:, 0], axis=-1).min(axis=1)
    assert gaps.max() < 1.5
    straight, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, None)
    assert np.linalg.norm(outline[0][:, 0, None] - straight[:, 0], axis=-1).min(axis=1).max() > 3


def test_cone_axis_is_an_estimator_of_any_camera():
    """A patch made through a lens is read like any other, by the registered callable."""
    camera = LENSES["fisheye"]
    pixels = camera.pixel_centres()
    axis = np.array([0.0, np.sin(1.2), np.cos(1.2)])
    with np.errstate(invalid="ignore"):
        frame = np.nan_to_num(np.exp((camera.unproject(pixels) @ axis - 1) * 150))
    (found,) = reconstruct(np.where(camera.seen, frame, 0), camera, {"cone_axis": cone_axis}, smoothing_px=1.0)
    assert angle_deg(found.estimates["cone_axis"].normal, -axis) < 0.01

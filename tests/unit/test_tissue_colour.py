"""Tissue's colour: trees of vessels, their absorption, the pattern's table, and the same in the kernel."""

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.spec import scene_from_dict
from simtest.spec.reflectance import TISSUE_PRESETS, Debris, TissueColour
from simtest.surfaces import make_surface, vessels
from simtest.surfaces.tissue_pattern import EDGE, LUMP_SCALE, LUMPS, _make, blood_absorption, make_pattern, reach
from simtest.surfaces.vessels import (
    BLUR_PER_DEPTH,
    ENDLESS,
    VesselSegments,
    grow_vessels,
    make_table,
    seen_depth,
    seen_profile,
    segments,
    spread_points,
    surface_patch,
)
from tests.marked import marked

DEPTH_MM = TissueColour().vessels.depth_mm
SMALL = {"width": 96, "height": 72, "fx": 90.0, "fy": 90.0}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20.0},
    "sphere": {"type": "sphere", "radius_mm": 12.0, "distance_mm": 20.0},
    "inside a cylinder": {"type": "cylinder", "radius_mm": 12.0, "distance_mm": 12.0, "side": "inside"},
    "quadric": {"type": "quadric", "k1_per_mm": 0.05, "k2_per_mm": -0.04, "distance_mm": 15.0},
    "colon": {"type": "anatomy", "path": "colon"},
}


def scene(surface="plane", tissue=None, **render):
    reflectance = {"type": "phong", "exponent": 200.0, "specular": 0.3, "albedo": tissue or {}}
    return scene_from_dict(
        {"surface": SURFACES[surface], "reflectance": reflectance, "camera": SMALL, "render": render or {}}
    )


def surface_of(name):
    return make_surface(scene(name).surface)


def on_plane(count, reach):
    return np.column_stack([np.random.default_rng(0).uniform(-reach, reach, (count, 2)), np.zeros(count)])


NOTHING = {"mottling": {"amplitude": 0.0}, "capillaries": {"strength": 0.0}, "vessels": {"strength": 0.0}}


def tissue_of(**shown):
    """Return tissue that shows some of its parts alone."""
    return {**NOTHING, **shown}


# Trees -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", marked(SURFACES, ci=["colon"]))
def test_vessels_are_trees_on_the_surface_whose_calibres_follow_murray(name):
    surface = surface_of(name)
    forest = grow_vessels(surface_patch(surface), TissueColour().vessels, 3)
    child = np.flatnonzero(forest.parent >= 0)
    parent = forest.parent[child]
    cubes = np.zeros(len(forest.parent))
    np.add.at(cubes, parent, forest.radius[child] ** 3)
    branching = cubes > 0
    assert branching.sum() > 50
    np.testing.assert_allclose(cubes[branching], forest.radius[branching] ** 3, rtol=1e-9)
    # What has no child has the smallest calibre.
    np.testing.assert_allclose(forest.radius[~branching], 0.03, rtol=1e-12)
    # A forest without loops: every way up ends at a root within as many steps as there are nodes, each with a tree.
    above = np.where(forest.parent >= 0, forest.parent, np.arange(len(forest.parent)))
    for _ in range(int(np.ceil(np.log2(len(above)))) + 1):
        above = above[above]
    assert set(np.unique(above)) == set(np.flatnonzero(forest.parent == -1))
    # A vessel stays an artery or a vein, and both exist; none leads through a fold.
    assert (forest.vein[child] == forest.vein[parent]).all()
    assert 0.3 < forest.vein.mean() < 0.7
    assert np.einsum("ni,ni->n", forest.normal[child], forest.normal[parent]).min() > 0.2
    # Nodes and pieces lie on the surface; from the parent to the node there are no gaps.
    pieces = segments(forest)
    for points in (forest.position[::7], pieces.start[::31], pieces.end[::31]):
        off = np.abs(surface.clearance(points))
        assert np.quantile(off, 0.95) < 0.01
        assert off.max() < 0.1
    start, end = (part.reshape(-1, len(child), 3) for part in (pieces.start, pieces.end))
    np.testing.assert_allclose(start[0], forest.position[parent], atol=1e-12)
    np.testing.assert_allclose(end[-1], forest.position[child], atol=1e-12)
    np.testing.assert_array_equal(start[1:], end[:-1])
    if name == "sphere":
        # Normals, where they are a closed form
        out = forest.position - surface.centre
        assert np.abs(np.cross(forest.normal, out / np.linalg.norm(out, axis=1, keepdims=True))).max() < 0.02


def test_there_are_several_calibres():
    surface = make_surface(scene_from_dict({"surface": {"type": "plane", "distance_mm": 30.0}}).surface)
    forest = grow_vessels(surface_patch(surface), TissueColour().vessels, 0)
    calibre = 2 * forest.radius
    assert calibre.min() == pytest.approx(0.06)
    assert 0.6 < calibre[forest.parent == -1].max() / 0.5 < 1.6
    # Thin ones are many and thick ones few.
    counts = np.histogram(calibre, [0.059, 0.09, 0.15, 0.25, 1.0])[0]
    assert (np.diff(counts) < 0).all()
    assert counts[-1] > 10


def test_samples_are_spread_evenly_by_area():
    surface = surface_of("quadric")
    points, normals = spread_points(surface_patch(surface), 0.8, np.random.default_rng(0))
    gap = np.linalg.norm(points[:, None, :] - points[None, :400], axis=2)
    gap[np.arange(400), np.arange(400)] = np.inf
    assert gap.min() >= 0.8
    # Over a part of the patch, area by its own quadrature.
    side = (np.arange(400) + 0.5) / 400 * 15.0
    x, y = np.meshgrid(side, side)
    secant = np.sqrt(1 + (0.05 * x) ** 2 + (0.04 * y) ** 2)
    expected = secant.mean() * 225.0 / surface_patch(surface).area
    assert ((points[:, 0] > 0) & (points[:, 1] > 0)).mean() == pytest.approx(expected, abs=0.02)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_a_seed_is_a_pattern():
    patch, spec = surface_patch(surface_of("plane")), TissueColour().vessels
    first = grow_vessels(patch, spec, 5)
    grow_vessels.cache_clear()
    again, other = grow_vessels(patch, spec, 5), grow_vessels(patch, spec, 6)
    assert first is not again
    np.testing.assert_array_equal(first.position, again.position)
    np.testing.assert_array_equal(first.parent, again.parent)
    assert len(other.position) != len(first.position) or not np.array_equal(other.position, first.position)


# Absorption ------------------------------------------------------------------------------------------------------


def test_blood_absorbs_red_least():
    for saturation in (0.0, 0.5, 0.75, 1.0):
        red, green, blue = blood_absorption(saturation)
        assert red < 0.3 * min(green, blue)
    # Blood of 150 g/l: oxygenated 2.303 * 53236 * 150 / 64500 = 285 / cm at 540 nm, and less beside the peak.
    assert 10 < blood_absorption(1.0)[1] < 28.5
    # Without oxygen red is absorbed more.
    assert blood_absorption(0.0)[0] > 4 * blood_absorption(1.0)[0]
    # More blood, less depth; red reaches deepest.
    assert (reach(0.1) < reach(0.02)).all()
    assert reach(0.03)[0] > 2 * reach(0.03)[1]


def test_a_profile_keeps_area_and_spread():
    radius, blur = np.array([0.02, 0.1, 0.4]), 0.06
    width, peak = seen_profile(radius, blur / BLUR_PER_DEPTH)
    for r, w, top in zip(radius, width, peak, strict=True):
        x = np.linspace(-w, w, 20001)
        seen = top * np.maximum(1 - (x / w) ** 2, 0) ** 1.5
        area = seen.sum() * (x[1] - x[0])
        assert area == pytest.approx(np.pi * r**2, rel=1e-4)
        assert (seen * x**2).sum() / seen.sum() == pytest.approx(r**2 / 4 + blur**2, rel=1e-4)


def test_a_profile_tells_its_depth():
    radius, depth = np.array([0.03, 0.1, 0.25]), np.array([0.05, 0.4, 1.0])
    np.testing.assert_allclose(seen_depth(*seen_profile(radius, depth)), depth, rtol=1e-9)


def test_large_vessels_lie_deeper_blurred_and_bluish():
    surface = surface_of("plane")

    def patterns(**depths):
        return make_pattern(surface, scene(tissue=tissue_of(vessels=depths)).albedo)

    shallow, same, deep = patterns(depth_mm=0.1), patterns(depth_mm=0.1, deepest_mm=0.1), patterns(deepest_mm=0.6)
    points = on_plane(4000, 25)
    # All at one depth is what no range of depths gives.
    np.testing.assert_allclose(same.albedo(points), shallow.albedo(points), atol=1e-5)
    rows = deep.vessels.rows[np.unique(deep.vessels.rows[:, :3], axis=0, return_index=True)[1]].astype(float)
    depth = seen_depth(rows[:, 3], np.abs(rows[:, 7]))
    radius = np.sqrt(3 / 8 * rows[:, 3] * np.abs(rows[:, 7]))
    assert depth.min() == pytest.approx(DEPTH_MM, rel=1e-3)
    calibre = (2 * radius - 0.06) / (0.5 - 0.06)
    np.testing.assert_allclose(depth, DEPTH_MM + (0.6 - DEPTH_MM) * calibre, atol=1e-3)
    assert depth.max() > 0.35
    # Over the largest, green and blue come back sooner than red, against the same vessels near the surface.
    over = rows[radius > 0.15]
    middle = over[:, :3] + over[:, 4:7] / 2
    below, above = deep.albedo(middle) / deep.base, shallow.albedo(middle) / shallow.base
    darkest = above[:, 1] < 0.7
    assert darkest.sum() > 20
    assert (below[darkest, 1] > above[darkest, 1] + 0.1).all()
    blueness = [np.log(each[darkest, 2] / each[darkest, 0]) for each in (above, below)]
    assert (blueness[1] > blueness[0] + 0.1).all()


def test_the_largest_vessels_are_not_above_the_twigs():
    with pytest.raises(InputError, match=r"deepest_mm = 0\.05: must be at least depth_mm"):
        scene(tissue={"vessels": {"deepest_mm": 0.05}})


def test_smaller_vessels_are_fainter_and_red_is_darkened_least():
    pattern = make_pattern(surface_of("plane"), TissueColour())
    radius = np.array([0.03, 0.06, 0.12, 0.25])
    start = np.stack([np.zeros(4), 10.0 * np.arange(4), np.zeros(4)], axis=1)
    normal, half = np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([2.5, 0.0, 0.0])
    for vein in (False, True):
        lines = VesselSegments(start, start + 2 * half, normal, radius, np.full(4, vein))
        table = make_table(lines, DEPTH_MM, np.full(3, ENDLESS))
        chord = table.chords(start + half)[:, int(vein)]
        assert (table.chords(start + half)[:, int(not vein)] == 0).all()
        left = 1 - pattern.share * (1 - np.exp(-chord[:, None] * pattern.absorption[int(vein)]))
        assert (np.diff(left, axis=0) < 0).all()
        assert (left[:, 0] > left[:, 1]).all()
        assert (left[:, 0] > left[:, 2]).all()
        # Twigs are faint, trunks plain.
        assert left[0, 1] > 0.75
        assert left[-1, 1] < 0.6


def test_the_pattern_darkens_over_vessels_alone():
    tissue = tissue_of(vessels={})
    surface = surface_of("plane")
    spec = scene(tissue=tissue).albedo
    pattern = make_pattern(surface, spec)
    pieces = segments(grow_vessels(surface_patch(surface), spec.vessels, _grow_seed(spec)))
    on = pattern.albedo((pieces.start + pieces.end) / 2)
    assert (on < pattern.base).all()
    # Far from all vessels there is the ground.
    points = on_plane(800, 25)
    far = _brute(points, pieces, pattern).max(axis=1) == 0
    assert far.sum() > 50
    np.testing.assert_array_equal(pattern.albedo(points[far]), np.tile(pattern.base, (far.sum(), 1)))


def _grow_seed(spec):
    return int(np.random.SeedSequence(spec.seed).spawn(3)[2].generate_state(1)[0])


def _brute(points, pieces, pattern):
    """Chords through every segment, and the longest of arteries and veins."""
    blur = BLUR_PER_DEPTH * DEPTH_MM
    variance = pieces.radius**2 / 4 + blur**2
    found = np.zeros((len(points), 2))
    along = pieces.end - pieces.start
    for i, p in enumerate(points):
        t = np.clip(np.sum((p - pieces.start) * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
        x2 = np.sum((p - pieces.start - t[:, None] * along) ** 2, axis=1)
        chord = 8 * pieces.radius**2 / (3 * np.sqrt(6 * variance)) * np.maximum(1 - x2 / (6 * variance), 0) ** 1.5
        found[i] = [chord[~pieces.vein].max(), chord[pieces.vein].max()]
    return found


@pytest.mark.parametrize("name", ["plane", "inside a cylinder", pytest.param("colon", marks=pytest.mark.ci)])
def test_the_table_finds_every_vessel(name):
    surface, spec = surface_of(name), TissueColour()
    pattern = make_pattern(surface, spec)
    patch = surface_patch(surface)
    pieces = segments(grow_vessels(patch, spec.vessels, _grow_seed(spec)))
    points, _ = patch.draw(np.random.default_rng(1), 300)
    expected = _brute(points, pieces, pattern)
    assert (expected > 0).any(axis=1).mean() > 0.2
    # The table is in single precision, which rounds positions of 100 mm to 4e-6 mm; a profile is no steeper than 1.5.
    np.testing.assert_allclose(pattern.vessels.chords(points), expected, atol=2e-5)


# Pattern ---------------------------------------------------------------------------------------------------------


def test_mottling_has_the_told_deviation():
    tissue = tissue_of(mottling={"amplitude": 0.2, "wavelength_mm": 2.0})
    pattern = make_pattern(surface_of("plane"), scene(tissue=tissue).albedo)
    points = on_plane(20_000, 30)
    absorbance = -np.log(pattern.albedo(points) / pattern.base)
    assert absorbance[:, 1].std() == pytest.approx(0.2, rel=0.1)
    assert abs(absorbance[:, 1].mean()) < 0.03
    # Its waves: green's autocorrelation is high within a tenth of one, and gone half of one away.
    near, far = (
        -np.log(pattern.albedo(points + np.array([step, 0, 0]))[:, 1] / pattern.base[1]) for step in (0.2, 1.0)
    )
    assert np.corrcoef(absorbance[:, 1], near)[0, 1] > 0.8
    assert np.corrcoef(absorbance[:, 1], far)[0, 1] < 0.3
    # Red varies least.
    assert absorbance[:, 0].std() < 0.5 * absorbance[:, 1].std()


def test_the_net_has_meshes_of_the_told_width():
    tissue = tissue_of(capillaries={"strength": 0.5, "spacing_mm": 1.0})
    pattern = make_pattern(surface_of("plane"), scene(tissue=tissue).albedo)
    x = np.linspace(-30, 30, 60001)
    line = np.stack([x, 0.3 * x, np.zeros_like(x)], axis=1)
    dark = pattern.capillaries.at(line) > 0.6
    walls = np.count_nonzero(np.diff(dark.astype(int)) == 1)
    mean_chord = 60 * np.hypot(1, 0.3) / walls
    # A line's mean chord in the cells of random points is about 0.7 of the cube root of their volume; walls that meet
    # melt, so some are missed.
    assert 0.6 < mean_chord < 1.2
    assert 0.05 < dark.mean() < 0.5


@pytest.mark.parametrize("preset", sorted(TISSUE_PRESETS))
def test_albedo_is_a_share(preset):
    tissue = {"preset": preset, "base": [1.0, 1.0, 0.9], "mottling": {"amplitude": 1.0}}
    pattern = make_pattern(surface_of("plane"), scene(tissue=tissue).albedo)
    albedo = pattern.albedo(on_plane(20_000, 25))
    assert albedo.min() >= 0
    assert albedo.max() <= 1


def test_presets_can_be_overridden_number_by_number():
    tissue = TissueColour.model_validate({"preset": "stomach", "vessels": {"depth_mm": 0.1}})
    assert tissue.vessels.depth_mm == 0.1
    assert tissue.vessels.largest_mm == TISSUE_PRESETS["stomach"]["vessels"]["largest_mm"]
    assert tissue.base == TISSUE_PRESETS["stomach"]["base"]
    assert TissueColour() == TissueColour.model_validate({}) == TissueColour(preset="colon_mucosa")


def test_there_is_no_seam_around_a_tube():
    surface = surface_of("inside a cylinder")
    pattern = make_pattern(surface, TissueColour())
    # The anchor lies at angle 0: the seam of the sampling is on the far side.
    y = np.linspace(-15, 15, 1500)

    def wall(angle):
        out = np.array([np.sin(angle), 0.0, -np.cos(angle)])
        return surface.centre + 12.0 * out + y[:, None] * [0.0, 1.0, 0.0]

    step = 1e-4
    for angle in (np.pi, 1.0):
        jump = np.abs(pattern.albedo(wall(angle - step)) - pattern.albedo(wall(angle + step)))
        assert jump.max() < 0.02
        assert pattern.vessels.chords(wall(angle)).max() > 0.02
    # Vessels cross the seam as they cross another line.
    forest = grow_vessels(surface_patch(surface), TissueColour().vessels, 3)
    child = np.flatnonzero(forest.parent >= 0)
    x, _, z = (forest.position - surface.centre).T
    angle = np.arctan2(x, -z)

    def crossings(line):
        turned = np.angle(np.exp(1j * (angle - line)))
        a, b = turned[child], turned[forest.parent[child]]
        return np.count_nonzero((a * b < 0) & (np.abs(a - b) < 1))

    others = np.mean([crossings(line) for line in (-2.0, -1.0, 0.5, 1.0, 2.0)])
    assert 0.6 * others < crossings(np.pi) < 1.6 * others


@pytest.mark.parametrize(("name", "axes"), [("plane", [0, 1]), ("inside a cylinder", [1])])
def test_vessels_do_not_end_where_a_tilted_camera_still_sees_the_surface(name, axes):
    surface = surface_of(name)
    patch = surface_patch(surface)
    vessels = make_pattern(surface, TissueColour()).vessels
    near = patch.draw(np.random.default_rng(4), 20_000)[0]
    half, far = np.array(patch.half_mm), near.copy()
    # Over the second border, where the pattern stands as it is: an even number of mirrors.
    far[:, axes] += 4 * half[axes]
    np.testing.assert_allclose(vessels.chords(far), vessels.chords(near), atol=1e-9)
    covered = (vessels.chords(near) > 0).any(axis=1).mean()
    assert 0.1 < covered < 0.9
    # Across the border itself there is no jump.
    border = near.copy()
    border[:, axes[0]] = half[axes[0]]
    step = 1e-6 * np.eye(3)[axes[0]]
    np.testing.assert_allclose(vessels.chords(border - step), vessels.chords(border + step), atol=1e-4)


def test_a_ball_has_vessels_all_around():
    surface = surface_of("sphere")
    vessels = make_pattern(surface, TissueColour()).vessels
    points, _ = surface_patch(surface).draw(np.random.default_rng(4), 20_000)
    behind = (points - surface.centre)[:, 2] < -0.5 * surface.radius
    assert (vessels.chords(points[behind]) > 0).any(axis=1).mean() > 0.1


# Kernel ----------------------------------------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize("colour", [{}, {"vessels": {"depth_mm": 0.05, "deepest_mm": 0.6}}])
def test_a_frame_shows_the_albedo(colour):
    data = {"surface": SURFACES["sphere"], "camera": SMALL, "rig": {"lights": [{}, {"offset_mm": 4.0, "power": 0.5}]}}
    white, tissue = ({"type": "phong", "specular": 0.0, **base} for base in ({"diffuse": 1.0}, {"albedo": colour}))
    plain = Session(scene_from_dict({**data, "reflectance": white}), "llvm_ad_rgb").radiance()
    session = Session(scene_from_dict({**data, "reflectance": tissue}), "llvm_ad_rgb")
    seen, truth = session.radiance(), session.truth()
    valid = truth.mask & (plain.diffuse.min(axis=-1) > 1e-6)
    assert valid.sum() > 1000
    expected = make_pattern(session.surface, TissueColour(**colour)).albedo(session.to_model(truth.position[valid]))
    np.testing.assert_allclose(seen.diffuse[valid] / plain.diffuse[valid], expected, atol=1e-3)


@pytest.mark.slow
@pytest.mark.render
def test_no_pattern_has_a_kernel_of_its_own():
    session = Session(scene(samples_per_pixel=4), "llvm_ad_rgb")
    frames = [session.radiance().diffuse]
    import drjit as dr  # after the backend has chosen its libLLVM

    patterns = [{"seed": 1}, {"seed": 2}, {"preset": "gallbladder"}, {"preset": "stomach", "seed": 3},
                {"base": [0.5, 0.4, 0.3]}, {"vessels": {"spacing_mm": 3.0}}]  # fmt: skip
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for tissue in patterns:
            session.update(scene(tissue=tissue, samples_per_pixel=4))
            frames.append(session.radiance().diffuse)
        launched = [kernel["hash"] for kernel in dr.kernel_history((dr.KernelType.JIT,))]
    assert session.rebuilds == 1
    # Dr.Jit orders a kernel's arguments at random, so that there are a few; with literals there would be six.
    assert len(launched) == len(patterns)
    assert len(set(launched)) <= 4
    assert np.abs(frames[0] - frames[1]).max() > 0.01 * frames[0].max()
    fresh = Session(scene(tissue=patterns[-1], samples_per_pixel=4), "llvm_ad_rgb").radiance().diffuse
    np.testing.assert_array_equal(fresh, frames[-1])


@pytest.mark.render
def test_light_bounces_off_the_same_colour():
    surface = {"type": "sphere", "radius_mm": 12.0, "distance_mm": 12.0, "side": "inside"}

    def bounced(reflectance):
        camera = {"width": 48, "height": 36, "fx": 45.0, "fy": 45.0}
        data = {"surface": surface, "camera": camera, "render": {"path_depth": 3, "samples_per_pixel": 4}}
        made = scene_from_dict({**data, "reflectance": {"type": "phong", "specular": 0.0, **reflectance}})
        return Session(made, "llvm_ad_rgb").radiance().indirect.mean(axis=(0, 1))

    tissue = bounced({"albedo": tissue_of(base=[0.6, 0.3, 0.2])})
    plain = bounced({"diffuse": 1.0, "colour": [0.6, 0.3, 0.2]})
    np.testing.assert_allclose(tissue, plain, rtol=0.02)
    # Vessels take light away.
    assert (bounced({"albedo": {"base": [0.6, 0.3, 0.2]}}) < tissue).all()


def test_without_visible_vessels_all_surfaces_have_the_pattern_that_vessels_of_no_strength_give():
    spec = TissueColour(vessels={"strength": 0.0})
    bare = make_pattern(surface_of("plane"), spec)
    assert make_pattern(surface_of("sphere"), spec) is bare
    surface = surface_of("quadric")
    patch = surface_patch(surface)
    grown = _make(patch, spec)
    assert grown.vessels.rows.any()
    points = spread_points(patch, 1.0, np.random.default_rng(2))[0]
    assert np.array_equal(bare.albedo(points), grown.albedo(points))
    # Vessels that are seen change it.
    assert not np.array_equal(bare.albedo(points), make_pattern(surface, TissueColour()).albedo(points))


def test_a_surface_too_small_for_two_nodes_has_no_vessels():
    """Each system is a root alone: there is nothing to draw, and the ground is left as it is."""
    surface = make_surface(
        scene_from_dict({"surface": {"type": "sphere", "radius_mm": 0.2, "distance_mm": 5.0}}).surface
    )
    forest = grow_vessels(surface_patch(surface), TissueColour().vessels, 3)
    assert forest.parent.tolist() == [-1, -1]
    assert not len(segments(forest).start)
    pattern = make_pattern(surface, TissueColour())
    points, _ = surface_patch(surface).draw(np.random.default_rng(1), 50)
    assert not pattern.vessels.chords(points).any()


def test_a_large_surface_gets_vessels_as_far_apart_as_its_warning_says(monkeypatch):
    monkeypatch.setattr(vessels, "MAX_POINTS", 2000)
    spec = TissueColour(vessels={"spacing_mm": 1.0}).vessels
    with pytest.warns(UserWarning, match=r"vessels stand 2 times as far apart") as caught:
        forest = grow_vessels(surface_patch(surface_of("plane")), spec, 1)
    factor = float(str(caught[0].message).split("stand ")[1].split()[0])
    ends = np.setdiff1d(np.arange(len(forest.parent)), forest.parent)
    for vein in (False, True):
        points = forest.position[ends[forest.vein[ends] == vein]]
        gap = np.linalg.norm(points[:, None] - points, axis=2)
        # Of one system; both share the surface.
        assert gap[gap > 0].min() > 0.95 * 0.8 * factor * np.sqrt(2)


# Debris ----------------------------------------------------------------------------------------------------------

WAVE = {"type": "breathing", "amplitude_mm": 1.5, "period_s": 4.0, "direction": [0, 1, 1], "along": [1, 0.5, 0],
        "wavelength_mm": 40.0}  # fmt: skip
DEBRIS = {"stool": 0.3, "bile": 0.25, "size_mm": 3.0}


def laid(pattern, points):
    """The albedo with what lies on it, and both shares, by the formulas of `DebrisPattern`."""
    field, row = pattern.debris.field, pattern.debris.numbers[9:]
    stool, bile = (np.clip(0.5 + (sign * field.at(points) - row[i]) / EDGE, 0, 1) for i, sign in enumerate((1, -1)))
    below = pattern.albedo(points) * np.exp(-bile[:, None] * row[8:])
    brown = row[5:8] * np.exp(-LUMPS * field.at(LUMP_SCALE * points))[:, None]
    return np.clip((1 - stool)[:, None] * below + stool[:, None] * brown, 0, 1), stool, bile


def test_debris_covers_the_told_shares_and_leaves_the_tissue_below():
    spec = TissueColour(debris=Debris(**DEBRIS))
    pattern, points = make_pattern(surface_of("plane"), spec), on_plane(40_000, 200)
    _, stool, bile = laid(pattern, points)
    assert (stool > 0.5).mean() == pytest.approx(0.3, abs=0.05)
    assert (bile > 0.5).mean() == pytest.approx(0.25, abs=0.05)
    assert not ((stool > 0) & (bile > 0)).any()
    np.testing.assert_array_equal(
        pattern.albedo(points), make_pattern(surface_of("plane"), TissueColour()).albedo(points)
    )
    # Where a share is 0 there is none; another seed lies elsewhere.
    bare = make_pattern(surface_of("plane"), TissueColour(debris=Debris(bile=0.2)))
    assert not laid(bare, points)[1].any()
    other = make_pattern(surface_of("plane"), TissueColour(debris=Debris(**DEBRIS), seed=1))
    assert np.mean((laid(other, points)[1] > 0.5) != (stool > 0.5)) > 0.2


@pytest.mark.render
@pytest.mark.parametrize(("deformation", "off"), [((), 3e-3), ((WAVE,), 1.5e-2)])
def test_a_frame_shows_what_lies_on_tissue_where_its_map_says(deformation, off):
    """By the formulas at the true points, at rest where the surface, then a mesh, is deformed."""
    lights = {"lights": [{}, {"offset_mm": 4.0, "power": 0.5}]}
    data = {
        "surface": SURFACES["sphere"],
        "camera": SMALL,
        "rig": lights,
        "deformation": list(deformation),
        "time_s": 0.6,
    }
    white, soiled = (
        {"type": "phong", "exponent": 5.0, "specular": 0.3, **base}
        for base in ({"diffuse": 1.0}, {"albedo": {"debris": DEBRIS}})
    )
    plain = Session(scene_from_dict({**data, "reflectance": white}), "llvm_ad_rgb")
    session = Session(scene_from_dict({**data, "reflectance": soiled}), "llvm_ad_rgb")
    clean, seen, truth = plain.radiance(), session.radiance(), session.truth()
    valid = truth.mask & (clean.diffuse.min(axis=-1) > 1e-6) & (clean.specular.min(axis=-1) > 1e-6)
    assert valid.sum() > 1000
    points = session.to_model(truth.position[valid])
    points = points if not deformation else session.surface.deformation.at_rest(points)
    albedo, stool, bile = laid(make_pattern(session.surface.at_rest, TissueColour(debris=Debris(**DEBRIS))), points)
    np.testing.assert_allclose(seen.diffuse[valid] / clean.diffuse[valid], albedo, atol=off)
    left = seen.specular[valid] / clean.specular[valid]
    np.testing.assert_allclose(left, np.repeat(1 - stool[:, None], 3, axis=1), atol=2 * off)
    np.testing.assert_allclose(session.debris()[:, valid], [stool, bile], atol=2 * off)
    assert min((stool > 0.9).mean(), (bile > 0.9).mean(), ((stool == 0) & (bile == 0)).mean()) > 0.05
    # Without debris again, the frame is that of a session that never had any.
    session.update(scene_from_dict({**data, "reflectance": {**soiled, "albedo": {}}}))
    fresh = Session(scene_from_dict({**data, "reflectance": {**soiled, "albedo": {}}}), "llvm_ad_rgb").radiance()
    np.testing.assert_array_equal(session.radiance().total, fresh.total)
    assert session.debris() is None


@pytest.mark.slow
@pytest.mark.render
def test_bounces_find_stool_without_its_lobe():
    surface = {"type": "sphere", "radius_mm": 12.0, "distance_mm": 12.0, "side": "inside"}

    def bounced(**debris):
        reflectance = {
            "type": "phong",
            "exponent": 5.0,
            "specular": 0.5,
            "albedo": tissue_of(**debris),
        }
        render = {"path_depth": 3, "samples_per_pixel": 8}
        camera = {"width": 48, "height": 36, "fx": 45.0, "fy": 45.0}
        made = {"surface": surface, "camera": camera, "render": render, "reflectance": reflectance}
        return Session(scene_from_dict(made), "llvm_ad_rgb").radiance().indirect.mean()

    black = {"base": [0.0, 0.0, 0.0]}
    soiled = bounced(**black, debris={"stool": 0.5, "stool_colour": [0.0, 0.0, 0.0]})
    # Nothing but the lobe reflects; both of its bounces must miss the stool.
    assert 0.1 < soiled / bounced(**black) < 0.5


def test_a_node_alone_on_its_side_of_a_wall_counts_as_flat():
    """On a bowl the curvature is 1/12; one more node, whose neighbours all face the other way, has none."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(400, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = 12 * normals
    alone = np.vstack([points, [[0.0, 0.0, 12.0]]]), np.vstack([normals, [[0.0, 0.0, -1.0]]])
    bent = vessels._shape_operators(*alone)
    np.testing.assert_array_equal(bent[-1], 0)
    # Where the neighbours are near on all sides the fit is that of a sphere.
    inner = normals[:, 2] > 0.99
    across = np.eye(3) - normals[inner, :, None] * normals[inner, None, :]
    np.testing.assert_allclose(bent[:-1][inner], across / 12, atol=2e-3)

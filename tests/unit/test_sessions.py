"""What a session promises: results hang on the scene alone, whatever it or its process did before, kept, or stopped."""

import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.rendering import Session, highlights, trace
from simtest.spec import scene_from_dict
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 64, "height": 48, "fx": 40.0, "fy": 40.0}
COLON = {"type": "anatomy", "path": "colon"}
ROUGH = {"type": "sphere", "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}}
INSIDE = {"type": "sphere", "radius_mm": 14.0, "side": "inside"}
LIGHTS = ({"position_mm": [1.0, 0.5, 0.0]}, {"position_mm": [-2.0, 1.0, 0.0]})
DENT = {"type": "dent", "amplitude_mm": -2.0, "period_s": 2.0, "direction": [0.2, 0, 1], "radius_mm": 5.0,
        "centre_mm": [1, 0, 0]}  # fmt: skip
WET = {"type": "tissue", "film": {"index": 1.35, "alpha": 0.1, "level": -1.0}}


def scene(surface, lights=LIGHTS, exponent=80.0, samples=1, **more):
    camera = CAMERA | {key: more.pop(key) for key in ("fx", "cx", "distortion", "view_mask") if key in more}
    render = {"samples_per_pixel": samples} | {key: more.pop(key) for key in ("seed", "path_depth") if key in more}
    reflectance = {"type": "phong", "exponent": exponent, "diffuse": 0.3}
    tables = {"surface": surface, "rig": {"lights": list(lights)}, "camera": camera, "render": render}
    return scene_from_dict(tables | {"reflectance": reflectance} | more)


def plain(value):
    """Return what can be compared byte by byte."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    return [plain(each) for each in value] if isinstance(value, list) else getattr(value, "tobytes", lambda: value)()


def everything(session, truth_first=True):
    """Return all that a session tells of its scene; the labels' hits are a start for the exact truth."""
    early = plain(session.truth()) if truth_first else None
    frame = session.frame()
    told = {"frame": plain(frame.radiance), "labels": plain(frame.labels), "radiance": plain(session.radiance())}
    told |= {"truth": early or plain(session.truth()), "points": plain(session.highlights(frame.radiance))}
    return told | {"base": plain(session.base_highlights(frame.radiance))}


SCENES = {
    "sphere": (ROUGH | {"relief": None}, {}),
    "colon": (COLON, {"samples": 3}),
    "saddle": ({"type": "quadric", "k1_per_mm": 0.06, "k2_per_mm": -0.04}, {"samples": 4}),
    "bounces": (INSIDE, {"samples": 5, "path_depth": 3, "lights": LIGHTS[:1]}),
    "lens": (INSIDE, {"distortion": {"type": "brown_conrady", "k1": -0.1}, "view_mask": {"radius": 20.0}}),
    "relief": (ROUGH, {}),
    "film": (ROUGH, {"reflectance": WET}),
    "deformed": (ROUGH, {"deformation": [DENT], "time_s": 0.7}),
    "instrument": ({"type": "plane"}, {"instruments": [{"tip": [0.3, 0.6], "depth_mm": 6.0, "diameter_mm": 1.0}]}),
}
CHANGES = {
    "film": {"reflectance": WET | {"film": WET["film"] | {"level": 1.0}}},
    "deformed": {"time_s": 1.2},
    "instrument": {"instruments": [{"kind": "grasper", "depth_mm": 6.0, "diameter_mm": 1.0}]},
}


@pytest.mark.parametrize("name", marked(SCENES, ci=["colon", "deformed", "lens"]))
def test_all_results_hang_on_the_scene_alone(name):
    surface, more = SCENES[name]
    session = Session(scene(surface, **more), labelled=True)
    first = everything(session)
    assert first["points"]
    assert everything(session, truth_first=False) == first
    session.update(scene(surface, **{**more, "exponent": 20.0, "seed": 7, **CHANGES.get(name, {})}))
    other = everything(session)
    assert other["radiance"] != first["radiance"]
    assert session.rebuilds == 1
    session.update(scene({"type": "plane"}))
    everything(session)
    session.update(scene(surface, **more))
    assert everything(session, truth_first=False) == first
    assert everything(Session(scene(surface, **more))) == first
    # With and without labels the light is the same to rounding.
    frame, radiance = session.frame().radiance, session.radiance()
    np.testing.assert_allclose(frame.total, radiance.total, rtol=1e-6, atol=1e-9)
    if more.get("samples", 1) > 1:
        session.update(scene(surface, **more, seed=1))
        assert plain(session.radiance()) != first["radiance"]


def test_another_kind_of_surface_is_built_and_a_shifted_camera_is_not():
    session = Session(scene(INSIDE, cx=32.0))
    before = session.truth().normal
    session.update(scene(INSIDE, cx=25.0))
    # A shift of the principal point by whole pixels is a shift of the picture.
    np.testing.assert_allclose(session.truth().normal[:, :57], before[:, 7:], atol=1e-12)
    assert session.rebuilds == 1
    session.update(scene({"type": "cylinder"}))
    assert session.rebuilds == 2


@pytest.mark.parametrize(
    ("samples", "tissue"), [(1, {}), (7, {}), pytest.param(8, {"albedo": {}}, marks=pytest.mark.ci)], ids=str
)
def test_the_launches_size_changes_nothing_of_direct_light(monkeypatch, samples, tissue):
    reflectance = {"type": "phong", "diffuse": 0.3} if not tissue else {"type": "phong", **tissue}
    session = Session(
        scene({"type": "sphere", "radius_mm": 6.0}, samples=samples, reflectance=reflectance), "llvm_ad_rgb"
    )
    whole, told = session.frame(), []
    monkeypatch.setattr(trace, "LANES", 1000)
    monkeypatch.setattr(trace, "RAYS", 3000)
    cut = session.frame(lambda done, total, what: told.append((done, total)))
    for part in ("specular", "diffuse", "indirect"):
        one, other = getattr(whole.radiance, part), getattr(cut.radiance, part)
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(whole.labels.depth, cut.labels.depth)
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    assert {total for _, total in told} == {told[-1][0]}
    assert len(told) > 3


def test_a_stopped_frame_and_a_refused_scene_leave_the_session_whole(monkeypatch):
    session = Session(scene(ROUGH, samples=4))
    whole = plain(session.radiance())
    monkeypatch.setattr(trace, "RAYS", 1)

    def stop(done, total, what):
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.radiance(stop)
    monkeypatch.undo()
    assert plain(session.radiance()) == whole
    press = {**DENT, "amplitude_mm": 30.0, "radius_mm": 30.0, "direction": [0, 0, 1]}
    with pytest.raises(InputError, match=r"deformation: the camera lies .* mm inside the wall at time_s = 1"):
        session.update(scene(ROUGH, samples=4, deformation=[press], time_s=1.0))
    assert plain(session.radiance()) == whole


@pytest.mark.parametrize("stage", ["_set_camera", "_write_values"])
@pytest.mark.parametrize("after", [0, 1], ids=["back", "again"])
def test_a_stopped_update_is_made_whole_by_the_next(stage, after, monkeypatch):
    scenes, made = (scene(ROUGH), scene(ROUGH, exponent=20.0, cx=25.0)), getattr(Session, stage)
    session = Session(scenes[0])

    def stop(self, *arguments):
        made(self, *arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Session, stage, stop)
        with pytest.raises(KeyboardInterrupt):
            session.update(scenes[1])
    session.update(scenes[after])
    assert plain(session.radiance()) == plain(Session(scenes[after]).radiance())


_TWO_VARIANTS = """
import numpy as np
from simtest.rendering import Session
from simtest.spec import scene_from_dict
def scene(tilt):
    return scene_from_dict({"surface": {"type": "plane", "tilt_deg": tilt},
        "reflectance": {"type": "phong", "diffuse": 0.3}, "camera": {"width": 32, "height": 24, "fx": 30, "fy": 30}})
def all_of(session):
    frame = session.frame()
    found = session.highlights(frame.radiance)
    points = session.exact_points(np.array([[16.0, 12.0]]))
    arrays = [session.radiance().total, frame.radiance.total, frame.labels.depth, session.truth().normal,
              found[0].bp_px, points.position]
    return [array.tobytes() for array in arrays]
mono = Session(scene(5.0), "llvm_ad_mono")
alone = all_of(mono)
colour = Session(scene(5.0), "llvm_ad_rgb")
for session, channels in ((mono, ()), (colour, (3,)), (mono, ())):
    assert session.radiance().total.shape == (24, 32, *channels)
for step in ("radiance", "frame", "highlights", "truth", "update"):
    colour.radiance()
    if step == "highlights":
        mono.highlights(radiance)
    elif step == "update":
        mono.update(scene(9.0))
        mono.update(scene(5.0))
    else:
        made = getattr(mono, step)()
        radiance = made if step == "radiance" else radiance
colour.frame()
assert all_of(mono) == alone
"""


@pytest.mark.slow
def test_sessions_of_two_variants_do_not_disturb_each_other():
    done = subprocess.run([sys.executable, "-c", _TWO_VARIANTS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_memory_does_not_grow_over_a_thousand_frames():
    """The last 950 of 1000 labelled frames of a moving light add less than 2 % to the resident memory."""
    session = Session(scene(COLON), labelled=True)
    if not Path("/proc/self/statm").exists():
        pytest.skip("the system does not tell the resident memory")
    sizes = []
    for i in range(1000):
        lights = ({"offset_mm": 1.0 + 1e-3 * i, "power": 1.0 + i},)
        session.update(scene(COLON, lights, 50.0 + 0.1 * i, 1 + i % 2))
        session.frame()
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]))
    assert np.median(sizes[-50:]) < 1.02 * np.median(sizes[50:100])


# What is kept between frames -----------------------------------------------------------------------------------------

STEPS = {
    "reflectance": lambda s: scene(s, exponent=20.0),
    "samples": lambda s: scene(s, samples=3),
    "lights": lambda s: scene(s, lights=LIGHTS[:1]),
    "camera": lambda s: scene(s, fx=50.0),
    "back": scene,
}
SEARCHED_AGAIN = {"lights", "camera", "back"}


@pytest.mark.parametrize(
    ("surface", "steps"),
    [
        pytest.param(COLON, ("reflectance", "lights"), id="colon", marks=pytest.mark.ci),
        pytest.param(COLON, tuple(STEPS), id="colon, all", marks=pytest.mark.slow),
        pytest.param(ROUGH, tuple(STEPS), id="rough"),
    ],
)
def test_highlights_are_searched_for_again_only_where_they_may_move(surface, steps, monkeypatch):
    searched = []
    search = highlights.search
    monkeypatch.setattr(highlights, "search", lambda s, base: searched.append(base) or search(s, base))
    kept = Session(scene(surface))
    kept.highlights(kept.frame().radiance)
    for name in steps:
        step = STEPS[name]
        kept.update(step(surface))
        searched.clear()
        found = everything(kept)
        assert (False in searched) == (name in SEARCHED_AGAIN), name
        assert found["points"], name
        assert found == everything(Session(step(surface))), name


@pytest.mark.parametrize("surface", [pytest.param(COLON, marks=pytest.mark.ci), ROUGH], ids=["colon", "rough"])
def test_highlights_that_get_their_radiance_later_stand_as_if_found_with_it(surface):
    session = Session(scene(surface))
    radiance = session.radiance()
    # Before the frame's own radiance, the session has seen others, in which many points are equally dark.
    session.highlights()
    found = session.highlights(radiance)
    assert highlights.is_resolved(session) if surface is ROUGH else session.surface.relief is None
    assert len(found) > 1
    direct = radiance.specular + radiance.diffuse
    assert all(point.radiance == direct[int(point.bp_px[1]), int(point.bp_px[0])] for point in found)
    searched = highlights.search(session, base=False)
    wanted = [replace(point, radiance=float(direct[int(point.bp_px[1]), int(point.bp_px[0])])) for point in searched]
    assert plain(found) == plain(sorted(wanted, key=lambda point: -point.radiance))
    assert all(point.radiance == 0 for point in session.highlights())

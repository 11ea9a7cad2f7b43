"""What a session keeps between frames: the results are those of a session that keeps nothing."""

from dataclasses import replace

import numpy as np
import pytest

from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session, highlights, lighting
from simtest.rendering.backend import colour_variant
from simtest.simulation.frame import DEAR_SAMPLES, quick_look, render_view, shows_isolated
from simtest.spec import scene_from_dict
from simtest.spec.recipes import Dataset
from simtest.spec.spec_model import validate
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 64, "height": 48, "fx": 40.0, "fy": 40.0}
COLON = {"type": "anatomy", "path": "colon"}
ROUGH = {"type": "sphere", "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}]}}
LIGHTS = ({"position_mm": [1.0, 0.5, 0.0]}, {"position_mm": [-2.0, 1.0, 0.0]})


def scene(surface, lights=LIGHTS, exponent=80.0, samples=1, **camera):
    tables = {"surface": surface, "rig": {"lights": list(lights)}, "camera": {**CAMERA, **camera}}
    tables["reflectance"] = {"type": "phong", "exponent": exponent, "diffuse": 0.3}
    return scene_from_dict(tables | {"render": {"samples_per_pixel": samples}})


def plain(value):
    return value.tobytes() if isinstance(value, np.ndarray) else value


def described(points):
    return [{name: plain(value) for name, value in vars(point).items()} for point in points]


def labels_of(session):
    return {name: plain(value) for name, value in vars(session.frame().labels).items()}


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
def test_highlights_and_labels_are_those_of_a_fresh_session(surface, steps, monkeypatch):
    searched = []
    search = highlights.search
    monkeypatch.setattr(highlights, "search", lambda s, base: searched.append(base) or search(s, base))
    kept = Session(scene(surface))
    kept.highlights(kept.frame().radiance)
    for name in steps:
        step = STEPS[name]
        kept.update(step(surface))
        searched.clear()
        radiance = kept.frame().radiance
        found, base = kept.highlights(radiance), kept.base_highlights(radiance)
        assert (False in searched) == (name in SEARCHED_AGAIN), name
        fresh = Session(step(surface))
        assert found, name
        assert described(found) == described(fresh.highlights(radiance)), name
        assert described(base) == described(fresh.base_highlights(radiance)), name
        assert labels_of(kept) == labels_of(fresh), name


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
    assert described(found) == described(sorted(wanted, key=lambda point: -point.radiance))
    assert all(point.radiance == 0 for point in session.highlights())


def test_a_changed_film_is_another_surface():
    def filmed(level):
        film = {"index": 1.35, "alpha": 0.1, "level": level}
        tables = {"surface": ROUGH, "camera": CAMERA, "reflectance": {"type": "tissue", "film": film}}
        return scene_from_dict(tables)

    kept = Session(filmed(-1.0))
    before = described(kept.highlights())
    kept.update(filmed(1.0))
    assert described(kept.highlights()) == described(Session(filmed(1.0)).highlights()) != before


# Datasets ------------------------------------------------------------------------------------------------------------

SET = {f"camera.{key}": value for key, value in CAMERA.items()} | {"render.samples_per_pixel": 2}
VIEWS = {"surface.viewpoint": {"low": 0, "high": 1000, "integer": True}}
BANDS = {"surface.relief.seed": {"low": 0, "high": 1000, "integer": True}}
RELIEF = {"surface.relief": {"bands": [{"slope_deg": 6.0, "wavelength_mm": 1.0}]}}
FAMILIES = {
    "colon": {"scene": "anatomy", "set": SET | {"surface.path": "colon"}, "per_sample": VIEWS},
    "liver": {"scene": "anatomy", "set": SET | {"surface.path": "liver"}, "per_sample": VIEWS},
    "rough": {"scene": "sphere", "set": SET | RELIEF, "per_sample": BANDS},
    "one sample": {"scene": "anatomy", "set": SET | {"render.samples_per_pixel": 1}, "per_sample": VIEWS},
}


def recipe(family, **values):
    described = {"name": "reuse", "samples": 3, "families": [FAMILIES[family]], "tries": 4} | values
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis", "circle_pose"]}
    return validate(Dataset, described, "reuse")


@pytest.mark.parametrize(
    ("family", "least"),
    [
        pytest.param("colon", 3, marks=pytest.mark.slow),
        pytest.param("liver", 3, marks=pytest.mark.ci),
        pytest.param("rough", 6, marks=pytest.mark.slow),
        ("one sample", 3),
    ],
)
def test_samples_are_the_same_bytes_without_reuse(family, least, monkeypatch):
    plan = Plan(recipe(family, highlights=least))
    kept = [Maker(plan).make(index) for index in range(1)] + [(maker := Maker(plan)).make(1), maker.make(2)]
    # Attempts were rejected, and not for want of light.
    assert any(sample.meta["attempt"] for sample in kept)
    update = Session.update

    def forgetful(session, scene):
        update(session, scene)
        session._forget()

    monkeypatch.setattr(Session, "update", forgetful)
    fresh = Maker(plan)
    for index, sample in enumerate(kept):
        assert fresh.make(index).encode() == sample.encode()


# Meanwhile: test_a_quick_look_is_taken_where_it_costs_less_than_the_frame.
@pytest.mark.parametrize("family", marked(["colon", "rough"], ci=["colon"], slow=["rough"]))
def test_a_frame_that_is_not_rendered_shows_too_few_highlights(family):
    plan = Plan(recipe(family))
    session = Session(plan.draw(0).scene)
    answers = []
    for attempt in range(6):
        drawn = plan.draw(0, attempt).scene
        shown = sum(highlight.isolated for highlight in render_view(session, drawn).highlights)
        for least in (1, shown, shown + 1):
            answers.append(shows_isolated(session, drawn, least))
            assert answers[-1] == (shown >= least), (attempt, least)
    assert set(answers) == {True, False}


# Which frames have a quick look ---------------------------------------------------------------------------------------

DISC = {"source": {"type": "disc", "radius_mm": 0.5}}


@pytest.mark.parametrize(
    ("samples", "depth", "light", "quick"),
    [
        (16, 2, DISC, False),
        (4, 2, DISC, False),
        (1, 2, DISC, False),
        (17, 2, DISC, True),
        (4, 3, DISC, True),
        (4, 2, {}, True),
    ],
)
def test_a_quick_look_is_taken_where_it_costs_less_than_the_frame(samples, depth, light, quick):
    drawn = scene(ROUGH, lights=[{**LIGHTS[0], **light}], samples=samples)
    effort = drawn.render.model_copy(update={"path_depth": depth})
    assert (quick_look(drawn.model_copy(update={"render": effort})) is not None) is quick


def test_the_quick_look_of_a_wide_source_takes_as_many_points_as_that_many_samples():
    """A control: datasets keep their draws where the renderer's numbers change, and this says that they have."""
    assert lighting.FIXED == lighting.DRAWN * DEAR_SAMPLES


@pytest.mark.parametrize("tries", [pytest.param(8, marks=pytest.mark.ci), 2])
def test_wide_sources_are_judged_by_the_frame_that_is_kept(tries, monkeypatch):
    bands = [{"slope_deg": 3.0, "wavelength_mm": 2.0}]
    wide = {"rig.lights": [{**LIGHTS[0], **DISC}], "render.samples_per_pixel": 4, "surface.relief": {"bands": bands}}
    tilts = {"surface.tilt_deg": {"low": 0.0, "high": 30.0}}
    described = {"name": "wide", "samples": 2, "seed": 1, "tries": tries, "estimators": ["cone_axis"]}
    described["families"] = [{"scene": "sphere", "set": SET | wide, "per_sample": tilts}]
    plan = Plan(validate(Dataset, described | {"splits": {"train": 1, "validation": 0, "test": 0}}, "wide"))

    def by_geometry(*asked, rendered):
        assert not rendered, "looked at twice"
        return shows_isolated(*asked, rendered=False)

    monkeypatch.setattr("simtest.dataset.maker.shows_isolated", by_geometry)
    maker, session, attempts = Maker(plan), Session(plan.draw(0).scene, colour_variant()), []
    for index in range(2):
        sample = maker.make(index)
        # Each draw's whole frame, until one shows a highlight.
        shown = []
        while len(shown) < tries and not any(shown):
            shown.append(render_view(session, plan.draw(index, len(shown)).scene).isolated)
        assert sample.meta["attempt"] == len(shown) - 1
        assert sum(bool(truth["isolated"]) for truth in sample.meta["highlights"]) == shown[-1]
        attempts.append((len(shown) - 1, shown[-1]))
    assert attempts == {8: [(3, 1), (0, 1)], 2: [(1, 0), (0, 1)]}[tries]

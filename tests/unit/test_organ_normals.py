"""The normal of the organ below its relief, stated beside that of the facet that shines."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from simtest import reconstruct
from simtest.calibration import Calibration, Priors
from simtest.calibration.priors import exactly
from simtest.cli.pictures import record_tables
from simtest.estimators.prior_parts import relief_part
from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.reconstruction.outputs import write_outputs
from simtest.reconstruction.page import write_picture_page
from simtest.validation.references import compare

CAMERA = Camera.from_fov(60.0, 160, 120)


def picture():
    y, x = np.mgrid[:120, :160] + 0.5
    return np.exp(-((x - 70) ** 2 + (y - 55) ** 2) / 200).astype(np.float32)


def found(slope_deg=None, **options):
    priors = Priors() if slope_deg is None else Priors(relief_slope=exactly(np.radians(slope_deg)))
    return reconstruct(picture(), Calibration(CAMERA, priors=priors), **options)


@pytest.mark.parametrize("slope_deg", [None, 0.0, 6.0])
def test_it_is_the_same_normal_with_the_relief_in_its_budget(slope_deg):
    (spot,) = found(slope_deg)
    relief = relief_part(Priors() if slope_deg is None else Priors(relief_slope=exactly(np.radians(slope_deg))))
    assert spot.organ.keys() == spot.normals.keys()
    for name, fine in spot.normals.items():
        organ = spot.organ[name]
        assert (fine.target, organ.target) == ("fine", "base")
        np.testing.assert_array_equal(organ.normal, fine.normal)
        if fine.covariance is None:
            assert organ.covariance is None
        else:
            np.testing.assert_allclose(organ.covariance, fine.covariance + relief, rtol=1e-9)
    # Asked for the base's normals, the estimates are these.
    (base,) = found(slope_deg, target="base")
    for name, organ in spot.organ.items():
        np.testing.assert_array_equal(base.normals[name].normal, organ.normal)
        assert (base.normals[name].covariance is None) == (organ.covariance is None)
    assert base.organ[base.best] is base.normals[base.best]


def test_files_state_both(tmp_path):
    spots = found(6.0)
    write_outputs(tmp_path, spots, picture())
    told = json.loads((tmp_path / "normals.json").read_text())
    assert told["stated_of_organ"]["parts_deg"]["relief"] > 6.0
    assert told["stated"]["median_deg"] < told["stated_of_organ"]["median_deg"]
    assert "slope of the relief" in {each["what"] for each in told["assumed"]}
    for row in csv.DictReader((tmp_path / "normals.csv").read_text().splitlines()):
        fine, organ = (row[name] for name in ("deviation_deg", "organ_deviation_deg"))
        assert (fine == "") == (organ == "")
        if fine:
            entry = told["specularities"][int(row["specularity"])]["estimates"][row["estimator"]]
            trace = np.trace(entry["organ_covariance"])
            assert float(organ) == pytest.approx(np.degrees(np.sqrt(trace)), rel=1e-9)
            assert float(fine) < float(organ)


@pytest.mark.parametrize(("off_deg", "inside", "inside_organ"), [(0.0, 1.0, 1.0), (14.0, 0.0, 1.0), (60.0, 0.0, 0.0)])
def test_a_reference_is_held_against_both_regions(off_deg, inside, inside_organ):
    class Tilted:
        source, notes = "tilted", ()

        def normals_at(self, pixels, camera):
            normal = spots[0].best_estimate.normal
            turned = normal + np.tan(np.radians(off_deg)) * tangent_basis(normal[None])[0][0]
            return np.tile(turned / np.linalg.norm(turned), (len(pixels), 1))

    spots = found(6.0)
    spots[:] = [replace(spot, estimates={spot.best: spot.best_estimate}) for spot in spots]
    compare(spots, Tilted())
    (summary,) = spots.reference.estimators.values()
    assert (summary.inside, summary.inside_organ) == (inside, inside_organ)


def rule_and_rows(priors):
    """Return which estimators are one rule, and the table's rows against a reference that faces the camera."""

    class Facing:
        source, notes = "facing", ()

        def normals_at(self, pixels, camera):
            return np.tile([0.0, 0.0, -1.0], (len(pixels), 1))

    spots = reconstruct(
        picture(), Calibration(CAMERA, priors=priors), estimators=["brightest_point", "cone_axis", "curved"]
    )
    compare(spots, Facing())
    return spots, spots.sightline_rule, list(spots.reference.rows)


def test_estimators_that_are_the_reversed_sightline_are_one_row(tmp_path):
    spots, rule, rows = rule_and_rows(Priors())
    assert set(rule) == {"brightest_point", "cone_axis", "curved"}
    assert rows == ["sightline rule"]
    assert spots.reference.rows["sightline rule"].mean_deg == spots[0].reference.errors[spots[0].best].error_deg
    assert set(spots.reference.estimators) == set(rule)
    assert "are one sightline rule: they differ" in spots.rule_note
    page = tmp_path / "index.html"
    write_picture_page(page, spots, np.zeros((10, 10, 3), np.float32))
    data = json.loads(page.read_text().partition('type="application/json">')[2].partition("</script>")[0])
    assert ([row["name"] for row in data["spots"][0]["rows"]], [*data["colours"]]) == (rows, rows)
    assert data["spots"][0]["best"] == "sightline rule"
    assert "simtest calibrate light finds the light" in page.read_text()
    assert "<td>sightline rule</td>" in spots._repr_html_()
    assert next(record_tables(spots)).rows[0][5] == "sightline rule"


def test_with_a_light_beside_the_camera_each_estimator_has_its_row():
    spots, rule, rows = rule_and_rows(Priors(lights_mm=((4.0, 0.0, 0.0),), distance_mm=exactly(30.0)))
    assert (rule, spots.rule_note) == ((), "")
    assert set(rows) == {"brightest_point", "cone_axis", "curved"}


def glitter(count=60):
    """A picture of tissue that faces the camera at one pixel, with spots about it, or about nothing, 8 bits."""
    camera = Camera(320, 240, 200.0, 200.0, 160.0, 120.0)
    y, x = np.mgrid[:240, :320] + 0.5
    rng, points = np.random.default_rng(3), []
    while len(points) < count:
        point = rng.normal((150.0, 110.0), 16.0)
        if all(np.hypot(*(point - other)) > 5.0 for other in points):
            points.append(point)
    ground = 0.35 * np.exp(-((x - 150) ** 2 + (y - 110) ** 2) / (2 * 110.0**2))
    spots = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 4.5) for u, v in points)
    light = ground[..., None] * np.array([1.0, 0.5, 0.4]) + np.asarray(spots)[..., None]
    light += 0.003 * rng.standard_normal(light.shape)
    return np.rint(255 * np.clip(light, 0, 1) ** (1 / 2.2)).astype(np.uint8), camera


def test_a_picture_tells_the_organs_normal_without_being_asked(tmp_path):
    picture, camera = glitter()
    spots = reconstruct(picture, camera)
    (cloud,) = spots.clouds
    estimate = cloud.normals["cloud"]
    assert estimate.target == "base"
    np.testing.assert_array_equal(cloud.position_px, estimate.look_px)
    x, y = np.round(estimate.look_px).astype(int)
    count = len(estimate.cloud.points_px)
    told = f"at ({x}, {y}) px ± {estimate.deviation_deg:.2g} deg, from {count} highlights (no. {cloud.id})"
    assert spots.of_organ == f"the organ's normal is told {told}"
    assert spots.to_json()["no_cloud"] is None
    assert all("cloud" not in spot.estimates for spot in spots if spot is not cloud)

    class Facing:
        source, notes = "facing", ()

        def normals_at(self, pixels, camera):
            assert any(np.allclose(pixel, estimate.look_px) for pixel in pixels)
            return -camera.unproject(pixels)

    compare(spots, Facing())
    assert spots.reference.estimators["cloud"].inside == 1.0
    assert spots.reference.estimators["cloud"].mean_deg < 10.0


def test_where_no_cloud_tells_it_one_line_says_why():
    """And no highlight has a failure that nobody asked for."""
    picture, camera = glitter(4)
    spots = reconstruct(picture, camera)
    assert spots.clouds == []
    assert spots.of_organ == f"no cloud of highlights tells the organ's normal: {spots.no_cloud.detail}"
    assert spots.to_json()["no_cloud"] == spots.no_cloud.detail
    assert "a cloud takes 6" in spots.of_organ
    assert all("cloud" not in spot.estimates for spot in spots)
    # Who asks for it gets its failure at each highlight, and a part of a picture is not asked for it.
    assert not reconstruct(picture, camera, estimators=["cone_axis", "cloud"])[0].normals.get("cloud")
    assert reconstruct(picture, camera, estimators=["cone_axis"]).of_organ == ""
    assert reconstruct(picture, camera, roi=(100, 60, 100, 100)).of_organ == ""

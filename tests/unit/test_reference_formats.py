"""References in the formats of public data sets: small samples made in each format, and malformed ones."""

import cv2
import numpy as np
import pytest

from simtest.errors import InputError
from simtest.geometry import Camera, KannalaBrandt
from simtest.validation.references import FORMATS, load_map_reference, load_reference

SIZES = {"c3vd": (270, 216), "simcol3d": (190, 190), "ucl": (256, 256), "endoslam": (320, 320)}


RADIUS_MM, CENTRE_MM = 25.0, np.array([4.0, -3.0, 45.0])


def camera(name):
    """Return a camera of the format's shape; C3VD's frames are those of a wide-angle lens."""
    width, height = SIZES[name]
    focal = 0.48 * width
    lens = KannalaBrandt(0.02, -0.01, 0.002, 0.0) if name == "c3vd" else None
    return Camera(width, height, focal, focal, width / 2, height / 2, distortion=lens)


def ball(name):
    """Return depth along the axis, mm, distance, mm, and normals of a ball seen from outside, NaN beside it."""
    rays = camera(name).unproject(camera(name).pixel_centres())
    along = rays @ CENTRE_MM
    inside = along**2 - CENTRE_MM @ CENTRE_MM + RADIUS_MM**2
    distance = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.nan)
    normal = (rays * distance[..., None] - CENTRE_MM) / RADIUS_MM
    return distance * rays[..., 2], distance, normal


def counts(values, step, depth_type):
    return np.nan_to_num(values / step).round().astype(depth_type)


def write_normals(path, normal):
    scaled = np.nan_to_num((normal + 1) / 2 * 65535).astype(np.uint16)
    cv2.imwrite(str(path), scaled[..., ::-1])
    return path


def write_depth(folder, name, depth=None, step=None):
    """Write a depth map in a format; a scale of 0.4 mm a count where the format tells none."""
    form = FORMATS[name]
    values = counts(ball(name)[0] if depth is None else depth, step or form.step_mm or 0.4, form.depth_type)
    if form.channels == 4:
        values = np.dstack([values] * 3 + [np.full_like(values, 255)])
    path = folder / f"0007{form.depths if form.normals else '.png'}"
    cv2.imwrite(str(path), values)
    return path


def scale(name):
    return None if FORMATS[name].step_mm else 0.4


def errors_deg(found, truth):
    both = np.isfinite(found).all(axis=-1) & np.isfinite(truth).all(axis=-1)
    assert both.sum() > 1000
    return np.degrees(np.arccos(np.clip((found[both] * truth[both]).sum(axis=-1), -1, 1)))


@pytest.mark.parametrize(("name", "worst"), [("c3vd", 0.2), ("simcol3d", 0.3)])
def test_depths_of_16_bits_give_the_normals(tmp_path, name, worst):
    reference = load_map_reference(write_depth(tmp_path, name), name, camera(name))
    assert np.median(errors_deg(reference.map, ball(name)[2])) < worst
    assert list(reference.notes) == list(FORMATS[name].cautions)


@pytest.mark.parametrize("name", ["ucl", "endoslam"])
def test_depths_of_8_bits_are_judged_as_too_coarse(tmp_path, name):
    reference = load_map_reference(write_depth(tmp_path, name), name, camera(name), 0.4)
    assert any("too coarse" in note or "degenerate" in note for note in reference.notes)


@pytest.mark.parametrize("first", ["depth", "normals"])
def test_the_normal_map_of_c3vd_agrees_with_its_depths(tmp_path, first):
    depth = write_depth(tmp_path, "c3vd")
    normals = write_normals(tmp_path / "0007_normals.tiff", ball("c3vd")[2])
    path = depth if first == "depth" else normals
    reference = load_reference(path, None, camera("c3vd"), None, "c3vd")
    assert np.median(errors_deg(reference.map, ball("c3vd")[2])) < (0.2 if first == "depth" else 0.01)
    assert not any("differ" in note for note in reference.notes)


FLIPS = {
    "y points up": (np.diag([1.0, -1.0, 1.0]), "x,-y,z"),
    "z points back": (np.diag([1.0, 1.0, -1.0]), "x,y,-z"),
    "x and y are swapped": (np.eye(3)[[1, 0, 2]], "y,x,z"),
    "inwards": (-np.eye(3), "-x,-y,-z"),
}


@pytest.mark.parametrize("fault", FLIPS)
def test_normals_in_other_axes_are_told_with_the_axes_that_fit(tmp_path, fault):
    turned, axes = FLIPS[fault]
    depth = write_depth(tmp_path, "c3vd")
    write_normals(tmp_path / "0007_normals.tiff", ball("c3vd")[2] @ turned.T)
    (told,) = (note for note in load_map_reference(depth, "c3vd", camera("c3vd")).notes if "differ" in note)
    assert f"channels that hold {axes}" in told


def test_depths_along_the_sightline_are_told_by_the_normal_map(tmp_path):
    depth = write_depth(tmp_path, "c3vd", ball("c3vd")[1])
    write_normals(tmp_path / "0007_normals.tiff", ball("c3vd")[2])
    notes = load_map_reference(depth, "c3vd", camera("c3vd")).notes
    assert any("depths along the sightline, in place of the optical axis, would fit" in note for note in notes)


def test_clipped_and_missing_depths_are_none(tmp_path):
    depth = ball("c3vd")[0].copy()
    depth[:60], depth[60:80] = 100.0, np.nan
    reference = load_map_reference(write_depth(tmp_path, "c3vd", depth), "c3vd", camera("c3vd"))
    assert np.isnan(reference.map[:80]).all()
    assert np.isfinite(reference.map[90:]).any()


def test_a_facing_wall_of_rendered_depths_is_degenerate(tmp_path):
    wall = np.full(SIZES["simcol3d"][::-1], 40.0)
    reference = load_map_reference(write_depth(tmp_path, "simcol3d", wall), "simcol3d", camera("simcol3d"))
    assert any(note.startswith("degenerate") for note in reference.notes)


C3VD = SIZES["c3vd"][::-1]
DEPTHS, NORMALS = "0007_depth.tiff", "0007_normals.tiff"
MALFORMED = {
    "8 bits": (DEPTHS, np.full(C3VD, 9, np.uint8), "holds uint8; a depth map of this format holds uint16"),
    "only clipped": (DEPTHS, np.full(C3VD, 65535, np.uint16), "holds no depth; counts 0, 65535 stand for none"),
    "colours": (DEPTHS, np.dstack([np.full(C3VD, 9 + i, np.uint16) for i in range(3)]), "channels differ"),
    "no picture": (DEPTHS, b"II*\0 nothing", "no picture|cannot be decoded"),
    "missing": (DEPTHS, None, "does not exist|cannot be read|no such"),
    "another size": (DEPTHS, np.full((50, 60), 40, np.uint16), "is 60 x 50 px: must be 270 x 216"),
    "grey normals": (NORMALS, np.full(C3VD, 9, np.uint16), "a normal map has three channels"),
    "normals of no length": (NORMALS, np.full((*C3VD, 3), 32767, np.uint16), "holds no unit vector"),
}


@pytest.mark.parametrize("what", MALFORMED)
def test_malformed_maps_are_refused_in_one_line(tmp_path, what):
    name, content, told = MALFORMED[what]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        cv2.imwrite(str(path), content)
    with pytest.raises(InputError, match=told) as error:
        load_map_reference(path, "c3vd", camera("c3vd"))
    assert "\n" not in str(error.value)


TOLD = [
    ("c3vd", "c3vd", 0.1, "--depth-scale 0.1: c3vd has its own, 0.0015259 mm a count"),
    ("ucl", "ucl", None, "ucl does not tell its unit; --depth-scale must say"),
    ("ucl", "ucl", -1.0, "--depth-scale -1: must be 1e-9 to 1e.06 mm"),
    ("ucl", "c3vd2", None, r"--reference-format c3vd2: unknown; allowed: .* \(did you mean c3vd"),
]


@pytest.mark.parametrize(("written", "named", "given", "told"), TOLD)
def test_scales_and_names_that_do_not_fit_are_refused(tmp_path, written, named, given, told):
    with pytest.raises(InputError, match=told):
        load_map_reference(write_depth(tmp_path, written), named, camera(written), given)


def test_a_camera_of_another_shape_is_refused(tmp_path):
    with pytest.raises(InputError, match="the camera is of 256 x 256 px; frames of c3vd are of 1350 x 1080 px"):
        load_map_reference(write_depth(tmp_path, "c3vd"), "c3vd", camera("ucl"))
    # What is missing has no size.
    with pytest.raises(InputError, match=r"none\.tiff: no such file; must be a map of c3vd"):
        load_map_reference(tmp_path / "none.tiff", "c3vd", camera("ucl"))


@pytest.mark.parametrize(
    ("path", "what"),
    [(None, "needs --reference, the map"), ("liver.ply", "is for maps; --reference .*liver.ply is a mesh")],
)
def test_a_format_without_a_map_is_refused(tmp_path, path, what):
    with pytest.raises(InputError, match=what):
        load_reference(None if path is None else tmp_path / path, None, camera("ucl"), None, "c3vd")

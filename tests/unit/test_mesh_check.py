"""What is wrong with a user's mesh: said aloud, mended, or refused; and whether it is fine enough."""

import math

import numpy as np
import pytest
import trimesh

from simtest.errors import InputError
from simtest.surfaces.mesh_check import check_mesh
from simtest.surfaces.mesh_file import examine, read_mesh, repair
from simtest.surfaces.mesh_surface import (
    EDGES_PER_HALF_WIDTH,
    concentration,
    half_width,
    prepare,
)

C = concentration(10.0)


def ball(level=3, radius=40.0):
    mesh = trimesh.creation.icosphere(level, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces)


def save(path, vertices, faces):
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path


def said(verdict):
    return "\n".join(verdict.lines())


def test_a_good_mesh_needs_no_repair(tmp_path):
    verdict = check_mesh(save(tmp_path / "ball.ply", *ball(5)), 50.0, C)
    assert not list(verdict.repairs.sentences())
    assert verdict.condition.to_json() == {
        "watertight": True, "pieces": 1, "open_edges": 0, "non_manifold_edges": 0, "crossing_faces": 0
    }  # fmt: skip
    assert verdict.usable
    assert verdict.fine_share == 1
    np.testing.assert_allclose(verdict.extents_mm, 80, rtol=0.01)


def test_open_edges_pieces_crossings_and_fins_are_said_and_no_good(tmp_path):
    vertices, faces = ball()
    count, cap = len(vertices), vertices[faces].mean(axis=1)[:, 2] < 20
    apart, through = (np.vstack([vertices, vertices + shift]) for shift in ([200.0, 0, 0], [30.0, 3, 2]))
    fin = np.vstack([faces, [[faces[0, 0], faces[0, 1], count]]])
    two, crossed, finned = (
        check_mesh(save(tmp_path / f"{name}.ply", *mesh), 30.0, C)
        for name, mesh in {
            "two": (apart, np.vstack([faces[cap], faces + count])),
            "crossed": (through, np.vstack([faces, faces + count])),
            "fin": (np.vstack([vertices, [[90.0, 0, 0]]]), fin),
        }.items()
    )
    assert two.condition.pieces == 2
    assert two.condition.open_edges > 10
    assert not two.condition.watertight
    assert f"open: {two.condition.open_edges} edges at its rims" in said(two)
    assert "pieces      2" in said(two)
    assert crossed.condition.crossing_faces > 50
    assert "faces cut through others" in said(crossed)
    with pytest.warns(UserWarning, match="faces cut through others"):
        prepare(tmp_path / "crossed.ply", 0)
    assert finned.condition.non_manifold_edges == 1
    assert "1 edges belong to more than two faces" in said(finned)
    assert not crossed.usable
    assert not finned.usable


def test_each_repair_is_counted_and_said(tmp_path):
    vertices, faces = ball()
    flip = np.zeros(len(faces), dtype=bool)
    flip[:100] = True
    doubled = np.vstack([vertices, vertices[:7]])
    used = faces.copy()
    used[200:260][used[200:260] < 7] += len(vertices)
    bad = np.vstack([np.where(flip[:, None], used[:, ::-1], used), faces[300:304], [[0, 0, 1], [3, 3, 3]]])
    _, mended, repairs = repair(doubled, bad)
    assert len(mended) == len(faces)
    assert repairs.reversed_faces == 100
    assert repairs.repeated_faces == 4
    assert repairs.faces_without_area == 2
    assert repairs.merged_vertices == len(np.unique(bad)) - len(vertices)
    assert trimesh.Trimesh(vertices, mended, process=False).volume > 0
    path = save(tmp_path / "bad.ply", doubled, bad)
    with pytest.warns(
        UserWarning, match="left out 2 faces without area; left out 4 repeated faces; reversed 100 faces"
    ):
        prepare(path, 0)
    text = said(check_mesh(path, 30.0, C))
    for fragment in ("repaired    left out 2 faces without area", "reversed 100 faces that wind against"):
        assert fragment in text


def test_inside_out_is_turned_and_said_unless_it_is_a_lumen():
    vertices, faces = ball()
    _, mended, repairs = repair(vertices, faces[:, ::-1])
    assert trimesh.Trimesh(vertices, mended, process=False).volume > 0
    assert repairs.turned_pieces == 1
    assert repairs.reversed_faces == 0
    assert list(repairs.sentences()) == ["turned 1 piece that was inside out"]
    assert not list(repairs.sentences(lumen=True))


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "metres"), (2e-2, "metres|centimetres"), (0.1, "centimetres")])
def test_another_unit_than_mm_is_guessed(tmp_path, scale, unit):
    vertices, faces = ball(3, 45.0)
    path = save(tmp_path / "unit.ply", vertices * scale, faces)
    if 90 * scale < 1:
        with pytest.raises(InputError, match=f"lengths are in mm; if the file is in {unit}"):
            read_mesh(path)
    else:
        verdict = check_mesh(path, 30.0, C)
        assert not verdict.usable
        assert any(name in said(verdict) for name in unit.split("|"))
        with pytest.warns(UserWarning, match="by its extent the file may be in"):
            prepare(path, 0)


def test_large_meshes_are_not_searched_and_it_is_said(tmp_path, monkeypatch):
    path = save(tmp_path / "ball.ply", *ball())
    monkeypatch.setattr("simtest.surfaces.mesh_file.MAX_CROSSING_FACES", 100)
    monkeypatch.setattr("simtest.surfaces.mesh_check.MAX_CURVATURE_FACES", 100)
    verdict = check_mesh(path, 30.0, C)
    assert verdict.condition.crossing_faces is None
    assert not verdict.usable
    assert "crossings   not looked for" in said(verdict)
    assert "highlights  not looked at above" in said(verdict)


def test_half_width_is_that_of_the_theory():
    # Phong on a plane: cos^n(2 theta) = 1/2 at theta = half-width / d.
    theta = 0.5 * math.acos(0.5 ** (1 / 500.0))
    assert half_width(30.0, concentration(500.0), 0.0) == pytest.approx(30 * math.tan(theta), rel=2e-3)
    assert half_width(30.0, C, 1 / 30) == pytest.approx(half_width(30.0, C, 0.0) / 2)
    # GGX with light at the camera: D ~ (alpha^2 + (1 - alpha^2) sin^2)^-2.
    alpha, h = 0.2, 1e-4
    log = [-2 * math.log(alpha**2 + (1 - alpha**2) * math.sin(x) ** 2) for x in (-h, 0.0, h)]
    assert concentration(None, alpha) == pytest.approx(-(log[0] - 2 * log[1] + log[2]) / h**2, rel=1e-4)


def test_the_verdict_follows_the_edges(tmp_path):
    """On a sphere of R = d the half-width is half that of a plane, everywhere the same."""
    for level, fine in ((3, False), (4, False), (5, True)):
        verdict = check_mesh(save(tmp_path / f"{level}.ply", *ball(level, 30.0)), 30.0, C)
        expected = half_width(30.0, C, 1 / 30) / EDGES_PER_HALF_WIDTH
        assert verdict.needed_edge_mm == pytest.approx(expected, rel=0.02)
        assert verdict.fine == fine
        assert verdict.fine_share == fine
        assert (verdict.edge_p95_mm < expected) == fine
        assert ("fine enough" in said(verdict)) == fine


def test_lobes_are_given_once_and_in_range():
    assert concentration(None, None) == 800
    assert concentration(None, 0.2) == pytest.approx(96)
    for exponent, alpha in ((50.0, 0.2), (0.0, None), (None, 1.0), (float("nan"), None)):
        with pytest.raises(InputError):
            concentration(exponent, alpha)


def test_real_meshes_are_found_sound(shared_data):
    for name, pieces in (("colon_edingca_00090", 1), ("liver_sksurgery", 6)):
        vertices, faces, repairs = read_mesh(shared_data / "meshes" / f"{name}.ply")
        found = examine(vertices, faces)
        assert found.watertight
        assert found.crossing_faces == 0
        assert found.pieces == pieces
        assert not list(repairs.sentences())


@pytest.mark.slow
def test_five_million_faces_are_checked_in_bounded_memory(tmp_path):
    """In a child process, so that its own peak is measured."""
    import json
    import subprocess
    import sys

    side = 1582
    x, y = np.meshgrid(np.arange(side, dtype="f4"), np.arange(side, dtype="f4"), indexing="ij")
    points = np.stack([x, y, 30 * np.sin(x / 60) * np.sin(y / 60)], axis=-1).reshape(-1, 3) * 0.1
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.empty(2 * len(corner), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = np.concatenate(
        [np.stack([corner, corner + side, corner + side + 1], 1), np.stack([corner, corner + side + 1, corner + 1], 1)]
    )
    faces = faces[:5_000_000]
    assert len(faces) > 4_990_000
    path = tmp_path / "huge.ply"
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + points.astype("<f4").tobytes() + faces.tobytes())
    code = (
        "import json, resource, sys\nfrom simtest.surfaces.mesh_check import check_mesh\n"
        "verdict = check_mesh(sys.argv[1], 30.0, 800.0)\n"
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024\n"
        "print(json.dumps({'lines': list(verdict.lines()), 'peak': peak}))"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    result = json.loads(done.stdout)
    assert any(line.startswith("highlights  not looked at above") for line in result["lines"])
    assert result["peak"] < 5e9

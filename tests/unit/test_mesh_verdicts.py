"""The verdict on a user's mesh in an experiment: at whose distance, for whose lobe, told once."""

import re
import warnings

import numpy as np
import pytest
import trimesh

from simtest.cli.main import MANNERS
from simtest.cli.runs import validate
from simtest.spec import Experiment, Group
from simtest.surfaces.mesh_check import check_mesh
from simtest.surfaces.mesh_surface import concentration
from simtest.validation.mesh_verdicts import MeshVerdict, mesh_verdicts


def ball(level=2):
    return trimesh.creation.icosphere(subdivisions=level, radius=20)


@pytest.fixture
def path(tmp_path):
    ball().export(tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


def experiment(**values):
    return Experiment(name="x", groups=(Group(scene="anatomy", set=values), Group(scene="plane")))


@pytest.mark.parametrize(
    ("kind", "distance", "alpha"), [("lumen", 10, None), ("organ", 40, None), ("organ", 40, 0.03), ("organ", 40, 0.15)]
)
def test_a_mesh_is_judged_at_the_distance_of_its_nearest_viewpoints_and_for_its_lobe(path, kind, distance, alpha):
    lobe = {} if alpha is None else {"reflectance.type": "rough_plastic", "reflectance.alpha": alpha}
    (verdict,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.kind": kind}, **lobe))
    told = re.search(r"edges of (\S+) mm are needed at (\d+) mm", verdict.verdict)
    width = concentration(200.0, None) if alpha is None else concentration(None, alpha)
    expected, elsewhere = (check_mesh(path, d, width, kind).needed_edge_mm for d in (distance, 30.0))
    assert float(told[1]) == pytest.approx(expected, rel=0.05 if alpha is None else 0.1)
    assert int(told[2]) == distance
    assert expected != pytest.approx(elsewhere, rel=0.1)


def test_an_experiment_judges_its_mesh_files_once(path, monkeypatch):
    assert mesh_verdicts(experiment()) == []
    assert mesh_verdicts(experiment(**{"surface.path": "liver"})) == []
    (coarse,) = mesh_verdicts(experiment(**{"surface.path": str(path)}))
    assert not coarse.usable
    assert str(coarse).startswith(f"mesh {path}: too coarse: edges of 0.")
    assert str(coarse).endswith(" mm are needed at 40 mm (surface.edge_mm); taken for an organ, camera outside")
    assert coarse.model_dump() == {"file": str(path), "usable": False, "verdict": coarse.verdict}
    (refined,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.edge_mm": "auto"}))
    assert refined.usable
    assert re.fullmatch(
        r"refined to edges of 0\.\d+ mm by surface.edge_mm = auto, at most 0\.\d+ mm are needed at 40 mm; "
        "taken for an organ, camera outside",
        refined.verdict,
    )
    # One that would need more faces than are allowed is not fine enough, and says so.
    monkeypatch.setattr("simtest.surfaces.mesh_surface.MAX_SUBDIVIDED_FACES", 1500)
    (limited,) = mesh_verdicts(experiment(**{"surface.path": str(path), "surface.edge_mm": "auto"}))
    assert not limited.usable
    assert ": too coarse, 0." in limited.verdict
    # What is no table is told by whoever reads the scene.
    assert mesh_verdicts(experiment(surface=5)) == []
    # A wide lobe needs no fine mesh.
    ball(5).export(path)
    (fine,) = mesh_verdicts(experiment(**{"surface.path": str(path), "reflectance.exponent": 2.0}))
    assert (fine.usable, fine.verdict) == (True, "fine enough; taken for an organ, camera outside")
    # Two lobes of one verdict are told once, and two verdicts of one file both.
    values = {"surface.path": str(path)}
    groups = [Group(scene="anatomy", set={**values, "reflectance.exponent": n}) for n in (2.0, 3.0, 9e4)]
    assert mesh_verdicts(Experiment(name="x", groups=groups[:2])) == [fine]
    both = mesh_verdicts(Experiment(name="x", groups=groups))
    assert [each.usable for each in both] == [True, False]


def test_an_open_tube_that_is_taken_for_an_organ_is_warned_of(tmp_path):
    """Seen from outside it yields fine figures, of the wrong side."""
    path = tmp_path / "tube.ply"
    # Two thirds of a ring, so that its shape is not slender.
    around, along = 40, 60
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0, 4, along))
    across = 25 + 12 * np.cos(u)
    points = np.stack([across * np.cos(v), across * np.sin(v), 12 * np.sin(u)], axis=-1).reshape(-1, 3)
    k, ring = np.meshgrid(np.arange(along - 1) * around, np.arange(around), indexing="ij")
    a, b = (k + ring).ravel(), (k + (ring + 1) % around).ravel()
    quads = np.stack([a, b, b + around, a + around], axis=1)
    tube = trimesh.Trimesh(points, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]), process=False)
    tube.export(path)
    values = {"surface.path": str(path), "reflectance.exponent": 2.0}
    (guessed,) = mesh_verdicts(experiment(**values))
    assert not guessed.usable
    assert "taken for an organ, camera outside; open at 2 rims, as a tube is" in guessed.verdict
    assert "surface.kind=lumen" in guessed.verdict
    for kind, side in (("lumen", "a lumen, camera inside"), ("organ", "an organ, camera outside")):
        (stated,) = mesh_verdicts(experiment(**values, **{"surface.kind": kind}))
        assert "rims" not in stated.verdict
        assert f"taken for {side}" in stated.verdict
    # A hole of a scan is no end of a tube.
    holed = ball()
    holed.update_faces((holed.vertices[holed.faces].mean(axis=1)[:, :2] ** 2).sum(axis=1) > 4)
    holed.export(path)
    (organ,) = mesh_verdicts(experiment(**values))
    assert "rims" not in organ.verdict


@pytest.mark.parametrize("quiet", [False, True])
def test_the_command_tells_each_verdict_once(tmp_path, monkeypatch, capsys, quiet):
    monkeypatch.chdir(tmp_path)
    fit, unfit = (
        MeshVerdict(file="a.ply", usable=True, verdict="fine enough"),
        MeshVerdict(file="b.ply", usable=False, verdict="too coarse"),
    )
    monkeypatch.setattr("simtest.validation.mesh_verdicts.mesh_verdicts", lambda _: [fit, unfit])
    monkeypatch.setattr("simtest.api.validate", lambda *_, **__: None)
    monkeypatch.setattr(MANNERS, "quiet", quiet)
    if quiet:
        warnings.simplefilter("ignore")
        validate("overview", out=tmp_path)
    else:
        with pytest.warns(UserWarning, match="mesh b.ply: too coarse"):
            validate("overview", out=tmp_path)
    said = capsys.readouterr().out
    assert said.count("mesh a.ply: fine enough") == 1
    # On the error stream already, unless warnings are left out.
    assert said.count("mesh b.ply: too coarse") == (1 if quiet else 0)

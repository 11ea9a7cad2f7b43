"""What a run says of the realism of its scenes: in summary.json, and at the head of its page."""

import json

import pytest
from test_report import make_run

from simtest.report.write import write_report
from simtest.spec import load_experiment, load_scene
from simtest.validation import situations
from simtest.validation.cases import expand
from simtest.validation.situations import UNKNOWN, look_of, realism_of


def described(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(f'name = "mine"\n{text}', encoding="utf-8")
    return realism_of(expand(load_experiment(path)))


def test_smooth_scenes_are_a_control(tmp_path):
    found = described(tmp_path, '[[groups]]\nscene = "sphere"\nlabel = "a"\n[[groups]]\nscene = "plane"\nlabel = "b"\n')
    assert len(found) == 1
    assert found[0].scenes == ("a", "b")
    assert found[0].kind == "smooth"
    assert found[0].sentence == "Smooth control: no relief and no texture, without a camera chain."


@pytest.fixture
def measured(monkeypatch):
    """One measured scene, tissue_colon as it is shipped."""
    entry = {
        "scene": "tissue_colon", "look": look_of(load_scene("tissue_colon")), "real": ["a.png", "b.png"], "frames": 12,
        "verdict": "10 of 12", "near": 10, "judged": 12, "statistics": {},
    }  # fmt: skip
    monkeypatch.setattr(situations, "_measured", lambda: {entry["look"]: entry})
    return entry


def test_a_measured_scene_quotes_its_distance_and_a_changed_one_does_not(tmp_path, measured):
    text = '[[groups]]\nscene = "tissue_colon"\nlabel = "colon"\nset = { "surface.viewpoint" = 7 }\n'
    (same,) = described(tmp_path, text)
    assert same.kind == "tissue"
    assert "relief with slopes of 5° at 2.5 mm and 5° at 0.9 mm" in same.sentence
    assert "10 of 12 statistics are near real frames (measured on 12 frames of tissue_colon" in same.sentence
    assert same.distance["real"] == ["a.png", "b.png"]
    (other,) = described(tmp_path, text.replace('"surface.viewpoint" = 7', '"reflectance.film.alpha" = 0.05'))
    assert other.sentence.endswith(UNKNOWN)
    assert other.distance is None
    # What is drawn for each realisation has not one look.
    (drawn,) = described(tmp_path, text + '[groups.random]\n"reflectance.film.alpha" = { low = 0.02, high = 0.05 }\n')
    assert drawn.distance is None


def test_too_few_real_scenes_carry_no_verdict(tmp_path, measured):
    measured["judged"] = measured["near"] = 0
    (found,) = described(tmp_path, '[[groups]]\nscene = "tissue_colon"\n')
    assert "carries no verdict: too few scenes (measured on 12 frames of tissue_colon against 2 real" in found.sentence


def test_camera_chain_and_relief_alone_are_named(tmp_path):
    chain = 'set = { "sensor.preset" = "colonoscope_hd" }\n'
    (found,) = described(tmp_path, f'[[groups]]\nscene = "tissue_colon"\n{chain}')
    assert "through a camera chain (mosaic, colour, sharpening" in found.sentence
    band = '{ "surface.relief" = { bands = [{ slope_deg = 3.0, wavelength_mm = 1.5 }] } }'
    (found,) = described(tmp_path, f'[[groups]]\nscene = "plane"\nset = {band}\n')
    assert found.kind == "partial"
    assert found.sentence.startswith("Parts of tissue: relief with slopes of 3° at 1.5 mm, without a camera chain.")


def test_look_keeps_what_a_frame_shows_alone():
    unseen = {"surface.viewpoint": 9, "surface.relief.seed": 5, "sensor.seed": 3, "render.samples_per_pixel": 4}
    looks = {look_of(load_scene("tissue_colon", {key: value})) for key, value in unseen.items()}
    assert looks == {look_of(load_scene("tissue_colon"))}
    assert look_of(load_scene("tissue_colon", {"render.ambient": True})) not in looks
    assert len({look_of(load_scene(name)) for name in ("tissue_colon", "tissue_stomach", "plane", "sphere")}) == 4
    assert (
        look_of(load_scene("tissue_colon", {"camera.width": 320, "camera.fx": 160.0, "camera.fy": 160.0})) not in looks
    )


def test_shipped_entries_are_whole():
    held = json.loads(situations.MEASURED.read_text(encoding="utf-8"))["scenes"]
    assert held
    for entry in held:
        assert entry["judged"] == len(entry["statistics"])
        assert entry["near"] == sum(row["verdict"] == "near" for row in entry["statistics"].values())
        assert entry["frames"] >= 1


@pytest.mark.slow
def test_shipped_entries_are_of_the_scenes_as_they_are():
    """Where this fails, a scene was changed since: `python -m studies.realism_table` measures it again."""
    for entry in json.loads(situations.MEASURED.read_text(encoding="utf-8"))["scenes"]:
        assert entry["look"] == look_of(load_scene(entry["scene"])), entry["scene"]


def test_page_says_for_which_realism_its_scenes_stand(tmp_path):
    run = make_run(tmp_path / "run", items=0)
    summary = json.loads((run / "summary.json").read_text())
    entries = [
        {"scenes": [f"curve {i}"], "kind": "smooth", "camera_chain": [], "distance": None}
        | {"sentence": f"Smooth <control> {i}."}
        for i in range(6)
    ]
    summary["experiments"]["overview"]["realism"] = entries
    (run / "summary.json").write_text(json.dumps(summary))
    html = write_report(run).read_text(encoding="utf-8")
    assert all(f"curve {i}: Smooth &lt;control&gt; {i}." in html for i in range(6))
    assert "Realism of 2 more groups of scenes" in html


def test_page_repeats_what_is_wrong_with_a_mesh(tmp_path):
    run = make_run(tmp_path / "run", items=0)
    summary = json.loads((run / "summary.json").read_text())
    meshes = [
        {"file": "a.ply", "usable": False, "verdict": "too <coarse>"},
        {"file": "b.ply", "usable": True, "verdict": "fine enough"},
    ]
    summary["experiments"]["overview"]["meshes"] = meshes
    (run / "summary.json").write_text(json.dumps(summary))
    html = write_report(run).read_text(encoding="utf-8")
    assert "<code>a.ply</code>: too &lt;coarse&gt;. Errors below may come from the mesh, not from the methods." in html
    assert "<code>b.ply</code>: fine enough</p>" in html

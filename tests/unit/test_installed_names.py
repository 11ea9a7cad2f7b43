"""Names of estimators, detectors and networks: what a name means, and which are refused."""

import pytest

from simtest.detection.detector import DETECTORS, load_detector
from simtest.errors import InputError
from simtest.estimators.names import ESTIMATORS
from simtest.runtime.resources import parse_model


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("learned_spot:models/spots/model.onnx", "learned_spot_spots"),
        ("learned_spot:wide net.onnx", "learned_spot_wide_net"),
        ("learned_spot:C:\\nets\\a.onnx", "learned_spot_C_nets_a"),
        ("my_package.core:/a/b.onnx", "my_package.core_b"),
    ],
)
def test_a_network_is_named_by_what_runs_it_and_its_file(text, short):
    assert parse_model(text).short == short


@pytest.mark.parametrize("text", ["learned_spot", "package:learned_spot", "command: ./core a.onnx", "a.onnx",
                                  "command:core.onnx", "learned_spot: a.onnx", ":a.onnx", "a b:c.onnx"])  # fmt: skip
def test_other_names_are_no_networks(text):
    assert parse_model(text) is None


def test_a_detector_without_networks_refuses_a_file():
    assert "colour" in DETECTORS.names()
    with pytest.raises(InputError, match=r"detector 'colour:a.onnx': colour runs no network; must stand alone"):
        load_detector("colour:a.onnx")


# Names that several packages register ---------------------------------------------------------------------------------


POINTS = {
    "simtest.estimators": ("cone_axis", "json:loads"),
    "simtest.detectors": ("peaks", "json:loads"),
}


def install(folder, name, monkeypatch):
    """Make a package that registers names of simtest, in front of all others on the path."""
    info = folder / f"{name.replace('-', '_')}-9.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.0\n")
    text = "".join(f"[{group}]\n{point} = {value}\n" for group, (point, value) in POINTS.items())
    (info / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(str(folder))


@pytest.mark.parametrize(("group", "name"), [(ESTIMATORS, "cone_axis"), (DETECTORS, "peaks")])
def test_a_name_that_another_package_registers_too_is_refused(tmp_path, monkeypatch, group, name):
    own = group.load(name)
    install(tmp_path, "evil-core", monkeypatch)
    with pytest.raises(InputError, match=rf"registered by 2 packages; name one of them: evil-core:{name} or simtest:"):
        group.load(name)
    assert group.load(f"simtest:{name}") is own


@pytest.mark.parametrize("called", ["simtest", "SimTest"])
@pytest.mark.parametrize(("group", "name"), [(ESTIMATORS, "cone_axis"), (DETECTORS, "peaks")])
def test_a_package_of_our_name_is_refused(tmp_path, monkeypatch, group, name, called):
    install(tmp_path, called, monkeypatch)
    with pytest.raises(InputError, match="another package that is called simtest registers json:loads; remove it"):
        group.load(name)

"""Networks of a user's by name, NAME:FILE.onnx, are loaded, recorded and refused."""

import shutil

import pytest

from simtest.bench.run import core_record
from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.estimators.learned import WEIGHTS
from simtest.estimators.learned_spot import LearnedSpot
from simtest.estimators.names import ESTIMATORS, absolute_names, core_hashes, core_records, short_names
from simtest.runtime.provenance import file_hash
from simtest.runtime.resources import data_root


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return the shipped network's copy in a folder of its own."""
    (tmp_path / "models" / "spots").mkdir(parents=True)
    shutil.copy(
        data_root("scenes").joinpath(*WEIGHTS, LearnedSpot.shipped), tmp_path / "models" / "spots" / "model.onnx"
    )
    monkeypatch.chdir(tmp_path)
    return "learned_spot:models/spots/model.onnx"


def test_an_own_network_stands_beside_the_shipped_one(own, tmp_path):
    loaded = load_estimators(["learned_spot", own])
    assert list(loaded) == ["learned_spot", "learned_spot_spots"] == list(short_names(["learned_spot", own]))
    assert "spots" in loaded["learned_spot_spots"].description
    file = tmp_path / "models" / "spots" / "model.onnx"
    assert absolute_names([own, "cloud"]) == (f"learned_spot:{file}", "cloud")
    # Part of a run's fingerprint and record: another network at the same path is another run.
    assert core_hashes([own, "cloud"]) == {own: {str(file): file_hash(file)}}
    assert core_records([own, "cloud"])["learned_spot_spots"]["files"] == {str(file): file_hash(file)}
    assert ESTIMATORS.distributions([own])[f"estimator {own}"].startswith("simtest ")
    told = core_record(own)
    assert (told["name"], told["kind"], told["sha256"]) == ("learned_spot_spots", "network", file_hash(file))
    with pytest.raises(InputError, match="estimator 'learned_spot_spots': given twice"):
        load_estimators([own, f"learned_spot:{file}"])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("learned_spot:none.onnx", "none.onnx: no such file"),
        ("learned_spot:text.onnx", "text.onnx: is no ONNX model"),
        ("learned_spt:text.onnx", "estimator 'learned_spt': not installed"),
        ("cloud:text.onnx", "estimator 'cloud:text.onnx': cloud runs no network; must stand alone"),
        ("text.onnx", "as in learned_spot:text.onnx"),
        ("folder/text.onnx", "as in learned_spot:folder/text.onnx"),
    ],
)
def test_names_that_cannot_be_used_are_told_in_one_line(tmp_path, monkeypatch, name, said):
    (tmp_path / "text.onnx").write_text("no network")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as raised:
        load_estimators([name])
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)

"""No other package stands for one of simtest's own estimators or detectors without being named."""

import pytest

from simtest.detection.detector import DETECTORS
from simtest.errors import InputError
from simtest.estimators.names import ESTIMATORS

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

"""Files that were made to exhaust whoever reads them, or that were cut since they were written: refused by name."""

import os
import shutil
import tracemalloc

import pytest

from simtest.dataset.shard_writer import write_dataset
from simtest.runtime.processes import make_engine
from simtest.spec import load_dataset
from simtest.spec.toml_files import MAX_DEPTH, read_toml
from tests.refusals import refused

DOTTED = {
    "bare": "a" + ".a" * 20_000 + " = 1\n",
    "quoted": '"a"' + '."a"' * 20_000 + " = 1\n",
    "spaced": "a" + " . a" * 20_000 + " = 1\n",
    "header": "[a" + ".a" * 20_000 + "]\n",
    "inline": "x = {a" + ".a" * 20_000 + " = 1}\n",
    "second of two": "x = {b = 1, a" + ".a" * 20_000 + " = 1}\n",
}


@pytest.mark.parametrize("text", DOTTED.values(), ids=list(DOTTED))
def test_a_key_of_thousands_of_parts_takes_no_memory(tmp_path, text):
    """The parser takes the square of their number: 1.6 GB for these."""
    path = tmp_path / "a.toml"
    path.write_text(text)
    tracemalloc.start()
    refused(lambda: read_toml(path), f"{path}: not valid TOML: nested too deeply; at most {MAX_DEPTH} levels")
    assert tracemalloc.get_traced_memory()[1] < 5e6
    tracemalloc.stop()


def test_values_with_many_dots_are_read(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(f'a = "{"b." * 100}"\n# {"c." * 100}\nd.e.f = 1.5\n')
    assert read_toml(path) == {"a": "b." * 100, "d": {"e": {"f": 1.5}}}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound") / "data"
    write_dataset(load_dataset("tiny", {"samples": 6}), folder, make_engine(workers=1))
    return folder


OF_SHARD = ["highlights.parquet/train-000000.parquet", "estimates.parquet/train-000000.parquet", "train-000000.tar"]


@pytest.mark.parametrize("name", ["index.parquet", *OF_SHARD])
def test_a_dataset_with_a_cut_file_is_not_taken_for_a_finished_one(sound, tmp_path, here, name):
    """`dataset preview` told an internal error, and the dataset's own command ended with exit code 0."""
    folder = tmp_path / "data"
    shutil.copytree(sound, folder)
    os.truncate(folder / name, 1000)
    again = ("dataset", "tiny", "--set", "samples=6", "--out", folder, "--workers", "1", "--quiet")
    code, _, errors = here(*again)
    size = (sound / name).stat().st_size
    told = f"{name} has 1000 bytes; must have {size}; simtest dataset verify --repair mends it"
    assert (code, errors) == (2, [f"simtest: --out {folder}: {told}"])
    if not name.startswith("estimates.parquet"):
        code, _, errors = here("dataset", "preview", folder)
        assert (code, len(errors)) == (2, 1)
        assert f"{folder / name}: " in errors[0]
        assert "verify --repair mends it" in errors[0]
    here("dataset", "verify", folder, "--repair", "--quiet")
    assert here(*again)[0] == 0
    assert (folder / name).read_bytes() == (sound / name).read_bytes()

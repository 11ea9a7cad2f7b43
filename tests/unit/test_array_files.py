"""Files of arrays: what numpy reads back, the same bytes each time, compressed where it pays."""

import zipfile

import numpy as np
import pytest

from simtest.runtime.arrays import write_arrays


def arrays():
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((300, 400)).astype(np.float32)
    return {
        "noise": noise,
        "zeros": np.zeros((300, 400, 3), dtype=np.float32),
        "half": np.where(np.arange(400) < 240, np.float32(np.nan), noise),
        "mask": noise > 0.5,
        "turned": np.asfortranarray(noise),
        "empty": np.zeros((0, 3)),
        "one": np.array(2.5),
    }


def test_numpy_reads_back_what_was_written(tmp_path):
    write_arrays(tmp_path / "a.npz", arrays())
    with np.load(tmp_path / "a.npz", allow_pickle=False) as read:
        assert read.files == list(arrays())
        for name, array in arrays().items():
            assert read[name].dtype == array.dtype
            np.testing.assert_array_equal(read[name], array)


def test_the_same_arrays_give_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        write_arrays(tmp_path / name, arrays())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_only_what_shrinks_is_compressed(tmp_path):
    write_arrays(tmp_path / "a.npz", arrays())
    with zipfile.ZipFile(tmp_path / "a.npz") as file:
        kinds = {entry.filename: entry.compress_type for entry in file.infolist()}
        sizes = {entry.filename: entry.compress_size / entry.file_size for entry in file.infolist()}
    assert kinds["noise.npy"] == zipfile.ZIP_STORED
    for name in ("zeros.npy", "half.npy", "mask.npy"):
        assert kinds[name] == zipfile.ZIP_DEFLATED
    assert sizes["zeros.npy"] < 0.01
    assert sizes["half.npy"] < 0.6


def test_objects_are_refused(tmp_path):
    with pytest.raises(ValueError, match="Object arrays"):
        write_arrays(tmp_path / "a.npz", {"objects": np.array([{}], dtype=object)})

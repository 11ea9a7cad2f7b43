"""The Croissant metadata of a dataset are read by mlcroissant."""

import mlcroissant
import numpy as np
import polars as pl
import pytest
import test_croissant

from simtest.dataset import read
from simtest.dataset.croissant import CROISSANT

made = test_croissant.made


@pytest.mark.render
@pytest.mark.filterwarnings("ignore")
def test_mlcroissant_finds_no_fault_and_reads_the_records(made):
    # Raises where the metadata are not valid; a licence and an address are the publisher's to add.
    dataset = mlcroissant.Dataset(made / CROISSANT)
    assert not dataset.metadata.issues.errors
    rows = list(dataset.records("index"))
    table = pl.read_parquet(made / "index.parquet")
    assert [row["index/key"].decode() for row in rows] == table["key"].to_list()
    images = {row["image/key"].decode(): np.asarray(row["image/content"]) for row in dataset.records("image")}
    ours = {record["meta"]["key"]: record["image"] for record in read(made, fields=["image"])}
    assert set(images) == set(ours)
    assert all(np.array_equal(images[key], ours[key]) for key in ours)

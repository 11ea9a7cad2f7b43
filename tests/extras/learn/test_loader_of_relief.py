"""The loader gives both truths of a dataset with relief."""

import test_dataset_contents
import torch

from simtest.dataset.learn import Samples

made = test_dataset_contents.made


def test_loader_passes_the_base_on(made):
    wanted = ("normal", "normal_base", "curvature_base", "pool")
    for item in Samples(made, fields=wanted):
        assert item["normal_base"].shape == (3, 48, 64)
        assert item["curvature_base"].shape == (2, 48, 64)
        assert item["pool"].dtype == torch.bool
        same = torch.equal(torch.nan_to_num(item["normal"]), torch.nan_to_num(item["normal_base"]))
        assert same == (item["meta"]["scene"]["surface"]["relief"] is None)

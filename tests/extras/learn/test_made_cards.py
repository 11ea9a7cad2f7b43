"""Cards that are written with a network."""

import hashlib
import json
import re
import tomllib

import pytest
from test_model_cards import HEADING, SHIPPED

from simtest.errors import InputError


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("one_torch_thread")
class TestMade:
    @staticmethod
    def model(path, **about):
        import torch

        from simtest.dataset.learn.onnx_export import export

        metadata = {"format": "line", "low": {"x": -1e-17}, "high": {"x": 2.5}, "about": about}
        return export(torch.nn.Linear(40, 30), {"x": torch.zeros(2, 40)}, ["y"], {"x": {0: "n"}, "y": {0: "n"}},
                      metadata, path / "model.onnx")  # fmt: skip

    @staticmethod
    def training(**values):
        from simtest.dataset.learn.training import Training

        return Training(name="line", task="line", **values)

    def about(self, folder, **values):
        from simtest.dataset.learn.checkpoint import Epoch, State
        from simtest.dataset.learn.model_card import origin_of, validation_of

        state = State({}, [Epoch(0.5, 0.25, {"off | <b>": 1.5}), Epoch(0.4, 0.3, {"off | <b>": 2.0})], best=0)
        return origin_of(self.training(**values), folder) | validation_of(state)

    @pytest.fixture(scope="class")
    def data(self, tmp_path_factory):
        from simtest.dataset.shard_writer import write_dataset
        from simtest.runtime.processes import make_engine
        from simtest.spec import load_dataset

        folder = tmp_path_factory.mktemp("cards") / "tiny"
        values = {"samples": 6, "samples_per_anatomy": 2, "estimators": [], "title": "Small | frames"}
        write_dataset(load_dataset("tiny", values), folder, make_engine())
        return folder

    @pytest.mark.render
    def test_a_card_tells_the_file_and_what_it_was_made_of(self, data, tmp_path):
        from simtest.dataset.learn.model_card import write_card

        about = self.about(data, title='A "line"', epochs=2)
        file = self.model(tmp_path, **about)
        card = write_card(file).read_text()
        for said in (
            f"SHA-256 `{hashlib.sha256(file.read_bytes()).hexdigest()}`",
            f"`{hashlib.sha256((data / 'manifest.json').read_bytes()).hexdigest()}`",
            "| recipe | `tiny`, seed 1: Small \\| frames |",
            "| inputs | x (n, 40) |",
            "| weights | 1,230 |",
            "2 epochs were done. Epoch 1 has the smallest loss",
            "| off \\| &lt;b> | 1.5 |",
            "| x | 0 | 2.5 |",
        ):
            assert said in card, said
        # Three anatomies of two frames each.
        counts = re.findall(r"\| (\w+) split \| (\d+) frames of (\d+) anatomies \|", card)
        assert {split for split, *_ in counts} == {"train", "validation", "test"}
        assert [sum(int(row[column]) for row in counts) for column in (1, 2)] == [6, 3]
        toml = card.partition("```toml\n")[2].partition("```")[0]
        assert tomllib.loads(toml) == {k: v for k, v in json.loads(about["training"]).items() if k != "name"}
        assert card.rstrip().endswith("how often the test split was used.")

    @pytest.mark.render
    def test_what_people_wrote_is_kept(self, data, tmp_path):
        from simtest.dataset.learn.model_card import write_card

        card = write_card(self.model(tmp_path, **self.about(data)))
        card.write_text(card.read_text().partition(HEADING)[0] + f"{HEADING}\n\nOff by 3 deg.\n")
        before = card.read_text()
        file = self.model(tmp_path, **self.about(data, seed=1))
        after = write_card(file).read_text()
        assert after.endswith(f"{HEADING}\n\nOff by 3 deg.\n")
        assert after != before
        assert hashlib.sha256(file.read_bytes()).hexdigest() in after
        # Made again of the same file it is the same.
        assert write_card(file).read_text() == after

    @pytest.mark.render
    @pytest.mark.parametrize(("shorten", "said"), [("halved", "in half precision"), ("in_eight_bits", "in 8 bits")])
    def test_weights_stored_in_short_are_counted(self, data, tmp_path, shorten, said):
        import onnx

        from simtest.dataset.learn import onnx_export
        from simtest.dataset.learn.model_card import make_card

        file = self.model(tmp_path, **self.about(data))
        onnx.save(getattr(onnx_export, shorten)(onnx.load(file)), file)
        assert f", of which 1,200 are stored {said}; computed in float32 |" in make_card(file)

    @pytest.mark.parametrize("damage", ["missing", "empty", "no model", "nothing about it", "no training"])
    def test_a_file_that_is_no_network_is_told_in_one_line(self, tmp_path, damage):
        from simtest.dataset.learn.model_card import make_card

        path = tmp_path / "model.onnx"
        if damage == "nothing about it":
            self.model(tmp_path)
        elif damage == "no training":
            self.model(tmp_path, training="{")
        elif damage != "missing":
            path.write_bytes(b"" if damage == "empty" else b"no model")
        with pytest.raises(
            InputError, match=r"model.onnx: (no such file|is a folder|cannot be read|is no network of simtest train)"
        ) as raised:
            make_card(path)
        assert "\n" not in str(raised.value)

    @pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
    def test_a_shipped_card_is_the_one_that_its_file_gives(self, file):
        from simtest.dataset.learn.model_card import MEASURED, make_card

        assert MEASURED == HEADING
        card = file.with_suffix(".md").read_text(encoding="utf-8")
        assert card.startswith(make_card(file) + "\n\n")

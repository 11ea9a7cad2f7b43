"""Cards of networks: one form, true to the file that they describe, and kept figures."""

import hashlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted((ROOT / "scenes" / "learning" / "weights").glob("*.onnx"))
HEADING = "## Measured on unseen anatomies"


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_a_shipped_network_has_a_card_of_its_own_bytes(file):
    data, card = file.read_bytes(), file.with_suffix(".md").read_text(encoding="utf-8")
    assert f"{len(data):,} bytes, SHA-256 `{hashlib.sha256(data).hexdigest()}`" in card
    # The dataset is the one that the file names.
    (line,) = (line for line in card.splitlines() if line.startswith("| dataset |"))
    assert line.split("`")[3].encode() in data
    head, _, measured = card.partition(HEADING)
    assert "## Limits" in head
    assert "```sh\n" in measured, "no command for the figures"


def test_nothing_but_networks_and_cards_is_shipped():
    assert SHIPPED
    there = {path.name for path in SHIPPED[0].parent.iterdir()}
    assert there == {path.name for path in SHIPPED} | {path.with_suffix(".md").name for path in SHIPPED}

"""Values as TOML reads them back."""

import tomllib

import pytest

from simtest.spec.toml_files import toml_tables, toml_value


@pytest.mark.parametrize(
    "text", ["plain", "caf\u00e9 \U0001f52c", 'quote " and \\\\ and\ttab', "line\nbreak", "\x00\x1f\x7f\x80", ""]
)
def test_text_reads_back(text):
    """Characters beyond U+FFFF were written as surrogates, which TOML refuses."""
    assert tomllib.loads(f"value = {toml_value(text)}") == {"value": text}


def test_what_is_none_is_left_out():
    assert tomllib.loads(toml_tables({"a": {"x": None, "y": {"z": None, "w": 1}}, "b": {"v": [True, 1.5]}})) == {
        "a": {"y": {"w": 1}}, "b": {"v": [True, 1.5]},
    }  # fmt: skip

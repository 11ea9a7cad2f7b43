"""Texts of a page as its templates write them."""

import pytest

from simtest.pages.html import code_spans
from simtest.pages.style import number


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("`--set a=B` names <it>", "<code>--set a=B</code> names &lt;it&gt;"),
        ("a `b` and `<c>`", "a <code>b</code> and <code>&lt;c&gt;</code>"),
        ("no code, one ` mark", "no code, one ` mark"),
        ("", ""),
    ],
)
def test_what_stands_between_backticks_is_code(text, html):
    assert str(code_spans(text)) == html


def test_rounding_is_no_figure():
    assert (number(-6.45e-17), number(0.0), number(2e-9)) == ("0", "0", "2.00e-09")

"""Equations of the manual become MathML."""

from types import SimpleNamespace

import pytest
from test_manual import DOCS


@pytest.mark.parametrize(
    ("tex", "parts"),
    [
        (r"\tfrac12", ["<mfrac", "<mn>1</mn>", "<mn>2</mn>"]),
        (r"a = b \tag{4.4}", ["(4.4)", "<mi>a</mi>"]),
        (r"\begin{cases} 1 & x > 0 \\ 0 \end{cases}", ["mtable"]),
    ],
)
def test_equations_become_mathml(monkeypatch, tex, parts):
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import mathml
    from docutils import nodes

    writer = SimpleNamespace(body=[])
    with pytest.raises(nodes.SkipNode):
        mathml.block(writer, nodes.math_block(tex, tex))
    made = "".join(writer.body)
    assert all(part in made for part in parts)
    assert "\\" not in made

"""Run a notebook's cells in order, without Jupyter, print what they show, and save its last figure.

python examples/run_notebook.py examples/04_validate_a_method.ipynb
"""

import ast
import json
from typing import Any

import matplotlib.pyplot as plt
from common import options, save


def run(source: str, name: str, names: dict[str, Any]) -> None:
    """Run a cell; the value of its last expression is shown, unless a semicolon follows it."""
    tree = ast.parse(source, name)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, name, "exec"), names)
    value = None if last is None else eval(compile(ast.Expression(last.value), name, "eval"), names)
    if value is not None and not source.rstrip().endswith(";"):
        # A notebook asks for this, so that it must work.
        getattr(value, "_repr_html_", str)()
        print(repr(value))


chosen = options(__doc__, "notebook")
cells = json.loads(chosen.notebook.read_text(encoding="utf-8"))["cells"]
names: dict[str, Any] = {"__name__": "__main__"}
for number, cell in enumerate(cells):
    if cell["cell_type"] == "code":
        run("".join(cell["source"]), f"{chosen.notebook.name}, cell {number}", names)
figure = plt.gcf()
photo = any(axis.images for axis in figure.axes)
save(figure, chosen.out / f"{chosen.notebook.stem}.{'jpg' if photo else 'png'}")

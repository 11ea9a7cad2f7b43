"""Which packages below simtest/ import which, wherever in the code, and that modules do not import in a circle."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import simtest

PACKAGE = Path(simtest.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
PAIRS = 153
"""Pairs at most; 19 of them are imports of errors and conventions, which stand at the top level."""

TOP = "the top level"


def package_of(module: str) -> str:
    """Return the first-level package of a module of simtest, by its dotted name."""
    first = module.split(".")[1] if "." in module else ""
    return first if (PACKAGE / first).is_dir() and first else TOP


def name_of(file: Path) -> str:
    """Return a file's dotted name."""
    parts = ("simtest", *file.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(node: ast.AST) -> Iterator[str]:
    """Yield the dotted names of simtest that a statement imports."""
    if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
        names = [f"{node.module}.{alias.name}" for alias in node.names]
    else:
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
    yield from (name for name in names if name.split(".")[0] == "simtest")


def at_run_time(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield the statements of a module that run when it is imported, but for those of type checkers alone."""
    nodes: list[ast.AST] = [*tree.body]
    while nodes:
        node = nodes.pop()
        yield node
        if isinstance(node, ast.ClassDef | ast.Try | ast.With):
            nodes += node.body
        elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
            nodes += [*node.body, *node.orelse]


def test_no_more_pairs_of_packages_than_there_were():
    pairs = {
        (package_of(name_of(file)), package_of(name))
        for file in FILES
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        for name in imported(node)
    }
    pairs = {(one, other) for one, other in pairs if one != other}
    assert len(pairs) <= PAIRS
    assert ("cli", TOP) in pairs
    assert not {other for one, other in pairs if one == "runtime"} - {TOP}


def named(target: ast.expr) -> Iterator[str]:
    """Yield the names that an assignment's target gives."""
    if isinstance(target, ast.Name):
        yield target.id
    elif isinstance(target, ast.Tuple):
        yield from (name for each in target.elts for name in named(each))


def given(node: ast.stmt) -> list[str]:
    """Return the names that a statement of a module gives, other than by an import."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [name for target in targets for name in named(target)]


def test_no_module_gives_a_name_twice():
    """Ruff sees functions and classes that are defined twice, but no constants: the second one wins everywhere."""
    twice = {}
    for file in FILES:
        body = ast.parse(file.read_text(encoding="utf-8")).body
        # A type variable or an overload may stand in branches, which are not looked into.
        names = Counter(name for node in body for name in given(node))
        twice |= {f"{name_of(file)}.{name}": count for name, count in names.items() if count > 1}
    assert not twice
    both = ast.parse("A = 1\nB, A = 2, 3").body
    assert Counter(name for node in both for name in given(node))["A"] == 2


def test_no_modules_import_each_other_in_a_circle():
    known = {name_of(file): file for file in FILES}
    graph: dict[str, set[str]] = {}
    for name, file in known.items():
        names = (each for node in at_run_time(ast.parse(file.read_text(encoding="utf-8"))) for each in imported(node))
        graph[name] = {each if each in known else each.rpartition(".")[0] for each in names} & set(known) - {name}
    assert graph["simtest.validation.scoring"] >= {"simtest.validation.glints"}
    # Modules that import nothing that is left are taken away; what stays is part of a circle, or imports one.
    while free := {name for name, others in graph.items() if not others & set(graph)}:
        graph = {name: others for name, others in graph.items() if name not in free}
    assert not graph

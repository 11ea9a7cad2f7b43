"""Count what a reader of the package meets: entries, layers, arrows, lines, repeated names, docstrings, open dicts.

Everything is read from the source by `ast`; nothing of simtest is imported.

    python -m studies.structure [--arrows] [--repeated] [--dicts]
"""

import argparse
import ast
import re
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "simtest"
NOT_ENTRIES = ("__init__.py", "__main__.py", "py.typed", "__pycache__")
VAGUE = re.compile(r"(Give|Tell|Say)\b")
OPEN_DICT = re.compile(r"\bdict\[str, (?:Any|object)\]")
NIGHTLY_AND_REPORT = ("gate", "nightly", "report")


def sources() -> list[Path]:
    """Return the package's Python files."""
    return sorted(PACKAGE.rglob("*.py"))


def entry_of(path: Path) -> str:
    """Return the entry below simtest/ that a file stands in."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_entries(tree: ast.Module, entries: set[str]) -> Iterator[tuple[str, int]]:
    """Yield the entries that a module imports, wherever in it, each with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "simtest":
            parts = node.module.split(".")
            names = [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            dotted = [alias.name.split(".") for alias in node.names]
            names = [parts[1] for parts in dotted if parts[0] == "simtest" and len(parts) > 1]
        else:
            continue
        yield from ((name, node.lineno) for name in names if name in entries)


def arrows() -> dict[tuple[str, str], list[str]]:
    """Return the arrows between entries, each with the places in the source that draw it."""
    entries = {path.name.removesuffix(".py") for path in PACKAGE.iterdir() if path.name not in NOT_ENTRIES}
    drawn: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path in sources():
        start = entry_of(path)
        if start in ("__init__", "__main__"):
            continue
        for end, line in imported_entries(ast.parse(path.read_text()), entries):
            if end != start:
                drawn[start, end].append(f"{path.relative_to(ROOT)}:{line}")
    return dict(drawn)


def layers() -> int:
    """Return the number of layers of the contract that import-linter checks."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return next(len(contract["layers"]) for contract in contracts if contract["type"] == "layers")


def repeated_names() -> dict[str, list[str]]:
    """Return the file names that stand in several folders, with these."""
    folders: dict[str, list[str]] = defaultdict(list)
    for path in sources():
        if path.name not in ("__init__.py", "__main__.py"):
            folders[path.name].append(str(path.parent.relative_to(ROOT)))
    return {name: found for name, found in folders.items() if len(found) > 1}


def docstrings() -> Iterator[tuple[Path, int, str]]:
    """Yield every docstring with its file and line."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, kinds):
                text = ast.get_docstring(node)
                if text:
                    yield path, getattr(node, "lineno", 1), text


def comment_share() -> float:
    """Return the share of non-empty lines that are comments of their own or end in one."""
    lines = [line.strip() for path in sources() for line in path.read_text().splitlines() if line.strip()]
    return sum(1 for line in lines if line.startswith("#") or "  # " in line) / len(lines)


def line_count(files: list[Path]) -> int:
    """Return how many lines files hold."""
    return sum(len(path.read_text().splitlines()) for path in files)


def main() -> None:
    """Print the counts, and the places behind them where asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for option in ("arrows", "repeated", "dicts", "vague"):
        parser.add_argument(f"--{option}", action="store_true", help=f"list the {option} too")
    asked = parser.parse_args()
    entries = [path for path in PACKAGE.iterdir() if path.name not in NOT_ENTRIES]
    drawn, repeated = arrows(), repeated_names()
    found = list(docstrings())
    vague = [(path, line, text) for path, line, text in found if VAGUE.match(text)]
    dicts = {path: len(OPEN_DICT.findall(path.read_text())) for path in sources()}
    reporting = [path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix in (".py", ".j2", ".json")
                 and entry_of(path) in NIGHTLY_AND_REPORT]  # fmt: skip
    rows = {
        "entries below simtest/": len(entries),
        "layers": layers(),
        "arrows between entries": len(drawn),
        "Python files, lines": f"{len(sources())}, {line_count(sources())}",
        "nightly, gate and report with templates, lines": line_count(reporting),
        "file names that repeat": len(repeated),
        "docstrings, of these beginning with Give, Tell or Say": f"{len(found)}, {len(vague)}",
        "dict[str, Any]": sum(dicts.values()),
        "lines with a comment": f"{100 * comment_share():.1f} %",
    }
    for name, value in rows.items():
        print(f"{name}: {value}")
    if asked.arrows:
        for (start, end), places in sorted(drawn.items()):
            print(f"{start} -> {end} ({len(places)}): {places[0]}")
    if asked.repeated:
        for name, folders in sorted(repeated.items()):
            print(name, *folders)
    if asked.dicts:
        for path, count in Counter(dicts).most_common():
            if count:
                print(path.relative_to(ROOT), count)
    if asked.vague:
        for path, line, text in vague:
            print(f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}")


if __name__ == "__main__":
    main()

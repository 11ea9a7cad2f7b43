"""A case: a command line with the files that it reads, and what it should make of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

Content = bytes | str | Callable[[Path], None]
"""Of a file: bytes, text, or a function that makes what stands at a path."""


class Wanted(StrEnum):
    """What a command should make of a case."""

    REFUSED = "refused"
    """One line on stderr, exit code 2 (or 1 where a command's verdict is 1), nothing written."""

    DONE = "done"
    """Exit code 0: a good input, without which a refusal of its spoilt copies would say nothing."""

    ORDERLY = "orderly"
    """Either refused so, or done: some damaged bytes are still a good file."""


@dataclass(frozen=True)
class Case:
    """A command that is run in a folder of its own.

    Parameters
    ----------
    name : str
        "kind: what", unique.
    command : tuple of str
        Arguments of `simtest`.
    files : mapping
        What stands in the folder, by name.
    wanted : Wanted
        What should come of it.
    says : str
        What the line must hold, such as the key's name.
    """

    name: str
    command: tuple[str, ...]
    files: Mapping[str, Content] = field(default_factory=dict)
    wanted: Wanted = Wanted.REFUSED
    says: str = ""

    def make_files(self, folder: Path) -> None:
        """Make the case's files."""
        for name, content in self.files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if callable(content):
                content(path)
            else:
                path.write_bytes(content.encode() if isinstance(content, str) else content)

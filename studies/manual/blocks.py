"""The code blocks of the manual's pages, read as they stand.

Convention: an `sh` or `python` block runs as written from the checkout's root, in the page's order; a `console` block,
or one below the line `<!-- own files -->`, needs files of the reader's and is not run, unless it stands below the line
`<!-- session -->`. A `text` block may show what was printed: `studies.manual.outputs`.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

FENCE = re.compile(r"^(?P<indent> *)(?P<fence>`{3,}|~{3,})(?P<info>.*)$")
OWN_FILES = "<!-- own files -->"
SESSION = "<!-- session -->"
COMMAND = re.compile(r"\$? *(?:simtest|python -m|make) ")


@dataclass(frozen=True)
class Block:
    """A code block of a page.

    `page`: its page, below the checkout; `line`: number of its first line of code, from 1; `language`: of its
    fence; `indented` where it has none; `code`: what it holds; `runs`: whether it runs as written; `above`: what
    stands between the block before it and this one.
    """

    page: Path
    line: int
    language: str
    code: str
    runs: bool
    above: str = ""

    @property
    def place(self) -> str:
        """Page and line."""
        return f"{self.page}:{self.line}"

    @property
    def is_session(self) -> bool:
        """Whether it shows commands and what they print, which may be refusals."""
        return self.language == "console" and self.runs

    @property
    def shows_refusal(self) -> bool:
        """Whether it is a session in which simtest refuses something."""
        return "$ " in self.code and re.search(r"^simtest: ", self.code, re.MULTILINE) is not None

    @property
    def lines(self) -> list[str]:
        """The commands of a shell block: comments and prompts taken off, continued lines joined."""
        joined = re.sub(r"\s*\\\n\s*", " ", self.code)
        prompted = any(line.startswith("$ ") for line in joined.splitlines())
        # Where a session is shown, what has no prompt is output.
        kept = (line[2:] if prompted else line for line in joined.splitlines() if line.startswith("$ ") or not prompted)
        return [line.strip() for line in kept if line.strip() and not line.lstrip().startswith("#")]


def manual_pages() -> list[Path]:
    """Return README.md and the pages of docs/ that are in git, not those that are generated."""
    from studies.manual.pages import PAGES

    generated = {ROOT / "docs" / name for name in PAGES}
    return [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").rglob("*.md") if path not in generated)]


def blocks_of(path: Path) -> Iterator[Block]:
    """Yield the blocks of a page, fenced and indented."""
    page = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
    lines = path.read_text(encoding="utf-8").splitlines()
    number = ended = 0
    own = False
    while number < len(lines):
        line = lines[number]
        fence = FENCE.match(line)
        if fence:
            closing = re.compile(rf"^ *{fence['fence'][0]}{{{len(fence['fence'])},}} *$")
            end = next((k for k in range(number + 1, len(lines)) if closing.match(lines[k])), len(lines))
            code = [text[len(fence["indent"]) :] for text in lines[number + 1 : end]]
            language = fence["info"].strip().partition(" ")[0]
            above = "\n".join(lines[ended:number])
            runs = SESSION in above if language == "console" else language in ("sh", "python") and not own
            yield Block(page, number + 2, language, "\n".join(code), runs, above)
            number = ended = end + 1
            own = False
        elif line.startswith("    ") and (number == 0 or not lines[number - 1].strip()) and COMMAND.match(line[4:]):
            end = next((k for k in range(number, len(lines)) if lines[k].strip() and lines[k][:4].strip()), len(lines))
            code = [text[4:] for text in lines[number:end]]
            above = "\n".join(lines[ended:number])
            yield Block(page, number + 1, "indented", "\n".join(code).rstrip(), not own, above)
            number = ended = end
            own = False
        else:
            own = line.strip() == OWN_FILES or (own and not line.strip())
            number += 1

"""Check the manual, and write what of it is made.

    python -m studies.manual pages                      write the generated pages into docs/
    python -m studies.manual links build/manual         dead links of the built site
    python -m studies.manual stale [PAGE...]            commands and Python that cannot work any more
    python -m studies.manual commands [PAGE...] [--quick] [--timeout S] [--log FILE]
                                                        run every `sh` and `python` block, page by page, and compare
                                                        what they print with what the page shows
    python -m studies.manual figures [PAGE...] [--cheap] [--write] [--timeout S]
                                                        make the tables anew that name their command, and compare their
                                                        numbers, or write them
    python -m studies.manual diagrams [NAME...]         draw the diagrams into docs/images/

Each exits with 1 where something is wrong, and names it.
"""

import argparse
import sys
from pathlib import Path

from studies.manual.blocks import ROOT


def main() -> int:
    """Run one of the checks."""
    parser = argparse.ArgumentParser(prog="python -m studies.manual", description="Check the manual.")
    checks = parser.add_subparsers(dest="check", required=True)
    checks.add_parser("pages", help="write the generated pages")
    checks.add_parser("links", help="find dead links").add_argument("site", type=Path)
    checks.add_parser("stale", help="find stale commands").add_argument("pages", nargs="*", type=Path)
    runner = checks.add_parser("commands", help="run every command")
    runner.add_argument("pages", nargs="*", type=Path)
    runner.add_argument("--quick", action="store_true", help="leave out what takes minutes")
    runner.add_argument("--timeout", type=float, default=3600.0, help="seconds that a block may take")
    runner.add_argument("--log", type=Path, help="file for the outputs of the blocks")
    figures = checks.add_parser("figures", help="make the tables of measured figures anew")
    figures.add_argument("pages", nargs="*", type=Path)
    figures.add_argument("--cheap", action="store_true", help="leave out what takes more than 20 s of processor time")
    figures.add_argument("--write", action="store_true", help="write the numbers that differ into the pages")
    figures.add_argument("--timeout", type=float, default=3600.0, help="seconds that a command may take")
    checks.add_parser("diagrams", help="draw the diagrams").add_argument("names", nargs="*", metavar="NAME")
    return _run(parser.parse_args())


def _run(given: argparse.Namespace) -> int:
    if given.check == "pages":
        from studies.manual.pages import write_pages

        print(*write_pages(ROOT / "docs"), sep="\n")
        return 0
    if given.check == "diagrams":
        from studies.manual.diagrams import write_diagrams

        print(*write_diagrams(ROOT / "docs/images", given.names), sep="\n")
        return 0
    pages = [page.resolve() for page in getattr(given, "pages", [])] or None
    if given.check == "commands":
        from studies.manual.runner import run_pages

        return run_pages(pages, given.quick, given.timeout, given.log)
    if given.check == "figures":
        from studies.manual.figures import check_figures

        return check_figures(pages, given.cheap, given.timeout, given.write)
    if given.check == "links":
        from studies.manual.links import dead_links

        found = list(dead_links(given.site))
    else:
        from studies.manual.stale import stale

        found = list(stale(pages))
    print(*found, f"{len(found)} faults" if found else "no faults", sep="\n")
    return 1 if found else 0


sys.exit(main())

"""Write the pinned packages with the hashes of their files, for `pip install --require-hashes`.

python .ci/hashed_constraints.py [OUT]: by default constraints-PLATFORM.txt beside constraints.txt. pip itself chooses
the files, of this platform and Python, and reports their hashes; the file holds names, versions and hashes, and no
address.
"""

import json
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PINNED = ROOT / "constraints.txt"


def main() -> int:
    """Write the file."""
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}-{sysconfig.get_platform().replace('-', '_')}"
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / f"constraints-{tag}.txt"
    text = hashed(report(PINNED), f"# For {tag}, made from constraints.txt by .ci/hashed_constraints.py.")
    out.write_text(text, encoding="ascii")
    print(out)
    return 0


def report(pinned: Path) -> Mapping[str, Any]:
    """Return what pip would install of a list of pinned packages."""
    with tempfile.TemporaryDirectory() as scratch:
        told = Path(scratch) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps",
                   "--disable-pip-version-check", "--report", str(told), "-r", str(pinned)]  # fmt: skip
        subprocess.run(command, check=True)
        return dict(json.loads(told.read_text(encoding="utf-8")))


def hashed(told: Mapping[str, Any], head: str) -> str:
    """Return pip's report as lines of name, version and hashes, sorted; a package without a hash is refused."""
    lines = []
    for item in told["install"]:
        name, version = item["metadata"]["name"], item["metadata"]["version"]
        archive = item["download_info"].get("archive_info", {})
        hashes = archive.get("hashes") or dict([archive["hash"].split("=", 1)] if archive.get("hash") else [])
        if not hashes:
            raise SystemExit(f"{name} {version}: pip reports no hash; must come from an index of files")
        lines.append(
            f"{name}=={version} " + " ".join(f"--hash={kind}:{value}" for kind, value in sorted(hashes.items()))
        )
    return "\n".join([head, *sorted(lines, key=str.lower)]) + "\n"


if __name__ == "__main__":
    sys.exit(main())

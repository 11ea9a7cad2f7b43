"""Keeps the answers of each method on each frame, so that a run that was ended goes on, and a new network is added.

A network's answers are known by the hash of its file, those of the classical methods by their names: the folder is of
one version of the code (`studies.kept`).
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from simtest.estimators import AnyEstimator
from simtest.runtime.files import make_folder, write_atomically
from studies.learned_transfer.answers import Answer, answers
from studies.learned_transfer.frames import HardFrame

Rows = list[dict[str, object]]


class Kept:
    """Answers in a folder, one file for each method and frame.

    Parameters
    ----------
    folder : Path
        Of the frames; the answers lie in a folder below.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "answers"

    def normals(self, frame: HardFrame, estimators: Mapping[str, AnyEstimator]) -> list[Answer]:
        """Return the answers of estimators on a frame; those that the folder lacks are made, all in one pass."""
        lacking = {name: each for name, each in estimators.items() if not self._file(frame, name, each).exists()}
        if lacking:
            made = list(answers(frame, lacking))
            for name, each in lacking.items():
                own: Rows = [asdict(one) for one in made if one.estimator == name]
                _write(self._file(frame, name, each), own)
        found = []
        for name, each in estimators.items():
            # Networks of one file may have two names.
            rows = json.loads(self._file(frame, name, each).read_text(encoding="utf-8"))
            found += [Answer(**{**row, "estimator": name}) for row in rows]
        return found

    def _file(self, frame: HardFrame, name: str, method: object) -> Path:
        model = getattr(method, "model", None)
        key = hashlib.sha256(Path(model).read_bytes()).hexdigest()[:16] if model else ""
        label = "_".join(part for part in (name.split(",")[0], key) if part)
        return self._folder / label / f"{frame.scene}_{frame.row.name.replace(' ', '_')}.json"


def _write(file: Path, rows: Rows) -> None:
    make_folder(file.parent)
    text = json.dumps(rows)
    write_atomically(file, lambda part: part.write_text(text, encoding="utf-8"))

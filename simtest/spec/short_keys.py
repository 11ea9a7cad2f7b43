"""Keys by their last name: ``radius_mm`` for ``surface.radius_mm``, where only one key of the scene ends so."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.runtime.resources import find
from simtest.spec.experiment import Experiment
from simtest.spec.paper import PaperScene, is_paper
from simtest.spec.scene import Scene
from simtest.spec.spec_model import validate
from simtest.spec.toml_files import read_toml
from simtest.spec.type_change import replace_values

CLOSE = 3
"""Names that are suggested for one that does not exist."""


def scene_models(experiment: Experiment) -> list[BaseModel]:
    """Return the base scenes of an experiment's groups, with the values that each group sets."""
    found: list[BaseModel] = []
    for group in experiment.groups:
        path = find(group.scene, "scenes")
        data = replace_values(Scene, read_toml(path), group.set, str(path))
        found.append(validate(PaperScene if is_paper(data) else Scene, data, str(path)))
    return found


def full_keys(models: Sequence[BaseModel], given: Mapping[str, Any], others: Sequence[str] = ()) -> dict[str, Any]:
    """Return values by full key path, of values by the last name of a key.

    Keys that the scene's file states come before those that it leaves at their defaults, and keys of tables before
    those of lists of tables.

    Parameters
    ----------
    models : sequence of BaseModel
        Whose keys may be meant: a scene, or those of an experiment.
    given : mapping
        Values by name; a name may be a full path too.
    others : sequence of str
        Names that the caller takes itself; a mistyped one may mean one of them.
    """
    found = [each for model in models for each in _paths(model)]
    stated = dict.fromkeys(path for path, is_stated in found if is_stated)
    rest = dict.fromkeys(path for path, is_stated in found if not is_stated and path not in stated)
    return {_path_of(name, list(stated), list(rest), others): value for name, value in given.items()}


def _path_of(name: str, stated: Sequence[str], rest: Sequence[str], others: Sequence[str]) -> str:
    for paths in (stated, rest):
        if name in paths:
            return name
        ending = [path for path in paths if path.rsplit(".", 1)[-1] == name]
        single = [path for path in ending if not any(part.isdigit() for part in path.split("."))]
        if len(ending) == 1 or len(single) == 1:
            return (single or ending)[0]
        if ending:
            one = f'settings={{"{ending[0]}": ...}}'
            raise InputError(f"{name}: {len(ending)} keys end so: {', '.join(ending)}; name one by {one}")
    known = dict.fromkeys(path.rsplit(".", 1)[-1] for path in (*others, *stated, *rest))
    meant = suggestion(name, known, CLOSE) or "; `simtest schema scene` lists the keys"
    raise InputError(f"{name}: no key of this scene or experiment ends so{meant}")


def _paths(model: BaseModel, before: str = "", stated: bool = True) -> Iterator[tuple[str, bool]]:
    """Yield the paths of a model's keys, through its tables and lists of tables, and whether its file states each."""
    for name in type(model).model_fields:
        path, value, own = before + name, getattr(model, name), stated and name in model.model_fields_set
        yield path, own
        if isinstance(value, BaseModel):
            yield from _paths(value, f"{path}.", own)
        elif isinstance(value, list | tuple):
            for i, each in enumerate(value):
                if isinstance(each, BaseModel):
                    yield from _paths(each, f"{path}.{i}.", own)

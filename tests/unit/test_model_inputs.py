"""Malformed input made from the models: every key of every specification model, wrong in every way its schema forbids.

The bounds themselves are pinned in tests/data/bounds.txt: cases that are made from a bound cannot see it go.
`python -m tests.unit.test_model_inputs` prints the file.
"""

import math
from pathlib import Path

import pytest

import simtest.advice.scope
import simtest.bench.suite
import simtest.estimators.process.core
import simtest.reconstruction.regions
import simtest.spec.calibration_spec
import simtest.surfaces.recipe  # noqa: F401  (these modules hold models)
from simtest.errors import InputError
from simtest.spec.spec_model import Spec, validate

BOUNDS = Path(__file__).parents[1] / "data" / "bounds.txt"

WRONG_TYPES = (True, 7, 0.5, "zz top", "10", [], {}, [[]], ["zz top"], {"zz": 1})
"""Of these a key may allow some; the others must be refused."""

NUMBERS = {"number": (int, float), "integer": int}
OTHERS = {"string": str, "boolean": bool, "array": list, "object": dict, "null": type(None)}


def models(base=Spec):
    """Return the models that can stand in a file, by name."""
    found = {}
    for model in base.__subclasses__():
        found |= models(model)
        if not model.__name__.startswith("_") and model.__module__.startswith("simtest."):
            found[model.__name__] = model
    return dict(sorted(found.items()))


MODELS = models()


def forms(schema, definitions):
    """Return the schemas that a value may meet, without references and unions."""
    if "$ref" in schema:
        return forms(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    parts = schema.get("anyOf") or schema.get("oneOf")
    return [form for part in parts for form in forms(part, definitions)] if parts else [schema]


def keys(model):
    """Return the forms of each key of a model, and which keys are required."""
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    made = {key: forms(form, definitions) for key, form in schema["properties"].items()}
    return made, schema.get("required", []), definitions


def items_of(form, count):
    """Return the schemas of a list's first items, so many."""
    return form["prefixItems"][:count] if "prefixItems" in form else [form.get("items", {})] * count


def meets(value, form, definitions):
    """Return whether a value may meet a form: the type, the bounds, and the items of a list; of a table nothing."""
    if "const" in form or "enum" in form:
        return value in form.get("enum", [form.get("const")])
    kind = form.get("type")
    if kind in NUMBERS:
        if isinstance(value, bool) or not isinstance(value, NUMBERS[kind]):
            return False
        return (
            math.isfinite(value)
            and form.get("minimum", -math.inf) <= value <= form.get("maximum", math.inf)
            and form.get("exclusiveMinimum", -math.inf) < value < form.get("exclusiveMaximum", math.inf)
        )
    if kind is not None and not isinstance(value, OTHERS[kind]):
        return False
    if kind == "array":
        if not form.get("minItems", 0) <= len(value) <= form.get("maxItems", math.inf):
            return False
        pairs = zip(value, items_of(form, len(value)), strict=True)
        return all(any(meets(v, each, definitions) for each in forms(item, definitions)) for v, item in pairs)
    return True


def edges(form):
    """Return numbers just outside a form's bounds, and what is no number."""
    if form.get("type") not in NUMBERS:
        return []
    step = 1 if form["type"] == "integer" else 1e-9
    beyond = [math.nan, math.inf, -math.inf]
    beyond += [form["exclusiveMinimum"]] if "exclusiveMinimum" in form else []
    beyond += [form["exclusiveMaximum"]] if "exclusiveMaximum" in form else []
    beyond += [form["minimum"] - max(step, abs(form["minimum"]) * step)] if "minimum" in form else []
    beyond += [form["maximum"] + max(step, abs(form["maximum"]) * step)] if "maximum" in form else []
    return beyond


def bad_values(allowed, definitions):
    """Return values that meet none of a key's forms; in a list each item is tried too."""
    tried = [*WRONG_TYPES]
    for form in allowed:
        tried += edges(form)
        items = items_of(form, form.get("minItems", 1)) if form.get("type") == "array" else []
        whole = [good(forms(item, definitions)[0], definitions) for item in items]
        for i, item in enumerate(items):
            beyond = [edge for each in forms(item, definitions) for edge in edges(each)]
            tried += [[*whole[:i], edge, *whole[i + 1 :]] for edge in beyond]
    return [value for value in tried if not any(meets(value, form, definitions) for form in allowed)]


def good(form, definitions):
    """Return a value that meets a form."""
    if "const" in form or "enum" in form:
        return form.get("const", form.get("enum", [None])[0])
    kind = form.get("type")
    if kind in NUMBERS:
        low = form.get("minimum", form.get("exclusiveMinimum", 0.0) + 1)
        return min(max(low, 1), form.get("maximum", math.inf))
    if kind == "array":
        items = items_of(form, form.get("minItems", 0))
        return [good(forms(item, definitions)[0], definitions) for item in items]
    if kind == "object":
        told = form.get("properties", {})
        needed = {*form.get("required", []), *(key for key in told if key == "type")}
        if form.get("minProperties"):
            told = {key: form["additionalProperties"] for key in form["propertyNames"]["enum"]}
            needed = {*told}
        return {key: good(forms(told[key], definitions)[0], definitions) for key in sorted(needed)}
    return False if kind == "boolean" else "a"


@pytest.mark.parametrize("name", MODELS)
def test_each_key_refuses_what_its_schema_forbids(name):
    allowed, required, definitions = keys(MODELS[name])
    base = {key: good(allowed[key][0], definitions) for key in required}
    wrong = []
    for key, kinds in allowed.items():
        for value in bad_values(kinds, definitions):
            try:
                validate(MODELS[name], {**base, key: value}, "a.toml")
            except InputError as error:
                said = str(error)
                if not (said.startswith(f"a.toml: {key}") and said.isprintable() and len(said) < 700):
                    wrong.append((key, value, said))
            else:
                wrong.append((key, value, "taken"))
    assert wrong == []


@pytest.mark.parametrize("name", MODELS)
def test_unknown_and_missing_keys_are_named(name):
    allowed, required, definitions = keys(MODELS[name])
    base = {key: good(allowed[key][0], definitions) for key in required}
    with pytest.raises(InputError, match=r"^a\.toml: zz_top = 1: unknown key(; allowed: |$)"):
        validate(MODELS[name], {**base, "zz_top": 1}, "a.toml")
    for key in required:
        with pytest.raises(InputError, match=rf"^a\.toml: {key}: missing; it must be given"):
            validate(MODELS[name], {k: v for k, v in base.items() if k != key}, "a.toml")


def bounds():
    """Return a line for each key: its model, its types, bounds and words."""
    lines = []
    for name, model in MODELS.items():
        allowed, required, definitions = keys(model)
        for key, kinds in allowed.items():
            told = " | ".join(dict.fromkeys(_told(form, definitions) for form in kinds))
            lines.append(f"{name}.{key}{'' if key in required else '?'}: {told}")
    return "\n".join(lines) + "\n"


def _told(form, definitions):
    kind = form.get("const", form.get("enum", form.get("type", "any")))
    limits = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    told = [str(kind), *(f"{sign} {form[word]}" for word, sign in limits.items() if word in form)]
    told += [f"{word} {form[word]}" for word in ("minLength", "maxLength", "minItems", "maxItems") if word in form]
    if kind == "array":
        items = form.get("prefixItems") or [form.get("items", {})]
        told.append(
            " or ".join(dict.fromkeys(_told(f, definitions) for item in items for f in forms(item, definitions)))
        )
    return " ".join(told) if "properties" not in form else "table"


def test_types_and_bounds_are_those_of_the_list():
    assert bounds().splitlines() == BOUNDS.read_text().splitlines()


if __name__ == "__main__":
    print(bounds(), end="")

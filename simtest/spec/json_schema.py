"""Lookups in the JSON schemas that pydantic derives from the models."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def nodes_at(schema: Mapping[str, Any], path: Sequence[str | int]) -> Iterator[Mapping[str, Any]]:
    """Yield the nodes of a schema at a path, through references, unions, lists and maps.

    Parameters
    ----------
    schema : mapping
        From ``model_json_schema``.
    path : sequence of str or int
        Keys and indices, an index as number or text. The type of a tagged union may stand in between; without it the
        nodes of all its members are yielded.
    """
    yield from _walk(schema, schema, list(path))


def _walk(node: Mapping[str, Any], schema: Mapping[str, Any], path: list[str | int]) -> Iterator[Mapping[str, Any]]:
    # The same path goes on inside unions and references ...
    for way in ("oneOf", "anyOf", "allOf"):
        for option in node.get(way, ()):
            yield from _walk(option, schema, path)
    if reference := node.get("$ref"):
        yield from _walk(_definition(reference, schema), schema, path)
    if not path:
        yield node
        return
    # ... and one part of it is used up by an index, a key, or the type of a tagged union.
    part, rest = path[0], path[1:]
    if isinstance(part, int) or part.isdigit():
        for items in (node.get("items"), *node.get("prefixItems", ())):
            if isinstance(items, Mapping):
                yield from _walk(items, schema, rest)
        return
    members = node.get("discriminator", {}).get("mapping", {})
    if isinstance(values := node.get("additionalProperties"), Mapping):
        yield from _walk(values, schema, rest)
    elif child := node.get("properties", {}).get(part):
        yield from _walk(child, schema, rest)
    elif part in members:
        yield from _walk(_definition(members[part], schema), schema, rest)


def _definition(reference: str, schema: Mapping[str, Any]) -> Mapping[str, Any]:
    found: Mapping[str, Any] = schema["$defs"][reference.rsplit("/", 1)[-1]]
    return found

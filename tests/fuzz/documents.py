"""JSON and TOML as trees that keep order, take raw text as values, and may hold a key twice."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from typing import Any

from .values import literal


class Raw(str):
    """Text that stands in the document as it is."""


class Table(list):
    """Pairs of key and value, in order; a key may be there twice."""


Path = list[Any]


def parse(text: str, form: str) -> Any:
    """Return the tree of a document."""
    return _tree(json.loads(text) if form == "json" else tomllib.loads(text))


def _tree(value: Any) -> Any:
    if isinstance(value, dict):
        return Table((key, _tree(entry)) for key, entry in value.items())
    return [_tree(entry) for entry in value] if isinstance(value, list) else value


def dump(tree: Any, form: str) -> str:
    """Return the text of a tree; that of TOML has one line for each key of the top level."""
    if form == "toml":
        return "".join(f"{_key(key, form)} = {_text(value, form)}\n" for key, value in tree)
    return (
        "{\n" + ",\n".join(f"{_key(k, form)}: {_text(v, form)}" for k, v in tree) + "\n}\n"
        if _is(tree)
        else _text(tree, form)
    )


def _is(tree: Any) -> bool:
    return isinstance(tree, Table)


def _key(key: str, form: str) -> str:
    return key if isinstance(key, Raw) else literal(key, form)


def _text(value: Any, form: str) -> str:
    if isinstance(value, Raw):
        return value
    if isinstance(value, Table):
        between = ": " if form == "json" else " = "
        return "{" + ", ".join(f"{_key(key, form)}{between}{_text(entry, form)}" for key, entry in value) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_text(entry, form) for entry in value) + "]"
    return literal(value, form)


def paths(tree: Any, at: Path | None = None) -> Iterator[Path]:
    """Yield the places of all values: keys of tables and indices of lists, from the outside to the inside."""
    at = at or []
    if at:
        yield at
    entries = tree if isinstance(tree, Table) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield from paths(value, [*at, key])


def get(tree: Any, path: Path) -> Any:
    """Return the value at a place."""
    for part in path:
        tree = next(value for key, value in tree if key == part) if isinstance(tree, Table) else tree[part]
    return tree


def put(tree: Any, path: Path, value: Any) -> None:
    """Replace the value at a place."""
    parent, last = get(tree, path[:-1]), path[-1]
    if isinstance(parent, Table):
        index = next(k for k, (key, _) in enumerate(parent) if key == last)
        parent[index] = (last, value)
    else:
        parent[last] = value


def remove(tree: Any, path: Path) -> None:
    """Remove the value at a place."""
    parent, last = get(tree, path[:-1]), path[-1]
    if isinstance(parent, Table):
        parent[:] = [entry for entry in parent if entry[0] != last]
    else:
        del parent[last]


def duplicate(tree: Any, path: Path, value: Any) -> None:
    """Put a second entry with the same key, or a copy of the element of a list, behind the one at a place."""
    parent, last = get(tree, path[:-1]), path[-1]
    if isinstance(parent, Table):
        index = next(k for k, (key, _) in enumerate(parent) if key == last)
        parent.insert(index + 1, (last, value))
    else:
        parent.insert(last + 1, value)

"""The base of all models of files, and how a file that breaks one is reported."""

from __future__ import annotations

import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, core_schema

from .documents import SHOWN, parse_json, parse_toml, shortened
from .errors import InputDataError, did_you_mean
from .lines import find_line
from .regular_files import read_text_file

ModelT = TypeVar("ModelT", bound="FileModel")


def _whole(value: Any) -> Any:
    """Return a whole number as an integer: JSON does not distinguish 3.0 from 3."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


_CONVERSIONS: dict[str, Callable[[Any], Any]] = {"int": _whole, "tuple": _tuple}
"""By the kind of a core schema, what a document has in place of Python's value."""
_VALUES = ("default", "expected", "metadata", "serialization")
"""Keys of a core schema that hold no further schemas to convert for."""


def _as_in_documents(schema: Any) -> Any:
    """Return a core schema whose strict mode takes what documents have: lists for tuples, 3.0 for an integer."""
    if isinstance(schema, list):
        return [_as_in_documents(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    if schema.get("type") == "function-before" and schema["function"]["function"] in _CONVERSIONS.values():
        return schema  # of a model within this one
    changed: Any = {key: entry if key in _VALUES else _as_in_documents(entry) for key, entry in schema.items()}
    convert = _CONVERSIONS.get(str(schema.get("type")))
    return changed if convert is None else core_schema.no_info_before_validator_function(convert, changed)


class FileModel(BaseModel):
    """A model of something on disk: unknown fields are refused, instances are immutable, NaN is no number.

    What is read (:func:`parse`) is taken by its type: `true` and `"-9.81"` are no numbers, and a number is no text.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True, defer_build=True)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: type[BaseModel], handler: GetCoreSchemaHandler) -> CoreSchema:
        return _as_in_documents(handler(source))


def read_toml(path: Path, model: type[ModelT]) -> ModelT:
    """Read and check a TOML file.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the model; with file, line and field.
    """
    text = read_text_file(path)
    return parse(parse_toml(text, path), model, path, text)


def read_json(path: Path, model: type[ModelT]) -> ModelT:
    """Read and check a JSON file; errors as in :func:`read_toml`."""
    text = read_text_file(path)
    return parse(parse_json(text, path), model, path, text)


def parse(data: Any, model: type[ModelT], path: Path | str, text: str = "") -> ModelT:
    """Validate `data` against `model`, and turn the first fault into one clear message that names `path`."""
    try:
        return model.model_validate(data, strict=True)
    except ValidationError as error:
        raise _explain(error, data, model, path, text) from None


def _explain(error: ValidationError, data: Any, model: type[FileModel], path: Path | str, text: str) -> InputDataError:
    # A file of another kind has other fields. An unknown field explains the missing one beside it ("mass" for
    # "mass_kg"), so it is told first.
    faults = error.errors(include_url=False)
    unknown = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    fault = next((f for f in faults if f["loc"] == ("format",) and f["type"] == "literal_error"), unknown)
    location = _in_document(fault["loc"], data)
    where = find_line(text, location, Path(path).suffix)
    place = f"{path}, line {where}" if where else f"{path}"
    parent, name = location[:-1], str(location[-1]) if location else ""
    legal = _legal_fields(model, parent)
    section = _section(data, parent)
    others = len({_in_document(f["loc"], data) for f in faults}) - 1
    todo = f"correct the field ({others} more to correct)." if others else "correct the field."
    if fault["type"] == "extra_forbidden":
        found = f"{place}: {section} has an unknown field '{name:.{SHOWN}}'."
        return InputDataError(found, ", ".join(legal) + "." + did_you_mean(name, legal), todo)
    if fault["type"] == "missing" and _has_fields(model, parent):
        return InputDataError(f"{place}: {section} lacks the field '{name}'.", ", ".join(legal) + ".", todo)
    if fault["type"] == "missing" and isinstance(location[-1], int):
        location = parent
        fault = {**fault, "msg": _wrong_count(model, parent, data)}
    field = _field(data, location)
    message = _message(fault, location, data)
    end = "" if message.endswith("?") else "."
    return InputDataError(f"{place}: {field}: {message}{end}" if field else f"{place}: {message}{end}", todo=todo)


_BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "greater than or equal to"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "less than or equal to"),
}


def _message(fault: Any, location: tuple, data: Any) -> str:
    """Say what is wrong with a value, and show it."""
    message = fault["msg"].removeprefix("Value error, ")
    bound = _BOUNDS.get(fault["type"])
    if bound is not None and isinstance(limit := fault["ctx"][bound[0]], float):
        message = f"input should be {bound[1]} {limit:g}"  # pydantic writes 1e-12 with all its zeros
    if fault["type"] == "string_pattern_mismatch":
        message = "a name begins with a letter or digit and holds only letters, digits, '_', '.' and '-'"
    if fault["type"] == "model_type":
        message = "input should be a table"  # pydantic names the class, too
    message = _in_words_of_files(message)
    try:
        value = _at(data, location)
    except (KeyError, IndexError, TypeError):
        return shortened(message)
    if isinstance(value, dict) or (isinstance(value, list) and fault["type"] == "value_error"):
        return shortened(message)
    return f"{shortened(message)} (found {json.dumps(value, default=str):.{SHOWN}})"


def _in_words_of_files(message: str) -> str:
    """Return a message of pydantic in small letters, with lists and tables for what Python calls them."""
    small = message[:1].lower() + message[1:]
    return small.replace("a valid tuple", "a list").replace("a valid dictionary", "a table")


def _wrong_count(model: Any, location: tuple, data: Any) -> str:
    """Say how many values a list of fixed length takes."""
    for part in location:
        model = _step_into(model, part)
    return f"takes {len(get_args(model))} values; found {len(_at(data, location))}"


def _in_document(location: tuple, data: Any) -> tuple:
    """Keep of pydantic's location what stands in the document: it also names the branches of a union."""
    kept: list[Any] = []
    for k, part in enumerate(location):
        try:
            data = data[part]
            kept.append(part)
        except (KeyError, IndexError, TypeError):
            # What is missing is no part of the document either, but it comes last and is an index or a plain name.
            if k == len(location) - 1 and (isinstance(part, int) or str(part).isidentifier()):
                kept.append(part)
    return tuple(kept)


def _at(data: Any, location: tuple) -> Any:
    for part in location:
        data = data[part]
    return data


def _field(data: Any, location: tuple) -> str:
    """Name a field as its author wrote it: [[bodies]] 'cube' inertia_kg_m2, or splits.train."""
    section, rest = _nearest_name(data, location)
    dotted = shortened(".".join(str(part) for part in rest), SHOWN)
    return f"{section} {dotted}".strip() if section else dotted


def _nearest_name(data: Any, location: tuple) -> tuple[str, tuple]:
    """Return [[bodies]] 'cube' for the innermost table with a name on the way, and the rest of the way."""
    for k in range(len(location), 0, -1):
        table = _safely(data, location[:k])
        if isinstance(table, dict) and isinstance(table.get("name"), str):
            path = ".".join(str(part) for part in location[:k] if not isinstance(part, int))
            return (
                f"[[{path}]]" if isinstance(location[k - 1], int) else f"[{path}]"
            ) + f" '{shortened(table['name'], SHOWN)}'", location[k:]
    return "", location


def _safely(data: Any, location: tuple) -> Any:
    try:
        return _at(data, location)
    except (KeyError, IndexError, TypeError):
        return None


def _section(data: Any, parent: tuple) -> str:
    """Name a place in the document as its author wrote it: [world], [[bodies]] 'cube', or the top level."""
    if not parent:
        return "the top level"
    section, rest = _nearest_name(data, parent)
    path = ".".join(str(part) for part in rest if not isinstance(part, int))
    if section:
        return f"{section} {path}".strip()
    return f"[[{path}]]" if isinstance(rest[-1], int) else f"[{path}]"


def _has_fields(model: Any, parent: tuple) -> bool:
    for part in parent:
        model = _step_into(model, part)
    return hasattr(model, "model_fields")


def _legal_fields(model: Any, parent: tuple) -> list[str]:
    """Return the field names that are legal at `parent`, following nested models, lists and dictionaries."""
    for part in parent:
        model = _step_into(model, part)
    fields = getattr(model, "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def _step_into(model: Any, part: Any) -> Any:
    fields = getattr(model, "model_fields", None)
    if fields is not None:
        named = {field.alias or name: field for name, field in fields.items()}
        return _concrete(named[part].annotation) if part in named else None
    arguments = [argument for argument in get_args(model) if argument is not Ellipsis]
    return _concrete(arguments[-1]) if arguments and get_origin(model) in (dict, list, tuple) else None


def _concrete(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, types.UnionType):
        options = [option for option in get_args(annotation) if option is not type(None)]
        return options[0]
    return annotation

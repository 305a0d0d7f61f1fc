"""The base of all models of files, and how a file that breaks one is reported."""

from __future__ import annotations

import json
import re
import tomllib
import types
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from .errors import InputDataError, did_you_mean

ModelT = TypeVar("ModelT", bound="FileModel")


class FileModel(BaseModel):
    """A model of something on disk: unknown fields are refused, instances are immutable, NaN is no number."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False, validate_default=True
    )


def read_toml(path: Path, model: type[ModelT]) -> ModelT:
    """Read and check a TOML file.

    Raises:
        InputDataError: If it is missing, is no TOML, or does not fit the model; with file, line and field.
    """
    text = _read_text(path)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputDataError(f"{path}: not valid TOML: {error}.", todo="correct the syntax there.") from None
    return parse(data, model, path, text)


def read_json(path: Path, model: type[ModelT]) -> ModelT:
    """Read and check a JSON file; errors as in :func:`read_toml`."""
    text = _read_text(path)
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputDataError(f"{path}, line {error.lineno}: not valid JSON: {error.msg}.") from None
    return parse(data, model, path, text)


def parse(data: Any, model: type[ModelT], path: Path, text: str = "") -> ModelT:
    """Validate `data` against `model`, and turn the first fault into one clear message that names `path`."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _explain(error, data, model, path, text) from None


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputDataError(f"{path}: no such file.") from None
    except (IsADirectoryError, PermissionError) as error:
        raise InputDataError(f"{path}: cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise InputDataError(f"{path}: not a text file in UTF-8.") from None


def _explain(error: ValidationError, data: Any, model: type[FileModel], path: Path, text: str) -> InputDataError:
    # An unknown field explains the missing one beside it ("mass" for "mass_kg"), so it is told first.
    faults = error.errors()
    fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
    location = tuple(part for part in fault["loc"] if part != "__root__")
    where = _line(text, location)
    place = f"{path}, line {where}" if where else f"{path}"
    parent, name = location[:-1], str(location[-1]) if location else ""
    legal = _legal_fields(model, parent)
    section = _section(data, parent)
    more = f" ({len(faults) - 1} more)" if len(faults) > 1 else ""
    todo = f"correct the field{more}."
    if fault["type"] == "extra_forbidden":
        found = f"{place}: {section} has an unknown field '{name}'."
        return InputDataError(found, ", ".join(legal) + "." + did_you_mean(name, legal), todo)
    if fault["type"] == "missing":
        return InputDataError(f"{place}: {section} lacks the field '{name}'.", ", ".join(legal) + ".", todo)
    message = fault["msg"].removeprefix("Value error, ")
    value = fault.get("input")
    shown = f" (found {value!r:.80})" if not isinstance(value, dict) else ""
    field = ".".join(str(part) for part in location) or "the file"
    return InputDataError(f"{place}: {field}: {message}{shown}.", todo=todo)


def _section(data: Any, parent: tuple) -> str:
    """Name a place in the document as its author wrote it: [world], [[bodies]] 'cube', or the top level."""
    if not parent:
        return "the top level"
    value, named, in_array = data, "", False
    for part in parent:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            break
        in_array = in_array or isinstance(part, int)
        if isinstance(value, dict) and isinstance(value.get("name"), str):
            named = f" '{value['name']}'"
    path = ".".join(str(part) for part in parent if not isinstance(part, int))
    return (f"[[{path}]]" if in_array else f"[{path}]") + named


def _legal_fields(model: Any, parent: tuple) -> list[str]:
    """Return the field names that are legal at `parent`, following nested models, lists and dictionaries."""
    for part in parent:
        model = _step_into(model, part)
    fields = getattr(model, "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def _step_into(model: Any, part: Any) -> Any:
    fields = getattr(model, "model_fields", None)
    if fields is not None:
        return _concrete(fields[part].annotation) if part in fields else None
    arguments = get_args(model)
    return _concrete(arguments[-1]) if arguments and get_origin(model) in (dict, list, tuple) else model


def _concrete(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, types.UnionType):
        options = [option for option in get_args(annotation) if option is not type(None)]
        return options[0]
    return annotation


def _line(text: str, location: tuple) -> int | None:
    """Find the line of a TOML or JSON text that holds the field at `location`, where that is certain."""
    names = [str(part) for part in location if not isinstance(part, int)]
    if not names or not text:
        return None
    pattern = re.compile(rf"""(^|[\s{{,."'\[])["']?{re.escape(names[-1])}["']?\s*[\]=:]""")
    lines = [number for number, line in enumerate(text.splitlines(), 1) if pattern.search(line)]
    return lines[0] if len(lines) == 1 else None

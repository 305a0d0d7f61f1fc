"""Texts in JSON and TOML, read strictly: what the format allows but no value can mean is refused, with its place."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .errors import InputDataError
from .lines import LONGEST_KEY, find_line

MAX_DEPTH = 100
"""Largest depth of nested lists and tables; deeper ones exhaust the stack of whatever reads them."""
MAX_DIGITS = 300
"""Most digits of a number; longer ones are beyond every floating-point number."""
MAX_TOML_BYTES = 1 << 26
"""Largest TOML text [bytes]; its parser takes minutes for more."""
SHOWN = 80
"""Most characters of a value or a name in a message."""
_DOUBTFUL = re.compile(r"\\u(?:0000|[dD][89a-fA-F])|\\U00000000")
"""Escapes that may write a null character or half of a surrogate pair."""
_DEEP_KEY = re.compile(
    rf"""(?:^|[{{,\[])[ \t]*(?:(?:"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|[A-Za-z0-9_-]+)[ \t]*\.[ \t]*){{{MAX_DEPTH}}}""",
    re.MULTILINE,
)
"""A dotted key of more parts than the depth; for one of thousands the TOML parser takes memory by their square."""
_CORRECT = "correct the value there."
_CORRECT_SYNTAX = "correct the syntax there; a file that was cut off is to be written again."


def parse_json(text: str, path: Path | str) -> Any:
    """Return the value that a JSON text holds; a byte order mark before it is skipped.

    Args:
        text: The document.
        path: Where it comes from, for messages.

    Raises:
        InputDataError: If it is no JSON, has a key twice, is nested deeper than `MAX_DEPTH`, or holds a number that is
            not finite or a string that is no text; with line or field.
    """
    text = text.removeprefix("\ufeff")

    def table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise _twice(text, path, [key for key, _ in pairs])
        return found

    try:
        data = json.loads(text, object_pairs_hook=table)
    except json.JSONDecodeError as error:
        raise InputDataError(
            f"{path}, line {error.lineno}: not valid JSON: {error.msg}.", todo=_CORRECT_SYNTAX
        ) from None
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError:
        raise _too_long(text, path) from None
    _require_values(data, text, path, ".json")
    return data


def parse_toml(text: str, path: Path | str) -> dict[str, Any]:
    """Return the tables that a TOML text holds; arguments and errors as in :func:`parse_json`."""
    text = text.removeprefix("\ufeff")
    if len(text) > MAX_TOML_BYTES:
        raise InputDataError(
            f"{path}: {len(text) / 1e6:.0f} MB.",
            f"TOML of at most {MAX_TOML_BYTES / 1e6:.0f} MB.",
            "check that this is the right file.",
        )
    if _DEEP_KEY.search(text):
        raise _too_deep(path)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputDataError(f"{path}: not valid TOML: {shortened(error)}.", todo=_CORRECT_SYNTAX) from None
    except RecursionError:
        raise _too_deep(path) from None
    except ValueError as error:
        if "digits" not in str(error):  # a date that cannot be
            raise InputDataError(f"{path}: not valid TOML: {shortened(error)}.", todo=_CORRECT) from None
        raise _too_long(text, path) from None
    _require_values(data, text, path, ".toml")
    return data


def shortened(text: object, longest: int = 300) -> str:
    """Return a text for a message, of which the middle is left out where it is long."""
    shown = str(text)
    return shown if len(shown) <= longest else f"{shown[: longest - 20]} ... {shown[-15:]}"


def _require_values(data: Any, text: str, path: Path | str, suffix: str) -> None:
    """Refuse depths, numbers and strings that nothing can take."""
    doubtful = _DOUBTFUL.search(text) is not None
    for place, value in _values(data):
        fault = _fault(value, doubtful) if value is not _DEEPER else f"nested deeper than {MAX_DEPTH} levels"
        if fault is None:
            continue
        line = find_line(text, place, suffix)
        field = shortened(".".join(str(part) for part in place), SHOWN)
        field = field.encode("utf-8", "backslashreplace").decode()
        where = f"{path}, line {line}" if line else f"{path}"
        raise InputDataError(f"{where}: {f'{field}: ' if field else ''}{fault}.", todo=_CORRECT)


_DEEPER = object()


def _values(data: Any) -> Iterator[tuple[tuple, Any]]:
    """Yield all numbers, keys and strings with their places, and `_DEEPER` where a list or table is too deep."""
    if not isinstance(data, dict | list):
        yield (), data
        return
    stack: list[tuple[tuple, Any]] = [((), data)]
    while stack:
        place, holder = stack.pop()
        table = isinstance(holder, dict)
        for key, value in holder.items() if table else enumerate(holder):
            if table:
                yield place, key
            if not isinstance(value, dict | list):
                yield (*place, key), value
            elif len(place) + 1 < MAX_DEPTH:
                stack.append(((*place, key), value))
            else:
                yield place, _DEEPER
                return


def _fault(value: object, doubtful: bool) -> str | None:
    """Return what no reader can take of a number or string; `doubtful`: whether strings have to be looked at."""
    if isinstance(value, float):
        return None if math.isfinite(value) else f"input should be a finite number (found {json.dumps(value)})"
    if isinstance(value, int):
        # 2^10 is about 10^3
        return None if value.bit_length() * 3 <= MAX_DIGITS * 10 else f"a number of more than {MAX_DIGITS} digits"
    if not doubtful or not isinstance(value, str):
        return None
    if "\0" in value:
        return "a text with a null character"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "a text with half of a surrogate pair, which is no character"
    return None


def _twice(text: str, path: Path | str, keys: list[str]) -> InputDataError:
    seen: set[str] = set()
    key = next(key for key in keys if key in seen or seen.add(key))
    pattern = rf"{re.escape(json.dumps(key))}\s*:" if len(key) <= LONGEST_KEY else "$^"
    places = [found.start() for found in re.finditer(pattern, text)]
    where = f", line {text.count(chr(10), 0, places[1]) + 1}" if len(places) == 2 else ""
    todo = "keep one of the two; a reader would take the last without a word."
    return InputDataError(f"{path}{where}: the key {json.dumps(key):.{SHOWN}} stands twice in one table.", todo=todo)


def _too_deep(path: Path | str) -> InputDataError:
    return InputDataError(f"{path}: nested deeper than {MAX_DEPTH} levels.", f"{MAX_DEPTH} levels.", _CORRECT)


def _too_long(text: str, path: Path | str) -> InputDataError:
    found = re.search(rf"[0-9_]{{{MAX_DIGITS + 1}}}", text)
    where = "" if found is None else f", line {text.count(chr(10), 0, found.start()) + 1}"
    return InputDataError(f"{path}{where}: a number of more than {MAX_DIGITS} digits.", todo=_CORRECT)

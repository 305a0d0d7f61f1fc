"""Values as the text of TOML, such that they are read again as they are."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping

from pydantic import BaseModel

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def toml_key(name: str) -> str:
    """Return a key, in quotes where TOML wants them.

    >>> toml_key("speed_m_s"), toml_key("if_ds/3")
    ('speed_m_s', '"if_ds/3"')
    """
    return name if _BARE.fullmatch(name) else _quoted(name)


def toml_value(value: object) -> str:
    """Return a value: a number, a truth value, a text, a sequence, a table or a model.

    >>> toml_value({"if_ds/3": 0.7, "pairs": [("a", "b")], "on": True})
    '{ "if_ds/3" = 0.7, pairs = [["a", "b"]], on = true }'
    """
    if isinstance(value, BaseModel):
        return toml_value(value.model_dump())
    if isinstance(value, Mapping):
        entries = [f"{toml_key(str(name))} = {toml_value(entry)}" for name, entry in value.items()]
        return f"{{ {', '.join(entries)} }}" if entries else "{}"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)


def _quoted(text: str) -> str:
    # the escapes of JSON are escapes of TOML; pairs of surrogates are not, so other letters stay as they are
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

"""Writing of the manifest of a capture, `capture.toml`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from ...schemas import CaptureManifest
from ..io.atomic import new_file, replaced_file

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def write_manifest(path: Path | str, manifest: CaptureManifest, overwrite: bool = False) -> None:
    """Write a manifest as TOML; default values are omitted, except those of the world."""
    with replaced_file(path) if overwrite else new_file(path, "manifest") as temporary:
        temporary.write_text(manifest_toml(manifest), encoding="utf-8")


def manifest_toml(manifest: CaptureManifest) -> str:
    """Return the text of `capture.toml`; reading it back gives an equal manifest."""
    data = manifest.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    data |= {"world": manifest.world.model_dump(mode="json", exclude_none=True)}
    lines = [f"format = {_value(manifest.format)}"]
    for name in type(manifest).model_fields:
        content = data.get(name)
        if name == "format" or not content:
            continue
        for table in content if isinstance(content, list) else [content]:
            header = f"[[{name}]]" if isinstance(content, list) else f"[{name}]"
            lines += ["", header, *(f"{_key(key)} = {_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, str):
        # JSON's escapes are all legal in TOML; only DEL has to be escaped there and not in JSON.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return {True: "true", False: "false"}[value] if isinstance(value, bool) else repr(value)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _value(key)

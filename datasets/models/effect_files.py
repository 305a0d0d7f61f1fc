"""Sources of custom effects in a model directory: `effects/<name>.py`, with their SHA-256 in `model.json`.

In memory an effect is named by the absolute path of its source, and its SHA-256 names the content: what is read once
is kept, so that an edit of the file during a fit changes neither what is run nor what is packed. Nothing is imported
here.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

from ...schemas import EffectModel, InputDataError
from ...schemas.regular_files import real_path, require_regular_file

EFFECTS = "effects"
_CONTENTS: dict[str, bytes] = {}
"""Contents of the sources that this process has read, by SHA-256."""
_PACKED = re.compile(rf"{EFFECTS}/[\w-]+\.py")


def effect_file(name: str) -> tuple[Path, str] | None:
    """Return the file of an effect and the rest of its name (`Class`, `Class@group`); None for one without a file."""
    file, _, rest = name.partition(":")
    return (Path(file), rest) if file.endswith(".py") else None


def read_source(path: Path) -> str:
    """Read the source of an effect as it is now, keep its content, and return its SHA-256.

    Raises:
        InputDataError: If there is no such file.
    """
    data = _read(path)
    digest = hashlib.sha256(data).hexdigest()
    _CONTENTS[digest] = data
    return digest


def source_content(path: Path, sha256: str | None) -> bytes:
    """Return the content of the source of an effect: the kept one with this SHA-256, or that of the file.

    Raises:
        InputDataError: If there is no such file, or it has another content.
    """
    found = sha256 if sha256 in _CONTENTS else read_source(path)
    if sha256 not in (None, found):
        raise InputDataError(
            f"{path}: its content has changed since the effect in it was read (SHA-256).",
            "the file that was read.",
            "run the command again, and leave the file alone while it runs.",
        )
    return _CONTENTS[found or ""]


def packed_name(name: str) -> str:
    """Return the name of an effect as a model directory or a dataset has it: without the path of its file."""
    found = effect_file(name)
    return name if found is None else f"{EFFECTS}/{found[0].name}:{found[1]}"


def pack_effects(effects: Iterable[EffectModel], directory: Path) -> tuple[EffectModel, ...]:
    """Copy the sources of effects into a model directory, and return the entries of `model.json`.

    Raises:
        InputDataError: If a source cannot be read, or two of different content have one name.
    """
    entries, contents = [], {}
    for effect in effects:
        found = effect_file(effect.name)
        if found is not None:
            data = source_content(found[0], effect.sha256)
            if contents.setdefault(found[0].name, data) != data:
                raise InputDataError(f"two effects have different files called {found[0].name}.", todo="rename one.")
            (directory / EFFECTS).mkdir(exist_ok=True)
            (directory / EFFECTS / found[0].name).write_bytes(data)
            update = {"name": packed_name(effect.name), "sha256": hashlib.sha256(data).hexdigest()}
            effect = effect.model_copy(update=update)  # noqa: PLW2901
        entries.append(effect)
    return tuple(entries)


def unpack_effects(effects: Iterable[EffectModel], root: Path) -> tuple[EffectModel, ...]:
    """Return effects by the absolute paths of their sources in a model directory, which are compared with their hashes.

    Raises:
        InputDataError: If a source lies elsewhere, is missing, or has another content than the recorded one.
    """
    entries = []
    for effect in effects:
        found, where = effect_file(effect.name), f"{root / 'model.json'}: effect '{effect.name}'"
        if found is not None:
            if not _PACKED.fullmatch(found[0].as_posix()):
                allowed = f"a file of the model, {EFFECTS}/NAME.py:CLASS."
                raise InputDataError(f"{where}: its file lies outside of the model.", allowed, "fit the model again.")
            if read_source(root / found[0]) != effect.sha256:
                raise InputDataError(
                    f"{where}: its file has another content than when the model was written (SHA-256).",
                    "the file that the model was fitted with.",
                    "get the model again from where it came, or fit it again with the new file.",
                )
            effect = effect.model_copy(update={"name": f"{real_path(root / found[0])}:{found[1]}"})  # noqa: PLW2901
        entries.append(effect)
    return tuple(entries)


def _read(path: Path) -> bytes:
    if not os.path.lexists(path):
        raise InputDataError(f"{path}: no such file, though an effect of the model is in it.", todo="bring it back.")
    return require_regular_file(path).read_bytes()

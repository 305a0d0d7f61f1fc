"""Consent to run the Python files of custom effects that a model names.

A file that the user names on the command line, or in a call, is run. One that a model names is run only if its SHA-256
was consented to: by `--trust-effects`, or because this user fitted a model with it on this machine.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

from ....datasets.io.atomic import sha256
from ....schemas import EffectModel, InputDataError, ModelFile, UsageError, read_json
from ....schemas.regular_files import require_regular_file

_VARIABLE = "CGWM_TRUSTED_EFFECTS"
"""Environment variable with the hashes that this process, and those that it starts, may run."""
_HASH = re.compile(r"[0-9a-f]{64}")


def is_trusted(digest: str) -> bool:
    """Return whether a file with this SHA-256 may be run."""
    return digest in os.environ.get(_VARIABLE, "").split() or digest in _kept()


def trusted_effects(model: Path) -> tuple[str, ...]:
    """Return the hashes of the files of a model's effects that may be run here, for workers on other machines."""
    effects = read_json(model / "model.json", ModelFile).effects
    return tuple(effect.sha256 for effect in effects if effect.sha256 is not None and is_trusted(effect.sha256))


def trust_effects(named: Iterable[str | Path]) -> None:
    """Consent, for this process and those that it starts, to run files of effects.

    Args:
        named: For each a Python file, the SHA-256 of one, or a model directory for all files of its effects.

    Raises:
        UsageError: If a name is none of these.
    """
    hashes: list[str] = []
    for name in map(str, named):
        path = Path(name)
        if _HASH.fullmatch(name.lower()):
            hashes.append(name.lower())
        elif path.suffix == ".py" and path.is_file():
            hashes.append(sha256(require_regular_file(path)))
        elif (path / "model.json").is_file():
            effects = read_json(path / "model.json", ModelFile).effects
            hashes += [effect.sha256 for effect in effects if effect.sha256 is not None]
        else:
            raise UsageError(
                f"--trust-effects {name}: no effect is known by this.",
                "a Python file, its SHA-256 (64 hexadecimal digits), or a model directory.",
                "name the file whose effect you have read and trust.",
            )
    os.environ[_VARIABLE] = " ".join(dict.fromkeys((*os.environ.get(_VARIABLE, "").split(), *hashes)))


def keep_trust(effects: Iterable[EffectModel]) -> None:
    """Keep the consent to the files of effects with which this user has fitted a model on this machine."""
    hashes = [effect.sha256 for effect in effects if effect.sha256 is not None]
    new, file = [one for one in hashes if one not in _kept()], _store()
    if not new:
        return
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor = os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        with os.fdopen(descriptor, "w") as stream:
            stream.write("".join(f"{one}\n" for one in new))
    except OSError:
        return  # without a home directory the next command asks


def require_trust(path: Path, data: bytes) -> None:
    """Raise an error for a file whose content was not consented to.

    Raises:
        InputDataError: With the file, its hash, and how to consent.
    """
    digest = hashlib.sha256(data).hexdigest()
    if not is_trusted(digest):
        raise InputDataError(
            f"{path} is Python code that a model brings along, and nobody has consented to run it (SHA-256 {digest}).",
            "effects of files that you have read and trust.",
            f"read the file, then add --trust-effects {path}, or its SHA-256.",
        )


def _store() -> Path:
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "cgwm" / "trusted-effects"


def _kept() -> frozenset[str]:
    """Return the kept hashes; none if somebody else could have written them."""
    file = _store()
    try:
        status = file.stat()
        foreign = hasattr(os, "getuid") and (status.st_uid != os.getuid() or bool(status.st_mode & 0o022))
        return frozenset() if foreign else frozenset(_HASH.findall(file.read_text(encoding="ascii")))
    except (OSError, ValueError):
        return frozenset()

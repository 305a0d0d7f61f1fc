"""Whether a finished model is the one that a fit with `--resume` would write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...schemas import ModelFile, Provenance, UsageError
from .effect_files import effect_file
from .model import read_model

SHOWN = 4
"""Maximum number of differences in a message."""


def finished_model(path: Path, wanted: Provenance, overwrite: bool) -> ModelFile | None:
    """Return the content of a model that was made of the same with the same settings; None if it is to be made.

    Args:
        path: MODEL, which need not exist.
        wanted: What the model would be made of; effects in files by the name that the settings give them.
        overwrite: Whether a model that was made of others is to be replaced.

    Raises:
        InputDataError: If the model is damaged.
        UsageError: If it was made of other inputs or with other settings, and `overwrite` is not set.
    """
    if not (path / "model.json").is_file():
        return None
    made = read_model(path).file
    differences = [*_differing_inputs(made, wanted), *_differing_settings(made.provenance.config, wanted.config)]
    if not differences:
        return made
    if overwrite:
        return None
    more = [f"{len(differences) - SHOWN} more"] if len(differences) > SHOWN else []
    raise UsageError(
        f"{path} is complete, and was made with other {', '.join([*differences[:SHOWN], *more])}.",
        "the same command, on the same capture, with --resume.",
        "choose another --out, or pass --overwrite to make this model anew.",
    )


def _differing_inputs(made: ModelFile, wanted: Provenance) -> list[str]:
    """Return the names of files whose hashes differ; those of effects are known by content, wherever the file lies."""
    sources = {effect.sha256 for effect in made.effects}
    found, here = made.provenance.input_sha256, wanted.input_sha256
    effects = {name for name in {*found, *here} if effect_file(name) is not None}
    files = [name for name in sorted({*found, *here} - effects) if found.get(name) != here.get(name)]
    return files + [name for name in sorted(effects & set(here)) if here[name] not in sources]


def _differing_settings(found: Any, here: Any, name: str = "") -> list[str]:
    """Return the settings that differ, with their values."""
    if isinstance(found, Mapping) and isinstance(here, Mapping):
        keys = sorted({*found, *here})
        return [
            line
            for key in keys
            for line in _differing_settings(found.get(key), here.get(key), f"{name}.{key}" if name else str(key))
        ]
    return [] if found == here else [f"{name} ({found!r:.40}, here {here!r:.40})"]

"""What a fit is made of: hashes of the files that it reads, settings and versions.

A checkpoint is continued, and a finished model kept, only by a fit that is made of the same.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping
from pathlib import Path

from ...schemas import PhysConfig, Provenance, SplatConfig
from ..capture.capture import Capture
from ..capture.colmap_model import find_colmap_model
from ..capture.geometry_maps import KINDS
from ..capture.sparse_points import POINTS_NAME
from ..io.atomic import sha256
from .effect_files import effect_file

_NO_FILES = frozenset({"settings", "versions", "physics settings", "split"})
"""Entries that are no hashes of files."""


def photo_inputs(capture: Capture, config: SplatConfig) -> dict[str, str]:
    """Return what the stage sg-gs is made of, by name."""
    root, colmap = capture.root, find_colmap_model(capture.root)
    names = ("images", "masks", *KINDS, "capture.toml", "cameras.json", "transforms.json", POINTS_NAME)
    paths = [root / name for name in names] + ([] if colmap is None else [colmap])
    inputs = {path.relative_to(root).as_posix(): sha256(path) for path in paths if path.exists()}
    return {"settings": config.model_dump_json(), "versions": json.dumps(versions()), **inputs, **_shapes(capture)}


def motion_inputs(capture: Capture, parent: Path | None, split: str, config: PhysConfig) -> dict[str, str]:
    """Return what the stage phys-geo is made of, by name, without the tracks; `parent`: the model that it changes."""
    made = {"physics settings": config.model_dump_json(), "split": split}
    if parent is not None and (parent / "model.json").is_file():
        made["parent model"] = sha256(parent / "model.json")
    if config.supervise == "tracks" or split not in capture.manifest.splits:
        return made
    for name in ("capture.toml", "cameras.json"):
        if (capture.root / name).is_file():
            made[name] = sha256(capture.root / name)
    for episode in capture.episodes(split):
        for camera in capture.videos(episode):
            made[f"video {camera}/{episode}"] = sha256(capture.video_path(camera, episode))
    return made


def input_hashes(
    capture: Capture, split: str, parent: Path | None, effects: tuple[str, ...], made_of: Mapping[str, str]
) -> dict[str, str]:
    """Return the SHA-256 of every file that a fit reads, by name.

    Args:
        capture: The capture.
        split: Name of the fitted episodes.
        parent: The model that the fit starts from, or None.
        effects: Names of the effects that the settings ask for.
        made_of: What the stages are made of.
    """
    names = ["capture.toml", "cameras.json"]
    if split in capture.manifest.splits:
        names += [f"tracks/{episode}.csv" for episode in capture.episodes(split)]
    files = {name: capture.root / name for name in names}
    files |= {name: found[0] for name in effects if (found := effect_file(name)) is not None}
    if parent is not None:
        files["parent model"] = parent / "model.json"
    hashes = {name: sha256(path) for name, path in files.items() if path.is_file()}
    return hashes | {name: digest for name, digest in made_of.items() if name not in _NO_FILES} | _shapes(capture)


def versions() -> dict[str, str]:
    """Return the versions of cgwm and its numerical libraries."""
    return {name: importlib.metadata.version(name) for name in ("cgwm", "torch", "numpy", "scipy")}


def _shapes(capture: Capture) -> dict[str, str]:
    """Return the hashes of the files of the bodies' shapes."""
    files = [file for body in capture.manifest.bodies if (file := capture.shape_file(body)) is not None]
    files += [capture.root / entry.path for entry in capture.manifest.articulations]
    return {file.relative_to(capture.root).as_posix(): sha256(file) for file in files if file.is_file()}


def changed_since_fit(provenance: Provenance, capture: Capture) -> list[str]:
    """Return a warning if a capture's manifest is no longer the one that a model was fitted with, else nothing.

    The same capture is recognised by a track or the cameras that the fit has read, as its directory may have moved.

    Args:
        provenance: Of the model.
        capture: Where the model is applied.
    """
    read = provenance.input_sha256
    shared = [name for name in read if name.startswith("tracks/") or name == "cameras.json"]
    there = [name for name in shared if (capture.root / name).is_file()]
    same = any(read[name] == sha256(capture.root / name) for name in there[:1])
    manifest = capture.root / "capture.toml"
    if not same or "capture.toml" not in read or read["capture.toml"] == sha256(manifest):
        return []
    return [
        f"{manifest} has changed since the model was fitted: what it says of world and bodies is in the model "
        "as it was then. Fit again if one of these has changed."
    ]

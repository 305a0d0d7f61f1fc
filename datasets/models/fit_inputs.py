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
    inputs = _hashes({path.relative_to(root).as_posix(): path for path in paths})
    return {"settings": config.model_dump_json(), "versions": json.dumps(versions()), **inputs, **_shapes(capture)}


def _hashes(paths: Mapping[str, Path]) -> dict[str, str]:
    """Return the SHA-256 of what is there of files and folders, by name."""
    return {name: sha256(path) for name, path in paths.items() if path.exists()}


def motion_inputs(capture: Capture, parent: Path | None, split: str, config: PhysConfig) -> dict[str, str]:
    """Return what the stage phys-geo is made of, by name, without the tracks; `parent`: the model that it changes."""
    made = {"physics settings": config.model_dump_json(), "split": split}
    if parent is not None:
        made |= _hashes({"parent model": parent / "model.json"})
    if config.supervise == "tracks" or split not in capture.manifest.splits:
        return made
    seen = [(camera, episode) for episode in capture.episodes(split) for camera in capture.videos(episode)]
    videos = {f"video {camera}/{episode}": capture.video_path(camera, episode) for camera, episode in seen}
    return made | _hashes({name: capture.root / name for name in ("capture.toml", "cameras.json")} | videos)


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
    return (
        _hashes(files) | {name: digest for name, digest in made_of.items() if name not in _NO_FILES} | _shapes(capture)
    )


def versions() -> dict[str, str]:
    """Return the versions of cgwm and its numerical libraries."""
    return {name: importlib.metadata.version(name) for name in ("cgwm", "torch", "numpy", "scipy")}


def _shapes(capture: Capture) -> dict[str, str]:
    """Return the hashes of the files of the bodies' shapes."""
    files = [file for body in capture.manifest.bodies if (file := capture.shape_file(body)) is not None]
    files += [capture.root / entry.path for entry in capture.manifest.articulations]
    return _hashes({file.relative_to(capture.root).as_posix(): file for file in files})


def changed_since_fit(provenance: Provenance, capture: Capture) -> list[str]:
    """Return a warning if a capture's manifest is no longer the one that a model was fitted with, else nothing.

    The same capture is recognised by a track or the cameras that the fit has read, as its directory may have moved.

    Args:
        provenance: Of the model.
        capture: Where the model is applied.
    """
    read, manifest = provenance.input_sha256, capture.root / "capture.toml"
    if not _is_read(read, capture) or read.get("capture.toml") in (None, sha256(manifest)):
        return []
    return [
        f"{manifest} has changed since the model was fitted: what it says of world and bodies is in the model "
        "as it was then. Fit again if one of these has changed."
    ]


def _is_read(read: Mapping[str, str], capture: Capture) -> bool:
    """Return whether a capture is the one of which a fit has read these files: by the first track, or the cameras."""
    shared = [name for name in read if name.startswith("tracks/") or name == "cameras.json"]
    there = next((name for name in shared if (capture.root / name).is_file()), None)
    return there is not None and read[there] == sha256(capture.root / there)

"""Scenes of a published controller for an Allegro hand: without their textures, and with objects of another size."""

from __future__ import annotations

import re
import shutil
from pathlib import Path


def scene_of(repository: Path, folder: Path, name: str) -> Path:
    """Copy the files of a scene without textures, and return the scene."""
    shutil.copytree(repository / "envs", folder / "envs", dirs_exist_ok=True)
    scene = folder / "envs" / "xmls" / f"env_allegro_{name}.xml"
    text = re.sub(r"<(texture|material)\b[^>]*/>", "", scene.read_text(encoding="utf-8"))
    scene.write_text(re.sub(r'\bmaterial="[^"]*"', "", text), encoding="utf-8")
    return scene


def resized(scene: Path, factor: float) -> Path:
    """Write a scene whose object has another size and the same mass beside a scene, and return it."""
    if factor == 1.0:
        return scene

    def times(found: re.Match[str]) -> str:
        return found[1] + " ".join(str(factor * float(number)) for number in found[2].split()) + found[3]

    text = scene.read_text(encoding="utf-8")
    text = re.sub(r'(<mesh name="object" (?![^>]*scale)[^>]*?)(/>)', r'\1 scale="1 1 1"\2', text)
    text = re.sub(r'(<mesh name="object" [^>]*scale=")([^"]*)(")', times, text)
    text = re.sub(r'(<geom name="obj" type="box" [^>]*size=")([^"]*)(")', times, text)
    made = scene.with_name(f"{scene.stem}_times_{factor:g}.xml")
    made.write_text(text, encoding="utf-8")
    return made

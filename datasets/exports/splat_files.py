"""The visual spheres of a model as .ply of 3D Gaussian splatting: one file, or a folder with one for each part."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..io.atomic import new_directory
from ..models.model import Model
from ..shapes.ply import Splats, write_splats


def write_splat_files(path: Path, model: Model, sh_degree: int = 0, overwrite: bool = False) -> dict[str, int]:
    """Write the spheres; return the number of spheres by file.

    Args:
        path: If it ends in .ply, one file with all spheres in the world frame, bodies in their photo poses. Otherwise
            a folder with `scene.ply` (world frame) and `<body>.ply` (body frame).
        model: A model with visual spheres.
        sh_degree: Pad with zeros up to this degree of harmonics; INRIA's loader requires 3.
        overwrite: Replace what exists.
    """
    if path.suffix.lower() == ".ply":
        whole = in_world(model)
        write_splats(path, whole, "world", sh_degree, overwrite)
        return {path.name: len(whole)}
    counts: dict[str, int] = {}
    with new_directory(path, "splat folder", overwrite) as folder:
        if model.scene is not None:
            write_splats(folder / "scene.ply", model.scene, "world", sh_degree)
            counts["scene.ply"] = len(model.scene)
        for name, splats in model.body_splats.items():
            file = f"{name}.ply" if f"{name}.ply" not in counts else f"{name}-body.ply"
            write_splats(folder / file, splats, "body", sh_degree)
            counts[file] = len(splats)
    return counts


def in_world(model: Model, poses: dict[str, tuple[np.ndarray, np.ndarray]] | None = None) -> Splats:
    """Return all visual spheres in the world frame; bodies with their mean colours over all directions.

    Args:
        model: A model with visual spheres.
        poses: position_m (3,) and quat_wxyz (4,) by body; by default the photo poses.
    """
    parts = [] if model.scene is None else [model.scene]
    for name, splats in model.body_splats.items():
        photo = model.body(name).photo_pose
        position, quat = (poses or {}).get(name, (np.array(photo.position_m), np.array(photo.quat_wxyz)))
        rotation = Rotation.from_quat(quat, scalar_first=True).as_matrix()
        normals = None if splats.normals is None else splats.normals @ rotation.T
        means = splats.means @ rotation.T + position
        parts.append(replace(splats, means=means, normals=normals, harmonics=None))
    return _joined(parts)


def _joined(parts: list[Splats]) -> Splats:
    fields = ("means", "scales", "opacities", "colors")
    # unknown normals are written as zeros
    normals = [np.zeros((len(part), 3)) if part.normals is None else part.normals for part in parts]
    some = any(part.normals is not None for part in parts)
    joined = [np.concatenate([np.asarray(getattr(part, name)) for part in parts]) for name in fields]
    return Splats(*joined, normals=np.concatenate(normals) if some else None, harmonics=_joined_harmonics(parts))


def _joined_harmonics(parts: list[Splats]) -> NDArray[Any] | None:
    """Return the harmonics of all spheres, those of a lower degree padded with zeros; None where no part has any."""
    terms = max((part.harmonics.shape[1] for part in parts if part.harmonics is not None), default=0)
    if not terms:
        return None
    padded = np.zeros((sum(map(len, parts)), terms, 3))
    first = 0
    for part in parts:
        if part.harmonics is not None:
            padded[first : first + len(part), : part.harmonics.shape[1]] = part.harmonics
        first += len(part)
    return padded

"""The checks of a dataset: schema, numbers, hashes, reprojection of the poses, and Newton's law for the labels."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from ..datasets.cameras import Camera
from ..datasets.dataset import check_hashes, read_manifest
from ..datasets.loader import camera_of
from ..datasets.models import Model, read_model
from ..datasets.progress import progress
from ..datasets.rollouts import Node, demo_names, open_shard
from ..schemas import DatasetManifest, InputDataError, ValidationReport
from .sampling import rotation_matrix

QUATERNION_TOLERANCE = 1e-6
IMPULSE_TOLERANCE = 1e-6
"""Largest excess of momentum change over impulse, as a fraction of the largest momentum change: float64 sums."""
SPHERE_RADIUS = 1.177
"""A lone opaque sphere lets half of the light through at this many s: sqrt(2 ln 2)."""
MARGIN_PX = 2
"""A mask may reach this far beyond the projected spheres, which overlap more than one by one."""
MIN_INSIDE = 0.95
"""Fraction of a body's mask that has to lie within its projected spheres."""
MIN_DEPTH_AGREEMENT = 0.9
"""Fraction of a body's mask whose depth has to lie within the body's depths."""
MIN_PIXELS = 20
"""Smaller masks are not judged."""
FRAMES_PER_ROLLOUT = 4
"""Frames of each camera whose masks and depth are looked at, evenly spread."""
SHOWN_FAULTS = 20


@dataclass
class _Findings:
    """What the checks gathered over all rollouts."""

    faults: list[str] = field(default_factory=list)
    rollouts: int = 0
    frames: int = 0
    contacts: int = 0
    impulse_excess: float = 0.0
    quaternion_error: float = 0.0
    iou: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    depth: list[float] = field(default_factory=list)
    centre_px: list[float] = field(default_factory=list)
    units: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Seen:
    """A body in one image: centres in the image, their depths and radii, from pose and camera alone."""

    pixels: np.ndarray
    depths: np.ndarray
    radii_m: np.ndarray
    focal_px: float


def validate_dataset(path: Path | str) -> ValidationReport:
    """Check every rollout of a dataset.

    Raises:
        InputDataError: If the manifest or a shard cannot be read at all.
    """
    root = Path(path)
    manifest = read_manifest(root)
    findings = _Findings(faults=check_hashes(root, manifest))
    model = _model(root, manifest, findings)
    for shard in progress(manifest.shards, "shards"):
        file = root / shard.file
        if not file.is_file():
            continue  # told by check_hashes
        try:
            with open_shard(file) as handle:
                _check_shard(handle, shard.file, model, manifest, findings)
        except InputDataError as error:
            findings.faults.append(f"{shard.file}: {error.found}")
    return ValidationReport(
        path=str(root), kind="dataset", facts=_facts(manifest, findings), faults=_shortened(findings.faults)
    )


def _model(root: Path, manifest: DatasetManifest, findings: _Findings) -> Model | None:
    try:
        return read_model(root / manifest.model)
    except InputDataError as error:
        findings.faults.append(f"{manifest.model}/: {error.found}")
        return None


def _shortened(faults: list[str]) -> tuple[str, ...]:
    if len(faults) <= SHOWN_FAULTS:
        return tuple(faults)
    return (*faults[:SHOWN_FAULTS], f"and {len(faults) - SHOWN_FAULTS} more")


def _facts(manifest: DatasetManifest, findings: _Findings) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "rollouts": findings.rollouts,
        "camera_frames": findings.frames,
        "contacts": findings.contacts,
        "shards": f"{len(manifest.shards)} of {manifest.shard_count}",
        "bodies": list(manifest.bodies),
        "cameras": list(manifest.cameras),
        "impulse_excess_n_s": findings.impulse_excess,
        "quaternion_norm_error": findings.quaternion_error,
        "units": findings.units,
        "notes": list(manifest.notes),
    }
    if findings.iou:
        facts["mask_iou_median"] = float(np.median(findings.iou))
        facts["mask_inside_projection_min"] = float(min(findings.inside))
        facts["mask_centre_error_px_median"] = float(np.median(findings.centre_px))
    if findings.depth:
        facts["depth_agreement_min"] = float(min(findings.depth))
    return facts


def _check_shard(file: Node, name: str, model: Model | None, manifest: DatasetManifest, findings: _Findings) -> None:
    names = demo_names(file)
    listed = next(shard.rollouts for shard in manifest.shards if shard.file == name)
    if len(names) != listed:
        findings.faults.append(f"{name}: {len(names)} rollouts; dataset.json says {listed}.")
    total = sum(int(demo.attrs["num_samples"]) for demo in file["data"].values())
    if total != int(file["data"].attrs["total"]):
        findings.faults.append(f"{name}: data/@total is {file['data'].attrs['total']}; the demos sum up to {total}.")
    for demo_name in names:
        place = f"{name}, {demo_name}"
        demo = file["data"][demo_name]
        try:
            findings.faults += [f"{place}: {fault}" for fault in _check_demo(demo, model, findings)]
        except KeyError as error:
            findings.faults.append(f"{place}: an array or attribute is missing: {error.args[0]}.")
        except OSError as error:
            findings.faults.append(f"{place}: a block cannot be read: {str(error).splitlines()[0]}.")


def _check_demo(demo: Node, model: Model | None, findings: _Findings) -> Iterator[str]:
    findings.rollouts += 1
    count = int(demo.attrs["num_samples"])
    yield from _check_arrays(demo, count, findings)
    time = demo["time"][()]
    if not (np.diff(time) > 0).all():
        yield f"time: not increasing at frame {int(np.argmin(np.diff(time) > 0)) + 1}."
        return
    norms = np.linalg.norm(demo["bodies/quat_wxyz"][()], axis=-1)
    error = float(np.abs(norms - 1).max())
    findings.quaternion_error = max(findings.quaternion_error, error)
    if not error <= QUATERNION_TOLERANCE:
        yield f"bodies/quat_wxyz: a norm is off 1 by {error:.2g}; {QUATERNION_TOLERANCE:g} is allowed."
    yield from _check_contacts(demo, count, findings)
    if model is not None and "cameras" in demo:
        yield from _check_images(demo, model, count, findings)


def _check_arrays(demo: Node, count: int, findings: _Findings) -> Iterator[str]:
    """Every array has its unit, the right number of frames, and finite numbers."""
    arrays: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("next_obs/"):
            arrays[name] = item

    demo.visititems(visit)
    for name, item in arrays.items():
        lacking = [key for key in ("unit", "frame", "order", "shape_meaning", "description") if key not in item.attrs]
        if lacking:
            yield f"{name}: has no attribute {', '.join(lacking)}."
            continue
        if not name.startswith(("parameters/", "cameras/", "obs/")):
            findings.units[name] = str(item.attrs["unit"])
        if str(item.attrs["shape_meaning"]).startswith("(T,") and item.shape[0] != count:
            yield f"{name}: {item.shape[0]} frames; num_samples says {count}."
        if item.dtype.kind == "f" and item.size and not _finite(item):
            yield f"{name}: holds numbers that are not finite."
    for name in json.loads(str(demo.attrs["params_json"])):
        if f"parameters/{name}" not in arrays:
            yield f"params_json names '{name}', which is not in parameters/."


def _finite(item: h5py.Dataset) -> bool:
    if item.chunks is None:
        return bool(np.isfinite(item[()]).all())
    return all(bool(np.isfinite(item[rows]).all()) for rows in item.iter_chunks())


def _check_contacts(demo: Node, count: int, findings: _Findings) -> Iterator[str]:
    contacts: dict[str, np.ndarray] = {name: item[()] for name, item in demo["contacts"].items()}
    offsets = contacts["offsets"]
    rows = len(contacts["body_a"])
    findings.contacts += rows
    if len(offsets) != count + 1 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) < 0).any():
        yield f"contacts/offsets: they do not divide {rows} contacts among {count} frames."
        return
    bodies = len(demo["bodies/names"])
    indices = np.concatenate([contacts["body_a"], contacts["body_b"]])
    if rows and (indices.min() < -1 or indices.max() >= bodies or contacts["body_a"].min() < 0):
        yield f"contacts: body indices outside 0 to {bodies - 1} (-1 = ground, only as body_b)."
        return
    normals = np.linalg.norm(contacts["normal_world"], axis=-1)
    if rows and not np.abs(normals - 1).max() <= 1e-6:
        yield "contacts/normal_world: not all of unit length."
    pulls = (contacts["impulse_world"] * contacts["normal_world"]).sum(-1)
    scale = float(np.abs(contacts["impulse_world"]).max()) if rows else 0.0
    if rows and pulls.min() < -1e-6 * scale and not json.loads(str(demo.attrs["effects_json"])):
        yield f"contacts/impulse_world: a contact pulls by {-pulls.min():.2g} N s; contacts can only push."
    yield from _check_newton(demo, contacts, findings)


def _check_newton(demo: Node, contacts: dict[str, np.ndarray], findings: _Findings) -> Iterator[str]:
    """Momentum change minus gravity equals the sum of the contact impulses, in every interval and for every free body.

    With effects in the model other forces act, whose impulses are no labels; then there is nothing to compare.
    """
    if json.loads(str(demo.attrs["effects_json"])):
        return
    read = {name: item[()] for name, item in demo["bodies"].items()}
    rotation = rotation_matrix(read["quat_wxyz"])
    swing = np.cross(read["omega_body"], read["com"][None])
    velocity = read["vel"] + np.einsum("tbij,tbj->tbi", rotation, swing)
    interval = np.diff(demo["time"][()])[:, None]
    frame = np.repeat(np.arange(len(contacts["offsets"]) - 1), np.diff(contacts["offsets"]))
    for body, motion in enumerate(read["motions"]):
        if motion != b"free":
            continue
        change = read["mass"][body] * (np.diff(velocity[:, body], axis=0) - interval * read["gravity"])
        impulse = np.zeros((len(contacts["offsets"]) - 1, 3))
        for sign, side in ((1.0, "body_a"), (-1.0, "body_b")):
            mine = contacts[side] == body
            np.add.at(impulse, frame[mine], sign * contacts["impulse_world"][mine])
        excess = np.linalg.norm(change - impulse[1:], axis=1)
        gravity = read["mass"][body] * np.linalg.norm(read["gravity"]) * interval.max()
        scale = max(float(np.linalg.norm(change, axis=1).max()), float(gravity), 1e-12)
        findings.impulse_excess = max(findings.impulse_excess, float(excess.max()))
        if not excess.max() <= IMPULSE_TOLERANCE * scale:
            worst = int(excess.argmax()) + 1
            name = read["names"][body].decode()
            yield (
                f"contacts/impulse_world: body '{name}', frame {worst}: momentum changed by {excess.max():.3g} N s "
                f"more than the impulses and gravity say; {IMPULSE_TOLERANCE * scale:.2g} is allowed."
            )


def _check_images(demo: Node, model: Model, count: int, findings: _Findings) -> Iterator[str]:
    names = [name.decode() for name in demo["bodies/names"][()]]
    position, quat = demo["bodies/pos"][()], demo["bodies/quat_wxyz"][()]
    frames = np.unique(np.linspace(0, count - 1, FRAMES_PER_ROLLOUT).round().astype(int))
    for camera_name in demo["cameras"]:
        camera = camera_of(demo[f"cameras/{camera_name}"])
        findings.frames += count
        mask_set, depth_set = (demo[f"obs/{camera_name}_{key}"] for key in ("mask", "depth"))
        size = (camera.height, camera.width)
        if mask_set.shape[1:] != size or depth_set.shape[1:] != size:
            yield f"obs/{camera_name}_mask: shape {mask_set.shape[1:]}; the camera has {size}."
            continue
        for frame in frames:
            mask, depth = mask_set[frame], depth_set[frame]
            if mask.max(initial=0) > len(names):
                yield f"obs/{camera_name}_mask, frame {frame}: label {mask.max()}; there are {len(names)} bodies."
                continue
            for body, name in enumerate(names):
                if name not in model.body_splats:
                    continue
                seen = _project(model, name, position[frame, body], quat[frame, body], camera)
                fault = _compare(seen, mask == body + 1, depth, findings)
                if fault:
                    yield f"obs/{camera_name}, frame {frame}, body '{name}': {fault}"


def _project(model: Model, name: str, position: np.ndarray, quat: np.ndarray, camera: Camera) -> _Seen:
    """Project a body's spheres by the labels alone: no renderer, so that its conventions are tested too."""
    splats = model.body_splats[name]
    solid = np.asarray(splats.opacities) > 0.1
    points = np.asarray(splats.means, float)[solid] @ rotation_matrix(quat).T + position
    pixels, depths = camera.project(points)
    return _Seen(pixels, depths, np.asarray(splats.scales, float)[solid], float(camera.K[0, 0]))


def _compare(seen: _Seen, mask: np.ndarray, depth: np.ndarray, findings: _Findings) -> str | None:
    """Compare a body's mask and depth with its projected spheres; return the fault, if there is one."""
    area = int(mask.sum())
    if area < MIN_PIXELS:
        return None
    silhouette = _silhouette(seen, mask.shape)
    wide = cv2.dilate(silhouette, np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)).astype(bool)
    inside = float((mask & wide).sum() / area)
    whole = silhouette.astype(bool)
    findings.iou.append(float((mask & whole).sum() / max(1, (mask | whole).sum())))
    findings.inside.append(inside)
    if whole.any():
        centres = [np.argwhere(part).mean(0) for part in (mask, whole)]
        findings.centre_px.append(float(np.linalg.norm(centres[0] - centres[1])))
    if inside < MIN_INSIDE:
        return f"{100 * (1 - inside):.0f} % of its mask lies outside the projected body; pose or camera is wrong."
    reach = 3 * float(seen.radii_m.max())
    shown = depth[mask]
    agreement = float(((shown > seen.depths.min() - reach) & (shown < seen.depths.max() + reach)).mean())
    findings.depth.append(agreement)
    if agreement < MIN_DEPTH_AGREEMENT:
        return (
            f"the depth of {100 * (1 - agreement):.0f} % of its mask lies outside the body "
            f"({seen.depths.min():.3f} to {seen.depths.max():.3f} m)."
        )
    return None


def _silhouette(seen: _Seen, shape: tuple[int, ...]) -> np.ndarray:
    """Paint a disc for each sphere in front of the camera; uint8 (H, W). OpenCV's pixel centres are whole numbers."""
    painted = np.zeros(shape, np.uint8)
    shift = 4
    front = np.isfinite(seen.pixels).all(1) & (seen.depths > 0)
    radii = SPHERE_RADIUS * seen.radii_m[front] * seen.focal_px / seen.depths[front]
    centres = np.clip((seen.pixels[front] - 0.5) * 2**shift, -(2**20), 2**20).round().astype(int)
    for (x, y), radius in zip(centres, radii, strict=True):
        cv2.circle(painted, (int(x), int(y)), round(float(radius) * 2**shift), 1, -1, shift=shift)
    return painted

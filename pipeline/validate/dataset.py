"""The checks of a dataset: schema, numbers, hashes, reprojection of the poses, and Newton's law for the labels."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..datasets.dataset import check_hashes, read_manifest
from ..datasets.models import Model, read_model
from ..datasets.progress import progress
from ..datasets.rollouts import Node, demo_names, open_shard
from ..schemas import DatasetManifest, Failure, InputDataError, ShardEntry, UsageError, ValidationReport
from .validate_faults import Fault
from .validate_motion import MotionFindings, check_motion, motion_facts
from .validate_pictures import PictureFindings, check_pictures, picture_facts

QUATERNION_TOLERANCE = 1e-6
SHOWN_FAULTS = 20


@dataclass
class _Findings:
    """What the checks gathered over all rollouts."""

    faults: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    rollouts: int = 0
    contacts: int = 0
    quaternion_error: float = 0.0
    motion: MotionFindings = field(default_factory=MotionFindings)
    pictures: PictureFindings = field(default_factory=PictureFindings)
    units: dict[str, str] = field(default_factory=dict)

    def add(self, shard: str, demo: str, fault: Fault) -> None:
        """Take a fault of a rollout."""
        failure = fault.at(shard, demo)
        self.failures.append(failure)
        self.faults.append(failure.text)


def validate_dataset(path: Path | str, sample: int | None = None, seed: int = 0) -> ValidationReport:
    """Check every rollout of a dataset, or some.

    Args:
        path: DATASET.
        sample: Look at so many rollouts, drawn at random from all shards that are there, and at the hashes of their
            shards alone; all where left out.
        seed: Of that draw.

    Raises:
        InputDataError: If the manifest or a shard cannot be read at all.
        UsageError: If the sample is not positive.
    """
    root = Path(path)
    manifest = read_manifest(root)
    chosen = None if sample is None else _sample(manifest.shards, sample, seed)
    findings = _Findings(faults=check_hashes(root, manifest, None if chosen is None else set(chosen)))
    model = _model(root, manifest, findings)
    shards = [shard for shard in manifest.shards if chosen is None or shard.file in chosen]
    for shard in progress(shards, "shards"):
        file = root / shard.file
        if not file.is_file():
            continue  # told by check_hashes
        try:
            with open_shard(file) as handle:
                _check_shard(handle, shard, model, findings, None if chosen is None else chosen[shard.file])
        except InputDataError as error:
            findings.faults.append(f"{shard.file}: {error.found}")
    facts = _facts(manifest, findings)
    if chosen is not None:
        facts = {"sampled": f"{findings.rollouts} of {manifest.rollouts} rollouts, seed {seed}", **facts}
    return ValidationReport(
        path=str(root),
        kind="dataset",
        facts=facts,
        faults=_shortened(findings.faults),
        failures=tuple(findings.failures),
    )


def _sample(shards: Sequence[ShardEntry], count: int, seed: int) -> dict[str, list[int]]:
    """Return places of rollouts within their shards, by file: `count` of all, or all where there are fewer."""
    if count < 1:
        raise UsageError(f"--sample {count}: no number of rollouts.", "1 or more.")
    places = [(shard.file, place) for shard in shards for place in range(shard.rollouts)]
    order = np.random.default_rng(seed).permutation(len(places))[:count]
    chosen: dict[str, list[int]] = {}
    for number in order:
        file, place = places[number]
        chosen.setdefault(file, []).append(place)
    return chosen


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
    return {
        "rollouts": findings.rollouts,
        "camera_frames": findings.pictures.frames,
        "contacts": findings.contacts,
        "shards": f"{len(manifest.shards)} of {manifest.shard_count}",
        "bodies": list(manifest.bodies),
        "cameras": list(manifest.cameras),
        "quaternion_norm_error": findings.quaternion_error,
        **motion_facts(findings.motion),
        **picture_facts(findings.pictures),
        "rejected_draws": _rejected(manifest),
        "units": findings.units,
        "notes": list(manifest.notes),
    }


def _rejected(manifest: DatasetManifest) -> dict[str, int]:
    total: dict[str, int] = {}
    for shard in manifest.shards:
        for rule, count in shard.rejected.items():
            total[rule] = total.get(rule, 0) + count
    return total


def _check_shard(
    file: Node, shard: ShardEntry, model: Model | None, findings: _Findings, places: list[int] | None
) -> None:
    names = demo_names(file)
    if len(names) != shard.rollouts:
        findings.faults.append(f"{shard.file}: {len(names)} rollouts; dataset.json says {shard.rollouts}.")
    total = sum(int(demo.attrs["num_samples"]) for demo in file["data"].values())
    if total != int(file["data"].attrs["total"]):
        listed = file["data"].attrs["total"]
        findings.faults.append(f"{shard.file}: data/@total is {listed}; the demos sum up to {total}.")
    chosen = names if places is None else [names[place] for place in sorted(places) if place < len(names)]
    for name in progress(chosen, shard.file, len(chosen), "rollout"):
        try:
            for fault in _check_demo(file["data"][name], model, findings):
                findings.add(shard.file, name, fault)
        except KeyError as error:
            text = f"an array or attribute is missing: {error.args[0]}."
            findings.add(shard.file, name, Fault("schema", text))
        except OSError as error:
            text = f"a block cannot be read: {str(error).splitlines()[0]}."
            findings.add(shard.file, name, Fault("readable", text))


def _check_demo(demo: Node, model: Model | None, findings: _Findings) -> Iterator[Fault]:
    findings.rollouts += 1
    count = int(demo.attrs["num_samples"])
    yield from _check_arrays(demo, count, findings)
    time = demo["time"][()]
    if not (np.diff(time) > 0).all():
        frame = int(np.argmin(np.diff(time) > 0)) + 1
        yield Fault("time", f"time: not increasing at frame {frame}.", frame, value=float(time[frame]))
        return
    yield from _check_states(demo, findings)
    yield from _check_parameters(demo, model)
    yield from _check_contacts(demo, count, model, findings)
    if model is not None and "cameras" in demo:
        yield from check_pictures(demo, model, count, findings.pictures)


def _check_states(demo: Node, findings: _Findings) -> Iterator[Fault]:
    """Quaternions have length 1, and robomimic's low-dimensional state is that of the bodies."""
    norms = np.linalg.norm(demo["bodies/quat_wxyz"][()], axis=-1)
    errors = np.abs(norms - 1).max(axis=1)
    error = float(errors.max())
    findings.quaternion_error = max(findings.quaternion_error, error)
    if not error <= QUATERNION_TOLERANCE:
        frame = int(errors.argmax())
        text = f"bodies/quat_wxyz: frame {frame}: a norm is off 1 by {error:.2g}; {QUATERNION_TOLERANCE:g} is allowed."
        yield Fault("quaternions", text, frame, value=error, limit=QUATERNION_TOLERANCE)
    parts = [demo[f"bodies/{key}"][()] for key in ("pos", "quat_wxyz", "vel", "omega_body")]
    expected = np.concatenate(parts, axis=-1).reshape(len(norms), -1)
    found = demo["obs/object"][()]
    if found.shape != expected.shape or not np.array_equal(found, expected, equal_nan=True):
        yield Fault("schema", "obs/object: differs from the bodies' poses and velocities.")


def _check_arrays(demo: Node, count: int, findings: _Findings) -> Iterator[Fault]:
    """Every array has its unit, the right number of frames, and finite numbers."""
    arrays: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("next_obs/"):
            arrays[name] = item

    demo.visititems(visit)
    for name, item in arrays.items():
        lacking = [key for key in ("unit", "frame", "order", "shape_meaning", "description") if key not in item.attrs]
        if lacking:
            yield Fault("schema", f"{name}: has no attribute {', '.join(lacking)}.")
            continue
        if not name.startswith(("parameters/", "cameras/", "obs/")):
            findings.units[name] = str(item.attrs["unit"])
        if str(item.attrs["shape_meaning"]).startswith("(T,") and item.shape[0] != count:
            yield Fault("schema", f"{name}: {item.shape[0]} frames; num_samples says {count}.")
        if item.dtype.kind == "f" and item.size and not _finite(item):
            yield Fault("finite", f"{name}: holds numbers that are not finite.")
    for name in json.loads(str(demo.attrs["params_json"])):
        if f"parameters/{name}" not in arrays:
            yield Fault("schema", f"params_json names '{name}', which is not in parameters/.")


def _finite(item: h5py.Dataset) -> bool:
    if item.chunks is None:
        return bool(np.isfinite(item[()]).all())
    return all(bool(np.isfinite(item[rows]).all()) for rows in item.iter_chunks())


def _check_parameters(demo: Node, model: Model | None) -> Iterator[Fault]:
    """Physical parameters lie within the bounds that the model gives them."""
    for listed in model.file.parameters if model is not None else ():
        if listed.bounds is None or listed.name not in demo["parameters"]:
            continue
        value, (low, high) = float(demo["parameters"][listed.name][()]), listed.bounds
        if not low <= value <= high:
            text = f"parameters/{listed.name}: {value:g} {listed.unit}; {low:g} to {high:g} is admissible."
            yield Fault("parameters", text, value=value, limit=low if value < low else high)


def _check_contacts(demo: Node, count: int, model: Model | None, findings: _Findings) -> Iterator[Fault]:
    contacts: dict[str, np.ndarray] = {name: item[()] for name, item in demo["contacts"].items()}
    offsets = contacts["offsets"]
    rows = len(contacts["body_a"])
    findings.contacts += rows
    if len(offsets) != count + 1 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) < 0).any():
        yield Fault("contacts", f"contacts/offsets: they do not divide {rows} contacts among {count} frames.")
        return
    bodies = len(demo["bodies/names"])
    indices = np.concatenate([contacts["body_a"], contacts["body_b"]])
    if rows and (indices.min() < -1 or indices.max() >= bodies or contacts["body_a"].min() < 0):
        text = f"contacts: body indices outside 0 to {bodies - 1} (-1 = ground, only as body_b)."
        yield Fault("contacts", text)
        return
    errors = np.abs(np.linalg.norm(contacts["normal_world"], axis=-1) - 1)
    if rows and not errors.max() <= QUATERNION_TOLERANCE:
        row = int(errors.argmax())
        frame = int(np.searchsorted(offsets, row, side="right")) - 1
        text = f"contacts/normal_world: frame {frame}, row {row}: not all of unit length, off by {errors[row]:.2g}."
        yield Fault("contacts", text, frame, value=float(errors[row]), limit=QUATERNION_TOLERANCE)
    pulls = (contacts["impulse_world"] * contacts["normal_world"]).sum(-1)
    scale = float(np.abs(contacts["impulse_world"]).max()) if rows else 0.0
    if rows and pulls.min() < -1e-6 * scale and not json.loads(str(demo.attrs["effects_json"])):
        row = int(pulls.argmin())
        frame = int(np.searchsorted(offsets, row, side="right")) - 1
        text = f"contacts/impulse_world: frame {frame}: a contact pulls by {-pulls.min():.2g} N s; contacts only push."
        yield Fault("contacts", text, frame, value=float(pulls.min()), limit=0.0)
    yield from check_motion(demo, contacts, model, findings.motion)

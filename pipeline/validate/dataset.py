"""Checks of a dataset: schema, numbers, hashes, reprojection of the poses, and Newton's laws for the labels."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...datasets.io.hdf5_files import hdf5_faults
from ...datasets.io.progress import progress
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.dataset import check_hashes, read_manifest
from ...datasets.rollouts.rollouts import Node, demo_names, demo_of, open_shard
from ...schemas import DatasetManifest, Failure, InputDataError, ShardEntry, UsageError, ValidationReport
from .faults import Fault
from .newton import MotionFindings, check_motion, motion_facts
from .reprojection import PictureFindings, check_pictures, picture_facts

QUATERNION_TOLERANCE = 1e-6
"""Largest difference of the norm of a quaternion or normal from 1."""
SHOWN_FAULTS = 20
"""Maximum number of faults listed in the report."""


@dataclass(kw_only=True)
class _Findings:
    """Results of the checks, collected over all rollouts."""

    faults: list[str] = field(default_factory=list)
    """All faults, as sentences."""
    failures: list[Failure] = field(default_factory=list)
    """The faults of rollouts, with their places and values."""
    rollouts: int = 0
    """Number of rollouts that were checked."""
    contacts: int = 0
    """Number of contacts in these rollouts."""
    quaternion_error: float = 0.0
    """Largest difference of a quaternion's norm from 1."""
    motion: MotionFindings = field(default_factory=MotionFindings)
    """Results of the checks of momentum and angular momentum."""
    pictures: PictureFindings = field(default_factory=PictureFindings)
    """Results of the comparison of poses with pictures."""
    units: dict[str, str] = field(default_factory=dict)
    """Units of the arrays, by name."""

    def add(self, shard: str, demo: str, fault: Fault) -> None:
        """Record a fault of a rollout."""
        failure = fault.at(shard, demo)
        self.failures.append(failure)
        self.faults.append(failure.text)


def validate_dataset(path: Path | str, sample: int | None = None, seed: int = 0) -> ValidationReport:
    """Check every rollout of a dataset, or some.

    Args:
        path: DATASET.
        sample: Number of rollouts to check, drawn at random from all shards that exist; only the hashes of their shards
            are checked. None checks all.
        seed: Seed of that draw.

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
            continue  # reported by check_hashes
        try:
            with open_shard(file) as handle, hdf5_faults(file):
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
    """Draw `count` rollouts, or all if there are fewer; return their indices within their shards, by file."""
    if count < 1:
        raise UsageError(f"--sample {count}: not a valid number of rollouts.", "1 or more.")
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
    total = sum(int(file["data"][name].attrs["num_samples"]) for name in names)
    if total != int(file["data"].attrs["total"]):
        listed = file["data"].attrs["total"]
        findings.faults.append(f"{shard.file}: data/@total is {listed}; the demos sum up to {total}.")
    chosen = names if places is None else [names[place] for place in sorted(places) if place < len(names)]
    for name in progress(chosen, shard.file, len(chosen), "rollout"):
        try:
            for fault in _check_demo(demo_of(file, name), model, findings):
                findings.add(shard.file, name, fault)
        except InputDataError as error:
            findings.add(shard.file, name, Fault(check="schema", text=error.found))
        except KeyError as error:
            text = f"an array or attribute is missing: {error.args[0]}."
            findings.add(shard.file, name, Fault(check="schema", text=text))
        except OSError as error:
            text = f"a block cannot be read: {str(error).splitlines()[0]}."
            findings.add(shard.file, name, Fault(check="readable", text=text))


def _check_demo(demo: Node, model: Model | None, findings: _Findings) -> Iterator[Fault]:
    findings.rollouts += 1
    count = int(demo.attrs["num_samples"])
    wrong = [name for name in ("params_json", "effects_json") if not _is_json_object(str(demo.attrs[name]))]
    if wrong:
        yield Fault(check="schema", text=f"the attribute {wrong[0]} is no JSON object; the rollout is not checked.")
        return
    yield from _check_arrays(demo, count, findings)
    time = demo["time"][()]
    if not (np.diff(time) > 0).all():
        frame = int(np.argmin(np.diff(time) > 0)) + 1
        yield Fault(check="time", text=f"time: not increasing at frame {frame}.", frame=frame, value=float(time[frame]))
        return
    yield from _check_states(demo, findings)
    yield from _check_parameters(demo, model)
    yield from _check_contacts(demo, count, model, findings)
    if model is not None and "cameras" in demo:
        yield from check_pictures(demo, model, count, findings.pictures)


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except (ValueError, RecursionError):
        return False


def _check_states(demo: Node, findings: _Findings) -> Iterator[Fault]:
    """Check that quaternions have length 1 and that robomimic's low-dimensional state equals that of the bodies."""
    norms = np.linalg.norm(demo["bodies/quat_wxyz"][()], axis=-1)
    errors = np.abs(norms - 1).max(axis=1)
    error = float(errors.max())
    findings.quaternion_error = max(findings.quaternion_error, error)
    if not error <= QUATERNION_TOLERANCE:
        frame = int(errors.argmax())
        text = f"bodies/quat_wxyz: frame {frame}: a norm differs from 1 by {error:.2g}; "
        text += f"{QUATERNION_TOLERANCE:g} is allowed."
        yield Fault(check="quaternions", text=text, frame=frame, value=error, limit=QUATERNION_TOLERANCE)
    parts = [demo[f"bodies/{key}"][()] for key in ("pos", "quat_wxyz", "vel", "omega_body")]
    expected = np.concatenate(parts, axis=-1).reshape(len(norms), -1)
    found = demo["obs/object"][()]
    if found.shape != expected.shape or not np.array_equal(found, expected, equal_nan=True):
        yield Fault(check="schema", text="obs/object: differs from the bodies' poses and velocities.")


def _check_arrays(demo: Node, count: int, findings: _Findings) -> Iterator[Fault]:
    """Check that every array has its unit, the right number of frames, and finite numbers."""
    arrays: dict[str, h5py.Dataset] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("next_obs/"):
            arrays[name] = item

    demo.visititems(visit)
    for name, item in arrays.items():
        lacking = [key for key in ("unit", "frame", "order", "shape_meaning", "description") if key not in item.attrs]
        if lacking:
            yield Fault(check="schema", text=f"{name}: has no attribute {', '.join(lacking)}.")
            continue
        if not name.startswith(("parameters/", "cameras/", "obs/")):
            findings.units[name] = str(item.attrs["unit"])
        if str(item.attrs["shape_meaning"]).startswith("(T,") and item.shape[0] != count:
            yield Fault(check="schema", text=f"{name}: {item.shape[0]} frames; num_samples says {count}.")
        if item.dtype.kind == "f" and item.size and not _finite(item):
            yield Fault(check="finite", text=f"{name}: contains numbers that are not finite.")
    for name in json.loads(str(demo.attrs["params_json"])):
        if f"parameters/{name}" not in arrays:
            yield Fault(check="schema", text=f"params_json names '{name}', which is not in parameters/.")


def _finite(item: h5py.Dataset) -> bool:
    if item.chunks is None:
        return bool(np.isfinite(item[()]).all())
    return all(bool(np.isfinite(item[rows]).all()) for rows in item.iter_chunks())


def _check_parameters(demo: Node, model: Model | None) -> Iterator[Fault]:
    """Check that physical parameters lie within the bounds of the model."""
    for listed in model.file.parameters if model is not None else ():
        if listed.bounds is None or listed.name not in demo["parameters"]:
            continue
        value, (low, high) = float(demo["parameters"][listed.name][()]), listed.bounds
        if not low <= value <= high:
            text = f"parameters/{listed.name}: {value:g} {listed.unit}; {low:g} to {high:g} is allowed."
            yield Fault(check="parameters", text=text, value=value, limit=low if value < low else high)


def _check_contacts(demo: Node, count: int, model: Model | None, findings: _Findings) -> Iterator[Fault]:
    contacts: dict[str, np.ndarray] = {name: item[()] for name, item in demo["contacts"].items()}
    offsets = contacts["offsets"]
    rows = len(contacts["body_a"])
    findings.contacts += rows
    if len(offsets) != count + 1 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) < 0).any():
        yield Fault(
            check="contacts", text=f"contacts/offsets: they do not divide {rows} contacts among {count} frames."
        )
        return
    bodies = len(demo["bodies/names"])
    indices = np.concatenate([contacts["body_a"], contacts["body_b"]])
    if rows and (indices.min() < -1 or indices.max() >= bodies or contacts["body_a"].min() < 0):
        text = f"contacts: body indices outside 0 to {bodies - 1} (-1 = ground, only as body_b)."
        yield Fault(check="contacts", text=text)
        return
    yield from _check_normals(contacts)
    yield from _check_pulls(demo, contacts)
    yield from check_motion(demo, contacts, model, findings.motion)


def _check_normals(contacts: dict[str, np.ndarray]) -> Iterator[Fault]:
    """Check that the normals of contacts have length 1."""
    errors = np.abs(np.linalg.norm(contacts["normal_world"], axis=-1) - 1)
    if len(contacts["body_a"]) and not errors.max() <= QUATERNION_TOLERANCE:
        row = int(errors.argmax())
        frame = int(np.searchsorted(contacts["offsets"], row, side="right")) - 1
        text = f"contacts/normal_world: frame {frame}, row {row}: the length differs from 1 by {errors[row]:.2g}."
        yield Fault(check="contacts", text=text, frame=frame, value=float(errors[row]), limit=QUATERNION_TOLERANCE)


def _check_pulls(demo: Node, contacts: dict[str, np.ndarray]) -> Iterator[Fault]:
    """Check that contacts do not pull; effects may add forces that do."""
    rows = len(contacts["body_a"])
    pulls = (contacts["impulse_world"] * contacts["normal_world"]).sum(-1)
    scale = float(np.abs(contacts["impulse_world"]).max()) if rows else 0.0
    if rows and pulls.min() < -1e-6 * scale and not json.loads(str(demo.attrs["effects_json"])):
        row = int(pulls.argmin())
        frame = int(np.searchsorted(contacts["offsets"], row, side="right")) - 1
        text = f"contacts/impulse_world: frame {frame}: a contact pulls by {-pulls.min():.2g} N s; contacts only push."
        yield Fault(check="contacts", text=text, frame=frame, value=float(pulls.min()), limit=0.0)

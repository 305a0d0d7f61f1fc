"""Checks of a dataset: schema, numbers, hashes, reprojection of the poses, and Newton's laws for the labels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.io.hdf5_files import hdf5_faults
from ...datasets.io.progress import progress
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.dataset import check_hashes, read_manifest, settings_text
from ...datasets.rollouts.rollouts import Node, demo_names, open_shard, stored_demo
from ...datasets.rollouts.shards import shard_range, span
from ...schemas import DatasetManifest, Failure, InputDataError, ShardEntry, UsageError, ValidationReport
from .contacts import check_contacts
from .faults import Fault
from .joints import check_joints
from .newton import MotionFindings, check_motion, motion_facts
from .reprojection import PictureFindings, check_pictures, picture_facts
from .rollout import Dataset, Rollout
from .structure import check_file, check_structure, has_usable_contacts, listing_fault

_LEAST_BYTES = 1024
"""Lower bound of the size of a rollout in a shard [bytes]: its some fifty arrays have more in their headers alone."""
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
    undocumented: set[str] = field(default_factory=set)
    """Names of arrays that are not documented, and not checked."""

    def add(self, shard: str, demo: str, fault: Fault) -> None:
        """Record a fault of a rollout."""
        failure = fault.at(shard, demo)
        self.failures.append(failure)
        self.faults.append(failure.text)

    def record(self, rollout: Rollout) -> None:
        """Record what a rollout contains."""
        self.contacts += len(rollout.values["contacts/body_a"])
        norms = np.linalg.norm(rollout.values["bodies/quat_wxyz"], axis=-1)
        self.quaternion_error = max(self.quaternion_error, float(np.abs(norms - 1).max()))
        self.undocumented |= set(rollout.undocumented)
        for name in sorted(rollout.values):
            if not name.startswith(("parameters/", "cameras/", "obs/")):
                self.units[name] = str(rollout.group[name].attrs.get("unit", ""))


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
    chosen = None if sample is None else _sample(root, manifest.shards, sample, seed)
    findings = _Findings(faults=check_hashes(root, manifest, None if chosen is None else set(chosen)))
    dataset = Dataset(manifest=manifest, model=_model(root, manifest, findings))
    shards = [shard for shard in manifest.shards if chosen is None or shard.file in chosen]
    for shard in progress(shards, "shards"):
        file = root / shard.file
        if not file.is_file():
            continue  # reported by check_hashes
        try:
            with open_shard(file) as handle, hdf5_faults(file):
                _check_shard(handle, shard, dataset, findings, None if chosen is None else chosen[shard.file])
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


def _sample(root: Path, shards: Sequence[ShardEntry], count: int, seed: int) -> dict[str, list[int]]:
    """Draw `count` rollouts, or all if there are fewer; return their indices within their shards, by file."""
    if count < 1:
        raise UsageError(
            f"--sample {count}: not a valid number of rollouts.",
            "1 or more.",
            "pass a number in this range, or leave --sample out.",
        )
    places = [(shard.file, place) for shard in shards for place in range(_most_rollouts(root, shard))]
    order = np.random.default_rng(seed).permutation(len(places))[:count]
    chosen: dict[str, list[int]] = {}
    for number in order:
        file, place = places[number]
        chosen.setdefault(file, []).append(place)
    return chosen


def _most_rollouts(root: Path, shard: ShardEntry) -> int:
    """Return the number of rollouts of a shard, or what its file has room for if its entry names an absurd number."""
    file = root / shard.file
    return min(shard.rollouts, file.stat().st_size // _LEAST_BYTES) if file.is_file() else 0


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
        **({"arrays_not_documented": sorted(findings.undocumented)} if findings.undocumented else {}),
    }


def _rejected(manifest: DatasetManifest) -> dict[str, int]:
    total: dict[str, int] = {}
    for shard in manifest.shards:
        for rule, count in shard.rejected.items():
            total[rule] = total.get(rule, 0) + count
    return total


def _check_shard(
    file: Node, shard: ShardEntry, dataset: Dataset, findings: _Findings, places: list[int] | None
) -> None:
    fault = listing_fault(file)
    if fault is not None:
        findings.faults.append(f"{shard.file}: {fault}")
        return
    names, manifest = demo_names(file), dataset.manifest
    if len(names) != shard.rollouts:
        findings.faults.append(f"{shard.file}: {len(names)} rollouts; dataset.json says {shard.rollouts}.")
    wanted = shard_range(manifest.rollouts, manifest.shard_count, shard.index)
    strange = [name for name in names if int(name.removeprefix("demo_")) not in wanted]
    if strange:
        findings.faults.append(f"{shard.file}: holds {strange[0]}; its number stands for {span(wanted)}.")
    if file.attrs.get("config_json") != settings_text(manifest):
        findings.faults.append(f"{shard.file}: its attribute config_json differs from the settings in dataset.json.")
    findings.faults += [f"{shard.file}: {text}" for text in check_file(file)]
    chosen = names if places is None else [names[place] for place in sorted(places) if place < len(names)]
    for name in progress(chosen, shard.file, len(chosen), "rollout"):
        try:
            demo = stored_demo(file, name)
        except InputDataError as error:
            findings.add(shard.file, name, Fault(check="schema", text=error.found))
            continue
        for fault in _readable_faults(_check_demo(demo, name, dataset, findings)):
            findings.add(shard.file, name, fault)


def _readable_faults(faults: Iterator[Fault]) -> Iterator[Fault]:
    """Yield faults, and as the last one what cannot be read or computed while they are looked for."""
    try:
        yield from faults
    except OSError as error:
        text = f"a block cannot be read: {str(error).splitlines()[0]}."
        yield Fault(check="readable", text=text)
    except InputDataError as error:  # of the model's effects with the values of this rollout
        yield Fault(check="effects", text=error.found)


def _check_demo(demo: Node, name: str, dataset: Dataset, findings: _Findings) -> Iterator[Fault]:
    findings.rollouts += 1
    rollout, faults = check_structure(demo, name, dataset)
    yield from faults
    if rollout is None:
        return
    findings.record(rollout)
    if any(fault.check == "time" for fault in faults):
        return
    yield from _check_parameters(rollout)
    yield from check_joints(rollout)
    if has_usable_contacts(rollout):
        yield from check_contacts(rollout)
        yield from check_motion(rollout, findings.motion)
    crooked = {fault.camera for fault in faults if fault.check == "cameras"}
    if dataset.model is not None:
        cameras = [camera for camera in rollout.cameras if camera not in crooked]
        yield from check_pictures(rollout, dataset.model, cameras, findings.pictures)


def _check_parameters(rollout: Rollout) -> Iterator[Fault]:
    """Check that physical parameters lie within the bounds of the model."""
    model, values = rollout.dataset.model, rollout.attributes.parameters
    for listed in model.file.parameters if model is not None else ():
        if listed.bounds is None or listed.name not in values:
            continue
        value, (low, high) = float(rollout.values[f"parameters/{listed.name}"]), listed.bounds
        if not low <= value <= high:
            text = f"parameters/{listed.name}: {value:g} {listed.unit}; {low:g} to {high:g} is allowed."
            yield Fault(check="parameters", text=text, value=value, limit=low if value < low else high)

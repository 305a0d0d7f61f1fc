"""Refusal of datasets whose labels cannot be right: what is exported passes the checks of `cgwm validate` first.

The structure of every exported rollout is checked, and its poses are compared with its first and last exported
pictures; `cgwm validate` compares all of them, and checks the physics and the hashes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from ...datasets.exports.selection import Selection
from ...datasets.models.model import Model
from ...datasets.rollouts.dataset import read_manifest
from ...datasets.rollouts.loader import shard_files
from ...datasets.rollouts.rollouts import open_shard
from ...schemas import InputDataError
from ...schemas.printable import typed_path
from ..validate.faults import Fault
from ..validate.reprojection import PictureFindings, check_pictures
from ..validate.rollout import Dataset
from ..validate.structure import check_file, check_structure, listing_fault


def require_sound_files(path: Path) -> None:
    """Check the shards, or the index, of a dataset apart from their rollouts.

    Raises:
        InputDataError: For the first fault, as `cgwm validate` reports it.
    """
    read_manifest(path)
    for file in shard_files(path):
        with open_shard(file) as handle:
            fault = listing_fault(handle) or next(iter(check_file(handle)), None)
        if fault is not None:
            raise _refusal(path, f"{file.name}: {fault}")


def require_sound(chosen: Selection, model: Model | None, numbers: Iterable[int] | None = None) -> None:
    """Check rollouts before they are exported.

    Args:
        chosen: The dataset, its rollouts, cameras and frames.
        model: The dataset's model, whose bodies are looked for in the pictures; None: they are not.
        numbers: Indices of the rollouts in the selection; None: all.

    Raises:
        InputDataError: For the first fault, as `cgwm validate` reports it.
    """
    dataset = Dataset(manifest=chosen.manifest, model=model)
    for number in range(len(chosen)) if numbers is None else numbers:
        info = chosen.reader.rollouts[number]
        fault = next(_faults(chosen, dataset, number), None)
        if fault is not None:
            raise _refusal(chosen.path, fault.at(info.file.name, info.demo).text)


def _faults(chosen: Selection, dataset: Dataset, number: int) -> Iterator[Fault]:
    rollout, faults = check_structure(
        chosen.reader.group(number), chosen.reader.rollouts[number].demo, dataset, whole=False
    )
    yield from faults
    if rollout is not None and dataset.model is not None:
        frames = chosen.frames(number)
        ends = {frames[0], frames[-1]}
        yield from check_pictures(rollout, dataset.model, chosen.cameras, PictureFindings(), ends)


def _refusal(path: Path, fault: str) -> InputDataError:
    return InputDataError(
        f"{path}: {fault}",
        "a dataset without faults.",
        f"'cgwm validate {typed_path(path)}' lists them all; synthesize it again.",
    )

"""What a rollout of a dataset says of itself in its attributes, read once, against what its dataset says of it."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from ...datasets.capture.cameras import Camera
from ...datasets.models.effect_files import packed_name
from ...datasets.models.model import Model
from ...datasets.rollouts.array_table import names_in
from ...datasets.rollouts.rollouts import Node
from ...schemas import DatasetManifest
from .faults import Fault
from .mjcf_text import mjcf_fault


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """What the rollouts of a dataset have in common."""

    manifest: DatasetManifest
    """`dataset.json`."""
    model: Model | None
    """The dataset's model, or None if it cannot be read."""

    @property
    def frames(self) -> int | None:
        """Number of frames of each rollout by the settings; None if they do not say."""
        duration_s, rate_hz = self._number("duration_s"), self.rate_hz
        return None if duration_s is None or rate_hz is None else round(duration_s * rate_hz) + 1

    @property
    def rate_hz(self) -> float | None:
        """Frames per second by the settings; None if they do not say."""
        return self._number("frame_rate_hz")

    def _number(self, name: str) -> float | None:
        value = self.manifest.config.get(name)
        known = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf
        return value if known else None


@dataclass(frozen=True, kw_only=True)
class Attributes:
    """The attributes of a rollout."""

    frames: int
    """Number of frames."""
    parameters: dict[str, tuple[float, str]]
    """Value and unit of the physical parameters, of `params_json`."""
    effects: dict[str, dict[str, float]]
    """Parameters of the active effects, by effect, of `effects_json`."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """A rollout of a dataset whose arrays have the documented shapes and types."""

    group: Node
    """Its group."""
    dataset: Dataset
    """The dataset that contains it."""
    attributes: Attributes
    """Its attributes."""
    bodies: tuple[str, ...]
    """Names of the bodies."""
    cameras: tuple[str, ...]
    """Names of the cameras, sorted."""
    values: dict[str, np.ndarray]
    """All of its arrays except images, by name."""
    undocumented: tuple[str, ...]
    """Names of arrays that are not documented."""

    def camera(self, name: str) -> Camera:
        """Return a camera."""
        read = {key: self.values[f"cameras/{name}/{key}"] for key in ("width", "height", "K", "dist", "T_world_cam")}
        return Camera(
            width=int(read["width"]),
            height=int(read["height"]),
            K=read["K"],
            distortion=read["dist"],
            T_world_cam=read["T_world_cam"],
        )

    def part(self, group: str) -> dict[str, np.ndarray]:
        """Return the documented arrays of a group, for example ``bodies``, by their name in it."""
        names = {name: f"{group}/{name}" for name in names_in(group)}
        return {name: self.values[path] for name, path in names.items() if path in self.values}


def shown(text: str) -> str:
    r"""Return a text of a file as a message may show it: short, and without characters that steer a terminal.

    >>> shown("a\x1b[2Jb")
    'a\\x1b[2Jb'
    """
    safe = "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)
    return safe if len(safe) <= 80 else f"{safe[:77]}..."


def name_fault(name: str) -> str | None:
    """Return what is wrong with the name of a body, camera, parameter or split, or None; exports make files of them."""
    if not name:
        return "is empty"
    if not name.isprintable():
        return "holds control characters"
    if name in (".", "..") or "/" in name or "\\" in name:
        return "is no name of a file"
    return "is longer than 200 characters" if len(name) > 200 else None


def read_attributes(group: Node, name: str, dataset: Dataset) -> tuple[Attributes | None, list[Fault]]:
    """Read the attributes of a rollout; return them, unless they cannot be used, and their faults.

    Args:
        group: Its group.
        name: Its name, ``demo_<i>``.
        dataset: The dataset that contains it.
    """
    faults: list[Fault] = []
    numbers = {key: _integer(group, key, faults) for key in ("num_samples", "episode_index", "seed", "attempt")}
    texts = {key: _text(group, key, faults) for key in ("model_file", "params_json", "effects_json")}
    fault = None if texts["model_file"] is None else mjcf_fault(texts["model_file"])
    if fault is not None:
        faults.append(_fault(f"the attribute model_file {shown(fault)}."))
    parameters, effects = (_object(key, texts[key], faults) for key in ("params_json", "effects_json"))
    faults += _number_faults(numbers, name, dataset)
    values = None if parameters is None else _parameters(parameters, faults)
    loads = None if effects is None else _effects(effects, dataset, faults)
    frames = numbers["num_samples"]
    if frames is None or values is None or loads is None or (dataset.frames or frames) != frames or frames < 1:
        return None, faults
    return Attributes(frames=frames, parameters=values, effects=loads), faults


def _fault(text: str) -> Fault:
    return Fault(check="schema", text=text)


def _integer(group: Node, key: str, faults: list[Fault]) -> int | None:
    value = integer_attribute(group, key)
    if value is None:
        there = key in group.attrs
        faults.append(_fault(f"the attribute {key} is {'no whole number' if there else 'missing'}."))
    return value


def integer_attribute(node: Node, key: str) -> int | None:
    """Return an attribute, or None if it is missing or no whole number."""
    value = node.attrs.get(key)
    return int(value) if isinstance(value, int | np.integer) else None


def _text(group: Node, key: str, faults: list[Fault]) -> str | None:
    value = group.attrs.get(key)
    if not isinstance(value, str):
        faults.append(_fault(f"the attribute {key} is {'missing' if value is None else 'no text'}."))
        return None
    return value


def own_member(parent: Node, name: str, kind: type) -> Any:
    """Return a member that a group contains itself, not by a link, if it is of a kind (Group, Dataset), else None."""
    if not isinstance(parent.get(name, getlink=True), h5py.HardLink):
        return None
    return parent[name] if parent.get(name, getclass=True) is kind else None


def parsed_object(text: str) -> dict[str, Any] | None:
    """Return the JSON object of a text, or None if it is none, nested too deeply, or names a key twice."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise ValueError("a key twice")
        return dict(pairs)

    try:
        found = json.loads(text, object_pairs_hook=unique)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _object(key: str, text: str | None, faults: list[Fault]) -> dict[str, Any] | None:
    found = None if text is None else parsed_object(text)
    if found is None and text is not None:
        faults.append(_fault(f"the attribute {key} is no JSON object; the rollout is not checked."))
    return found


def _number_faults(numbers: dict[str, int | None], name: str, dataset: Dataset) -> Iterator[Fault]:
    """Compare the attributes that are numbers with the name of the rollout and with the manifest."""
    frames, index, seed = (numbers[key] for key in ("num_samples", "episode_index", "seed"))
    if frames is not None and frames != (dataset.frames or max(frames, 1)):
        yield _fault(f"num_samples is {frames}; the settings in dataset.json give {dataset.frames or '1 or more'}.")
    if index is not None and name != f"demo_{index}":
        yield _fault(f"episode_index is {index}, in a group of another number.")
    rollouts, root = dataset.manifest.rollouts, dataset.manifest.config.get("seed")
    if index is not None and not 0 <= index < rollouts:
        yield _fault(f"episode_index is {index}; dataset.json has rollouts 0 to {rollouts - 1}.")
    if seed is not None and seed != (seed if root is None else root):
        yield _fault(f"its seed is {seed}; that of dataset.json is {root}.")
    if (numbers["attempt"] or 0) < 0:
        yield _fault(f"attempt is {numbers['attempt']}; 0 or more is allowed.")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _parameters(found: dict[str, Any], faults: list[Fault]) -> dict[str, tuple[float, str]] | None:
    for name, entry in found.items():
        whole = isinstance(entry, dict) and _is_number(entry.get("value")) and isinstance(entry.get("unit"), str)
        if not whole:
            text = f"params_json: '{shown(name)}' is no finite value with a unit; the rollout is not checked."
            faults.append(_fault(text))
            return None
    return {name: (float(entry["value"]), entry["unit"]) for name, entry in found.items()}


def _effects(found: dict[str, Any], dataset: Dataset, faults: list[Fault]) -> dict[str, dict[str, float]] | None:
    """Return the effects; those of a readable model have to be among its effects, with the same parameters."""
    for name, values in found.items():
        if not isinstance(values, dict) or not all(map(_is_number, values.values())):
            text = f"effects_json: '{shown(name)}' has no finite parameters; the rollout is not checked."
            faults.append(_fault(text))
            return None
    if dataset.model is None:
        return found
    known = {packed_name(effect.name): effect for effect in dataset.model.file.effects}
    foreign = sorted(set(found) - set(known))
    if foreign:
        names = ", ".join(map(shown, foreign))
        text = f"its effects {names} are not among those of the dataset's model; the rollout is not checked."
        faults.append(Fault(check="effects", text=text))
        return None
    for name, values in found.items():
        if set(values) != set(known[name].parameters):
            text = f"effects_json: '{shown(name)}' has the parameters {shown(', '.join(values))}; "
            text += f"those of the dataset's model are {', '.join(known[name].parameters)}."
            faults.append(Fault(check="effects", text=text))
            return None
    return found

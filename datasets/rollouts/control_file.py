"""`run.h5`: states, commands, plans and times of the runs of a task of control, in robomimic's structure.

Each run is a group `data/demo_<seed>`. Its `obs`, `next_obs`, `actions`, `rewards`, `dones` and `states` have one row
for each command, as robomimic reads them; `control` has the commands in metres and their outcome, `plans` one row for
each plan. Every array has the attributes `unit` and `description`. Equal runs give equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from ...schemas import InputDataError
from ...schemas.documents import parse_json
from ..io.hdf5_files import hdf5_faults, open_hdf5, own_objects, require_stored
from .guarded_file import written_hdf5
from .rollouts import Node

RUNS_FORMAT = "cgwm-runs/1"
CONVENTION = (
    "SI units. World right-handed, z up. Quaternions Hamilton, w x y z, body to world. Linear velocities are those of "
    "the body frame's origin in world axes; angular velocities are in body axes."
)
_POSE = "position x y z [m], quaternion w x y z"


@dataclass(frozen=True, kw_only=True)
class RunArray:
    """An array of a run."""

    tail: tuple[int | str, ...]
    """Its shape after the rows; N is the number of pieces of a plan, J that of the joints."""
    unit: str
    """Its unit."""
    text: str
    """Description."""


def _array(tail: tuple[int | str, ...], unit: str, text: str) -> RunArray:
    return RunArray(tail=tail, unit=unit, text=text)


_OBSERVED = {
    "object": _array((7,), "m, 1", f"Object at the command: {_POSE}."),
    "finger": _array((2,), "m", "Finger at the command: x y."),
}
COMMANDS: Mapping[str, RunArray] = {
    "actions": _array((2,), "1", "Change of the targets by the largest one of a command, x y, -1 to 1."),
    "rewards": _array((), "1", "Minus the position error over that of success, minus the same of the turn, after it."),
    "dones": _array((), "1", "1 at the last command."),
    "states": _array((16,), "SI", "time, object (pose, velocity, omega_body), finger x y."),
    **{f"obs/{name}": entry for name, entry in _OBSERVED.items()},
    **{f"next_obs/{name}": entry for name, entry in _OBSERVED.items()},
    "control/time": _array((), "s", "Time of the command."),
    "control/target": _array((2,), "m", "Targets of the joints at the end of the command, x y."),
    "control/position_error": _array((), "m", "Distance of the object from the goal at the end of the command."),
    "control/turn_error": _array((), "deg", "Turn of the object from the goal at the end of the command."),
    "control/force": _array((3,), "N", "Mean force of the finger on the object during the command, world frame."),
}
"""Arrays with one row for each command."""
_HAND_OBSERVED = {
    "object": _OBSERVED["object"],
    "joints": _array(("J",), "rad", "Joints at the command, in the order of the file."),
    "goal": _array((4,), "1", "Orientation that is wanted, quaternion w x y z."),
}
HAND_COMMANDS: Mapping[str, RunArray] = {
    "actions": _array(("J",), "1", "Change of the targets by the largest one of a command, by joint, -1 to 1."),
    "rewards": COMMANDS["rewards"],
    "dones": COMMANDS["dones"],
    "states": _array(("S",), "SI", "time, object (pose, velocity, omega_body), joints, their speeds."),
    **{f"obs/{name}": entry for name, entry in _HAND_OBSERVED.items()},
    **{f"next_obs/{name}": entry for name, entry in _HAND_OBSERVED.items()},
    "control/time": COMMANDS["control/time"],
    "control/target": _array(("J",), "rad", "Targets of the joints at the end of the command."),
    "control/position_error": COMMANDS["control/position_error"],
    "control/turn_error": COMMANDS["control/turn_error"],
    "control/grip": _array((), "N", "Sum of the sizes of the contact forces on the object, mean over the command."),
    "control/reached": _array((), "1", "1 where the goal was reached by this command."),
}
"""The same of a hand with J joints; S = 14 + 2 J."""
PLANS: Mapping[str, RunArray] = {
    "plans/state_time": _array((), "s", "Time of the state that the plan was made from."),
    "plans/acts_time": _array((), "s", "Time from which it was made to act."),
    "plans/wall": _array((), "s", "Wall time that it took; 0 with the ideal clock."),
    "plans/cpu": _array((), "s", "Time of all processors that it took; 0 with the ideal clock."),
    "plans/late": _array((), "1", "1 where it took longer than a command."),
    "plans/cost": _array((), "1", "Its cost."),
    "plans/times": _array(("N",), "s", "Ends of its pieces."),
    "plans/targets": _array(("N", "J"), "m, rad", "Targets of the joints there."),
    "plans/object": _array(("N", 7), "m, 1", f"Prediction of the object there: {_POSE}."),
}
"""Arrays with one row for each plan."""


@dataclass(frozen=True, kw_only=True)
class RunTables:
    """One run, by the names of `COMMANDS`, or `HAND_COMMANDS`, and `PLANS`."""

    seed: int
    """Seed of the run."""
    ended: str
    """Why it ended."""
    arrays: Mapping[str, np.ndarray]
    """The arrays."""
    robot: Literal["finger", "hand"] = "finger"
    """Robot, which says whether its arrays are those of `COMMANDS` or of `HAND_COMMANDS`."""
    joints: tuple[str, ...] = ("x", "y")
    """Names of the joints, in the order of the arrays."""


def write_runs(path: Path, runs: Sequence[RunTables], task_toml: str, creator: str) -> None:
    """Write runs; pass the temporary path of :func:`datasets.io.atomic.new_directory`."""
    with written_hdf5(path) as file:
        file.attrs.update({"format": RUNS_FORMAT, "creator": creator, "task_toml": task_toml, "convention": CONVENTION})
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "cgwm", "env_type": 2, "type": 2, "env_kwargs": {}})
        data.attrs.update({"robot": runs[0].robot, "joints": json.dumps(runs[0].joints)})
        data.attrs["total"] = sum(len(run.arrays["actions"]) for run in runs)
        for run in runs:
            demo = data.create_group(f"demo_{run.seed}")
            demo.attrs.update({"num_samples": len(run.arrays["actions"]), "seed": run.seed, "ended": run.ended})
            for name, entry in {**_commands_of(run.robot), **PLANS}.items():
                made = demo.create_dataset(name, data=run.arrays[name], track_times=False)
                made.attrs.update({"unit": entry.unit, "description": entry.text})
        good = [f"demo_{run.seed}".encode() for run in runs if run.ended == "success"]
        file.create_group("mask").create_dataset("success", data=np.array(good, dtype="S32"), track_times=False)


def read_runs(path: Path) -> list[RunTables]:
    """Read the runs of a file, by seed.

    Raises:
        InputDataError: If it is missing, damaged, or no such file; or an array is missing or has another shape.
    """
    with open_hdf5(path) as file, hdf5_faults(path):
        if file.attrs.get("format") != RUNS_FORMAT:
            raise InputDataError(
                f"{path}: its format attribute is not '{RUNS_FORMAT}'.",
                f"'{RUNS_FORMAT}'.",
                "name a file of runs that 'cgwm control' wrote.",
            )
        for place, item in own_objects(file, str(path)):
            if isinstance(item, h5py.Dataset):
                require_stored(item, f"{path}: {place}")
        root: Node = file
        robot = "hand" if str(root["data"].attrs.get("robot", "finger")) == "hand" else "finger"
        joints = _joints(path, str(root["data"].attrs.get("joints", '["x", "y"]')))
        names = sorted(root["data"], key=_number)
        return [_read(path, name, root[f"data/{name}"], robot, joints) for name in names]


def _joints(path: Path, text: str) -> tuple[str, ...]:
    """Return the names of the joints from the attribute `joints`."""
    names = parse_json(f'{{"joints": {text}}}', path).get("joints")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputDataError(
            f"{path}: its attribute 'joints' is {text[:60]}.", "a list of names.", "take the original."
        )
    return tuple(map(str, names))


def _commands_of(robot: str) -> Mapping[str, RunArray]:
    return HAND_COMMANDS if robot == "hand" else COMMANDS


def _number(name: str) -> int:
    return int(name.removeprefix("demo_")) if name.removeprefix("demo_").isdigit() else -1


def _read(path: Path, name: str, demo: Node, robot: Literal["finger", "hand"], names: tuple[str, ...]) -> RunTables:
    table_of_commands = _commands_of(robot)
    if _number(name) < 0:
        raise InputDataError(
            f"{path}: data/{name}: no run.",
            "groups demo_<seed> in data.",
            "name a file of runs that 'cgwm control' wrote.",
        )
    arrays = {key: _stored(f"{path}: data/{name}", demo, key) for key in (*table_of_commands, *PLANS)}
    sizes = {"N": arrays["plans/times"].shape[-1] if arrays["plans/times"].ndim > 1 else 0}
    sizes |= {"J": len(names), "S": 14 + 2 * len(names)}
    for table, rows in ((table_of_commands, len(arrays["actions"])), (PLANS, len(arrays["plans/cost"]))):
        for key, entry in table.items():
            wanted = (rows, *(sizes.get(size, size) if isinstance(size, str) else size for size in entry.tail))
            _require_shape(f"{path}: data/{name}/{key}", arrays[key].shape, wanted)
    ended = str(demo.attrs.get("ended", ""))
    return RunTables(seed=_number(name), ended=ended, arrays=arrays, robot=robot, joints=names)


def _stored(where: str, demo: Node, key: str) -> Any:
    if key not in demo or not isinstance(demo[key], h5py.Dataset):
        raise InputDataError(f"{where} lacks the array '{key}'.", todo="take the original file.")
    return demo[key][()]


def _require_shape(where: str, found: tuple[int, ...], wanted: tuple[Any, ...]) -> None:
    if found != wanted:
        raise InputDataError(f"{where} has the shape {found}.", f"{wanted}.", "take the original.")

"""Runs of a task as motions of the model's bodies: what the plant did, and what plans had predicted of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...datasets.io.outputs import reads
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.control_file import RunTables, read_runs
from ...datasets.rollouts.replay import Replay
from ...schemas import HAND_FORMAT, ControlResult, ControlTask, HandTask, InputDataError, parse, read_json
from ...schemas.documents import parse_json
from .film import AHEAD_S, predicted_at, visible_model
from .hand_replay import hand_replays
from .horizon import Array
from .task_world import TaskWorld, task_world

DOCUMENT = "control.json"


@reads("model", "run")
def replays_of(model: Path, run: Path) -> tuple[Model, dict[str, Replay]]:
    """Return the model of runs with the finger or the hand in it, and the motions of each run, by name.

    Args:
        model: The model that the runs are of.
        run: What `cgwm control` has written.

    Raises:
        InputDataError: If one of them cannot be read, the model has no such object, or the file of a hand is not the
            one that the runs were made with.
    """
    document = Path(run) / DOCUMENT
    file = read_json(document, ControlResult)
    asked = parse_json(file.settings.get("task", ""), document)
    runs = [one for one in read_runs(Path(run) / file.recording) if len(one.arrays["control/time"])]
    where = f"{document}, settings.task"
    if str(asked.get("format", "")) == HAND_FORMAT:
        shown, motions = hand_replays(read_model(model), parse(asked, HandTask, where), file, runs)
    else:
        shown, motions = _push_replays(task_world(read_model(model), parse(asked, ControlTask, where)), runs)
    if not motions:
        raise InputDataError(
            f"{run}: no run has a command.",
            "runs with commands.",
            todo="run 'cgwm control' again until at least one plan is executed.",
        )
    return shown, motions


def _push_replays(found: TaskWorld, runs: list[RunTables]) -> tuple[Model, dict[str, Replay]]:
    """Return the model with the finger in it, and the motions of pushes."""
    motions = {}
    for one in runs:
        motions[f"seed {one.seed}"] = _plant(found, one)
        motions[f"seed {one.seed}, predicted {AHEAD_S:g} s before"] = _predicted(found, one)
    seen = found.world.body_names[found.object] in found.model.body_splats
    return visible_model(found) if seen else found.model, motions


def _plant(found: TaskWorld, run: RunTables) -> Replay:
    """Return what the plant did; forces act at the surface of the finger."""
    arrays = run.arrays
    times, force = arrays["control/time"], arrays["control/force"]
    length = np.diff(times, append=2 * times[-1] - times[-2] if len(times) > 1 else times[-1])
    size = np.linalg.norm(force, axis=-1, keepdims=True)
    ahead = found.task.robot.radius_m * force / np.maximum(size, 1e-12)
    height = np.full((len(times), 1), found.finger_z)
    contact = np.concatenate((arrays["obs/finger"], height), -1) + ahead
    return _replay(found, times, arrays["obs/object"], arrays["obs/finger"], contact, force * length[:, None])


def _predicted(found: TaskWorld, run: RunTables) -> Replay:
    """Return what the plans of a while before had predicted."""
    times = run.arrays["control/time"]
    pairs = [predicted_at(run, float(now)) for now in times]
    actual = zip(run.arrays["obs/object"], run.arrays["obs/finger"], strict=True)
    shown = [pair or real for pair, real in zip(pairs, actual, strict=True)]
    poses, fingers = (np.array(column) for column in zip(*shown, strict=True))
    none = np.zeros((len(times), 3))
    return _replay(found, times, poses, fingers, none, none)


def _replay(
    found: TaskWorld, times_s: Array, pose: Array, finger_m: Array, contact_m: Array, impulse_n_s: Array
) -> Replay:
    states = [found.state(row[:3], row[3:], point) for row, point in zip(pose, finger_m, strict=True)]
    return Replay(
        times_s=times_s,
        position_m=np.stack([state.position_m[0].numpy() for state in states]),
        quat_wxyz=np.stack([state.quat_wxyz[0].numpy() for state in states]),
        contact_m=contact_m,
        impulse_n_s=impulse_n_s,
    )

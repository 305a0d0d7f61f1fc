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
from ..physics.world import State
from .film import AHEAD_S, predicted_at, visible_model
from .hand_replay import hand_replays
from .horizon import Array
from .replayed_states import replay_of
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
    states = _states(found, arrays["obs/object"], arrays["obs/finger"])
    return replay_of(times, states, contact, force * length[:, None])


def _predicted(found: TaskWorld, run: RunTables) -> Replay:
    """Return what the plans of a while before had predicted."""
    times = run.arrays["control/time"]
    pairs = [predicted_at(run, float(now)) for now in times]
    actual = zip(run.arrays["obs/object"], run.arrays["obs/finger"], strict=True)
    shown = [pair or real for pair, real in zip(pairs, actual, strict=True)]
    poses, fingers = (np.array(column) for column in zip(*shown, strict=True))
    return replay_of(times, _states(found, poses, fingers))


def _states(found: TaskWorld, pose: Array, finger_m: Array) -> list[State]:
    """Return the states with the object at poses (T, 7) and the finger at places (T, 2) [m]."""
    return [found.state(row[:3], row[3:], point) for row, point in zip(pose, finger_m, strict=True)]

"""Runs of a hand as motions of its links and the object."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ....datasets.io.atomic import sha256
from ....datasets.models.model import Model
from ....datasets.rollouts.control_file import RunTables
from ....datasets.rollouts.replay import Replay
from ....schemas import HandTask, InputDataError
from ..film import AHEAD_S, predicted_at
from ..horizon import Array
from ..replayed_states import replay_of
from .world import HandWorld, hand_world


def hand_of_runs(model: Model, task: HandTask, source: str, hashes: Mapping[str, str]) -> HandWorld:
    """Return the hand of runs.

    Args:
        model: The model that the runs are of.
        task: Their task.
        source: The path of its file.
        hashes: SHA-256 of the files that they were made of, by name.

    Raises:
        InputDataError: If the file of the hand is not where it was, or is not the same.
    """
    task._source = source
    _require_same(task, hashes)
    return hand_world(model, task)


def hand_replays(hand: HandWorld, run: RunTables) -> dict[str, Replay]:
    """Return the motions of a run, by name; see :func:`hand_film.dotted_model` for what they move."""
    ahead, actual = min(AHEAD_S, hand.task.planner.horizon_s), run.arrays["obs/object"]
    return {
        f"seed {run.seed}": _replay(hand, run, actual),
        f"seed {run.seed}, predicted {ahead:g} s before": _replay(hand, run, _predicted(run, actual, ahead)),
    }


def _require_same(task: HandTask, hashes: Mapping[str, str]) -> None:
    """Check that the file of the hand is that of the runs: links of another would be shown in wrong places."""
    path = task.folder / task.robot.file
    if not path.is_file():
        raise InputDataError(
            f"{path}: the hand of these runs is not there.",
            "the hand's file where it was, beside the task.",
            "call this from the directory in which 'cgwm control' ran, or put the file back.",
        )
    known = hashes.get(task.robot.file)
    if known is not None and sha256(path) != known:
        raise InputDataError(
            f"{path}: the hand is not that of these runs.",
            "the same file.",
            "put it back, or run 'cgwm control' again.",
        )


def _predicted(run: RunTables, actual: Array, ahead_s: float) -> Array:
    """Return the poses (T, 7) of the object that plans of a while before had predicted; the actual ones before."""
    found = [predicted_at(run, float(now), ahead_s) for now in run.arrays["control/time"]]
    return np.array([real if pair is None else pair[0] for pair, real in zip(found, actual, strict=True)])


def _replay(hand: HandWorld, run: RunTables, pose: Array) -> Replay:
    """Return the motion of the links of a run, with the object at poses (T, 7)."""
    states = [
        hand.state(row[:3], row[3:], dict(zip(hand.joints, joints.tolist(), strict=True)))
        for row, joints in zip(pose, run.arrays["obs/joints"], strict=True)
    ]
    return replay_of(run.arrays["control/time"], states)

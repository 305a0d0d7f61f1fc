"""Runs of a task as motions of the model's bodies: what the plant did, and what plans had predicted of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from ...datasets.io.outputs import reads
from ...datasets.models.model import Model, read_model
from ...datasets.rollouts.control_file import RunTables, read_runs
from ...datasets.rollouts.replay import Replay
from ...schemas import (
    HAND_FORMAT,
    CgwmError,
    ControlResult,
    ControlTask,
    HandTask,
    InputDataError,
    parse,
    read_json,
)
from ...schemas.documents import parse_json
from ..physics.state import State
from ..runtime.checkpoint import Checkpoint
from .film import AHEAD_S, predicted_at, visible_model
from .hand.film import dotted_model
from .hand.replay import hand_of_runs, hand_replays
from .horizon import Array
from .noted_runs import NOW, seed_slot, tables_kept, version
from .replayed_states import replay_of
from .task_world import TaskWorld, task_world

DOCUMENT = "control.json"
Shown = Callable[[RunTables], dict[str, Replay]]
"""Returns the motions of a run, by name."""


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
    runs = [one for one in read_runs(Path(run) / file.recording) if len(one.arrays["control/time"])]
    asked = file.settings.get("task", ""), f"{document}, settings.task"
    shown, motions_of = _shown(read_model(model), *asked, file.task, file.input_sha256)
    motions = {name: motion for one in runs for name, motion in motions_of(one).items()}
    if not motions:
        raise InputDataError(
            f"{run}: no run has a command.",
            "runs with commands.",
            todo="run 'cgwm control' again until at least one plan is executed.",
        )
    return shown, motions


@reads("model", "run")
def replays_or_following(
    model: Path, run: Path
) -> tuple[Model, dict[str, Replay], Callable[[], dict[str, Replay]] | None]:
    """Return what `replays_of` does, of runs that go on what there is of them; and what returns more, or None.

    Raises:
        InputDataError: As `replays_of` does.
    """
    if (run / DOCUMENT).is_file() or not Checkpoint.of(run, {}).path.is_dir():
        return *replays_of(model, run), None
    going_on = Following(model, run)
    return going_on.model, going_on.motions(), going_on.motions


class Following:
    """The motions of runs that go on: those that ended, and the last seconds of the present one.

    Args:
        model: The model that the runs are of.
        run: What `cgwm control` is about to write; what it has noted beside it is read.

    Attributes:
        over: Whether the output is complete, so that nothing more will come.

    Raises:
        InputDataError: As `replays_of` does, or if nothing is noted yet.
    """

    def __init__(self, model: Path, run: Path) -> None:
        self.over = False
        self._model, self._run = model, run
        self._checkpoint = Checkpoint.of(run, {})
        self._ended: set[int] = set()
        self._seen: int | None = None
        kept = self._checkpoint.slot(NOW).read(torch.device("cpu"))
        if kept is None:
            raise InputDataError(
                f"{run}: no run in it, and none that goes on.",
                "the output of 'cgwm control'.",
                todo="name one; of a command that has just begun, wait until its first plans have acted.",
            )
        made_of, where = self._checkpoint.stored(), f"{self._checkpoint.path}, task"
        hashes = {name: value for name, value in made_of.items() if isinstance(value, str)}
        self.model, self._motions_of = _shown(
            read_model(model), str(made_of.get("task", "")), where, str(kept["source"]), hashes
        )

    def motions(self) -> dict[str, Replay]:
        """Return the motions that are new or longer than at the last call, by name, those of the present run first."""
        if self.over:
            return {}
        found: dict[str, Replay] = {}
        if (self._run / DOCUMENT).is_file():
            self.over = True
            found = replays_of(self._model, self._run)[1]
            present = list(found)[-2:]
            return {name: found[name] for name in present} | found
        while version(self._checkpoint.slot(seed_slot(len(self._ended)))) is not None:
            found |= self._of(seed_slot(len(self._ended)))
            self._ended.add(len(self._ended))
        written = version(self._checkpoint.slot(NOW))
        if written is not None and written != self._seen:
            self._seen = written
            found = self._of(NOW) | found
        return found

    def _of(self, slot: str) -> dict[str, Replay]:
        """Return the motions of a slot; none where it was removed meanwhile, or is of a run that ended."""
        try:
            kept = self._checkpoint.slot(slot).read(torch.device("cpu"))
        except CgwmError:
            return {}
        if kept is None or not len(kept["arrays"]["control/time"]) or kept["seed"] in self._ended:
            return {}
        return self._motions_of(tables_kept(kept))


def _shown(model: Model, task: str, where: str, source: str, hashes: Mapping[str, str]) -> tuple[Model, Shown]:
    """Return the model with the finger or the hand in it, and what makes the motions of a run.

    Args:
        model: The model.
        task: The task, in JSON.
        where: Where that is, for messages.
        source: The path of the task's file.
        hashes: SHA-256 of the files that runs were made of, by name.
    """
    asked = parse_json(task, where)
    if str(asked.get("format", "")) == HAND_FORMAT:
        hand = hand_of_runs(model, parse(asked, HandTask, where), source, hashes)
        return dotted_model(hand), lambda run: hand_replays(hand, run)
    found = task_world(model, parse(asked, ControlTask, where))
    seen = found.world.body_names[found.object] in found.model.body_splats
    return visible_model(found) if seen else found.model, lambda run: _push_replays(found, run)


def _push_replays(found: TaskWorld, run: RunTables) -> dict[str, Replay]:
    """Return the motions of a push."""
    return {
        f"seed {run.seed}": _plant(found, run),
        f"seed {run.seed}, predicted {AHEAD_S:g} s before": _predicted(found, run),
    }


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

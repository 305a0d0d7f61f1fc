"""Runs as motions of the model's bodies, for the viewer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.datasets.models.model import write_model
from cgwm.datasets.rollouts.control_file import read_runs
from cgwm.pipeline.control import Following, control, noted_runs, replays_of, replays_or_following, stage
from cgwm.pipeline.control.loop import Recording
from cgwm.pipeline.view.motions import replayed
from cgwm.pipeline.view.stage import open_view
from cgwm.schemas import InputDataError, task_toml
from helpers import fused_host
from helpers.paddles import hand_task, write_hand
from helpers.pushing import RADIUS, push_task, pushed_model

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("replay")
    write_model(found / "model", pushed_model(visible=False))
    task = push_task(goal={"position_m": [0.1, 0.0]}, success={"timeout_s": 0.8})
    (found / "T.toml").write_text(task_toml(task))
    control(found / "model", found / "T.toml", found / "run", clock="ideal")
    return found


def test_a_replay_is_what_was_recorded_and_what_was_predicted(folder: Path) -> None:
    model, motions = replays_of(folder / "model", folder / "run")
    assert list(motions) == ["seed 0", "seed 0, predicted 0.5 s before"]
    assert [body.name for body in model.file.bodies] == ["cube", "tip"]
    arrays = read_runs(folder / "run" / "run.h5")[0].arrays
    real, ahead = motions.values()
    np.testing.assert_array_equal(real.position_m[:, 0], arrays["obs/object"][:, :3])
    np.testing.assert_array_equal(real.position_m[:, 1, :2], arrays["obs/finger"])
    np.testing.assert_array_equal(ahead.position_m[:10], real.position_m[:10])  # no plan is as old
    shift = np.linalg.norm(ahead.position_m[10:, 1] - real.position_m[10:, 1], axis=-1)
    assert 0 < shift.max() < 0.3
    assert real.contact_m is not None and real.impulse_n_s is not None
    pressed = np.linalg.norm(real.impulse_n_s, axis=-1) > 0
    away = np.linalg.norm((real.contact_m - real.position_m[:, 1])[pressed], axis=-1)
    np.testing.assert_allclose(away, RADIUS, rtol=1e-9)
    shown = replayed(real)
    assert [len(rows["mode"]) for rows in shown.contacts] == pressed.astype(int).tolist()
    assert shown.contacts_known and not replayed(ahead).contacts_known


def test_a_run_that_goes_on_is_followed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noted at each command, killed at the twelfth one of the second run, looked at, and brought to its end."""
    monkeypatch.setattr(noted_runs, "EVERY_S", 0.0)
    monkeypatch.setattr(noted_runs, "SHARE", math.inf)
    monkeypatch.setattr(noted_runs, "KEPT_S", 0.2)
    out, made, seen = tmp_path / "run", noted_runs.noting, []

    def noting(*given: Any) -> Any:
        note = made(*given)

        def noted(recording: Recording) -> None:
            note(recording)
            if recording.seed == 1 and len(recording.commands["time_s"]) in (3, 12):
                following = Following(folder / "model", out) if not seen else seen[0]
                seen.append(following)
                seen.append(following.motions())
                if len(seen) == 4:
                    raise KeyboardInterrupt

        return noted

    monkeypatch.setattr(stage, "noting", noting)
    given = (folder / "model", folder / "T.toml", out)
    with pytest.raises(KeyboardInterrupt):
        control(*given, clock="ideal", seeds=2)
    following, first, _, second = seen
    ahead = "predicted 0.5 s before"
    assert list(first) == ["seed 1", f"seed 1, {ahead}", "seed 0", f"seed 0, {ahead}"]
    assert list(second) == ["seed 1", f"seed 1, {ahead}"] and not following.over
    whole = replays_of(folder / "model", folder / "run")[1]["seed 0"]
    np.testing.assert_array_equal(first["seed 0"].position_m, whole.position_m)
    assert len(first["seed 1"].times_s) == 3 and len(second["seed 1"].times_s) == 4  # those of the last 0.2 s
    assert following.motions() == {}
    again = replays_or_following(folder / "model", out)
    assert list(again[1]) == list(first) and again[2] is not None
    monkeypatch.setattr(stage, "noting", made)
    control(*given, clock="ideal", seeds=2, resume=True)
    last = following.motions()
    assert list(last) == list(first) and following.over and following.motions() == {}
    np.testing.assert_array_equal(last["seed 1"].position_m[8:12], second["seed 1"].position_m)
    assert replays_or_following(folder / "model", out)[2] is None
    with pytest.raises(InputDataError, match="none that goes on"):
        Following(folder / "model", tmp_path / "nothing")


def test_a_run_alone_is_refused(folder: Path) -> None:
    with pytest.raises(InputDataError, match="cgwm view MODEL --run"):
        open_view(folder / "run")


def test_a_run_of_a_hand_shows_its_links_and_wants_the_same_hand(folder: Path, tmp_path: Path) -> None:
    hand = write_hand(tmp_path)
    task = hand_task(tmp_path, success={"timeout_s": 0.6})
    (tmp_path / "turn.toml").write_text(task_toml(task))
    control(folder / "model", tmp_path / "turn.toml", tmp_path / "run", clock="ideal")
    model, motions = replays_of(folder / "model", tmp_path / "run")
    assert list(motions) == ["seed 0", "seed 0, predicted 0.4 s before"]
    names = [body.name for body in model.file.bodies]
    assert names == ["palm", "arm", "tip", "cube"] and set(model.body_splats) == set(names)
    arrays = read_runs(tmp_path / "run" / "run.h5")[0].arrays
    real, ahead = motions.values()
    np.testing.assert_array_equal(real.position_m[:, 3], arrays["obs/object"][:, :3])
    swing = arrays["obs/joints"][:, 0]
    turned = np.stack((np.cos(swing / 2), 0 * swing, 0 * swing, np.sin(swing / 2)), -1)
    np.testing.assert_allclose(real.quat_wxyz[:, 1], turned, atol=1e-12)
    np.testing.assert_array_equal(ahead.position_m[:, :3], real.position_m[:, :3])  # plans show the object alone
    assert (ahead.quat_wxyz[:8, 3] == real.quat_wxyz[:8, 3]).all() and (ahead.position_m != real.position_m).any()
    assert not replayed(real).contacts_known  # forces of a hand are sums over all its contacts
    hand.write_text(hand.read_text() + "<!-- another -->")
    with pytest.raises(InputDataError, match="the hand is not that of these runs"):
        replays_of(folder / "model", tmp_path / "run")
    hand.unlink()
    with pytest.raises(InputDataError, match="is not there"):
        replays_of(folder / "model", tmp_path / "run")

"""What the controller of a hand holds to be true, from late and noisy states and from several draws of the model."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.models.model import Model
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.loop import hand_start
from cgwm.pipeline.control.hand.plant import HandModelPlant
from cgwm.pipeline.control.hand.tracker import _Trial
from cgwm.pipeline.control.horizon import Targets
from cgwm.pipeline.control.loop import Sensor
from cgwm.pipeline.control.planning import ControlState
from cgwm.schemas import FittedParameter
from helpers import fused_host
from helpers.paddles import hand_task, write_hand
from helpers.pushing import pushed_model

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]
NOISE = {"noise_m": 0.003, "noise_deg": 3.0}


@pytest.fixture(scope="module")
def unsure(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Model]:
    """A folder with a hand, and a model whose friction is known to a factor of two."""
    folder, model = tmp_path_factory.mktemp("hand"), pushed_model(visible=False)
    write_hand(folder)
    contact = model.file.contact
    assert contact is not None
    value = contact.friction
    friction = FittedParameter(
        name="friction", unit="1", estimate=value, std_error=0.7 * value, bounds=(0.1 * value, 10 * value)
    )
    return folder, replace(model, file=model.file.model_copy(update={"parameters": (friction,)}))


def errors_while_pushing(controller: HandController, **plant: Any) -> np.ndarray:
    """Return the errors (commands, 2) of place [m] and turn [rad] of the state that is held to be true."""
    found = HandModelPlant(replace(controller.hand, task=controller.task.model_copy(
        update={"plant": controller.task.plant.model_copy(update=plant)}
    )))  # fmt: skip
    truth, interval, errors = found.reset(*hand_start(controller.task, 0)), controller.interval_s, []
    sensor = Sensor(controller.task.plant.model_copy(update=plant), interval, 0)
    controller.restart(0)
    controller.note_sent(0.0, dict(zip(controller.joints, controller.hand.home, strict=True)))
    for number in range(24):
        state = sensor.seen(number * interval, truth)
        held = controller._tracker.update(state, controller._sent_since(state))
        quat = held.quat_wxyz[0, -1].numpy()
        turn = 2 * math.acos(min(1.0, abs(float(quat @ truth.quat_wxyz))))
        errors.append((np.linalg.norm(held.position_m[0, -1].numpy() - truth.position_m), turn))
        target = np.array([min(0.05 * (number + 1), 1.2), 0.0])
        controller.note_sent((number + 1) * interval, dict(zip(controller.joints, target, strict=True)))
        truth = found.advance(target, interval)
    assert np.linalg.norm(truth.position_m - np.array(controller.task.start.position_m)) > 0.01  # it was pushed
    return np.array(errors)


@pytest.mark.parametrize("noise", [NOISE, {"noise_m": 0.003}])
def test_noisy_poses_are_filtered_while_the_object_is_pushed(
    unsure: tuple[Path, Model], noise: dict[str, float]
) -> None:
    controller = HandController(unsure[1], hand_task(unsure[0], sensing=noise))
    errors = errors_while_pushing(controller, **noise)[6:]
    raw = math.sqrt(3) * np.array([0.003, math.radians(noise.get("noise_deg", 0.3))])
    assert (np.sqrt(np.square(errors).mean(0)) < 0.6 * raw).all()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_draw_that_predicts_the_motion_agrees_best(unsure: tuple[Path, Model], factor: float) -> None:
    controller = HandController(unsure[1], hand_task(unsure[0]), draws=5)
    estimate = float(controller.hand.world.contact.friction)
    assert float(controller._planned_in().batch(()).contact.friction) == estimate  # nothing was seen
    errors = errors_while_pushing(controller, friction_factor=factor)
    np.testing.assert_allclose(errors, 0.0, atol=1e-7)  # exact poses are believed
    draws = controller._tracker._worlds.batch(tuple(range(6))).contact.friction.flatten()
    nearest = int((draws / estimate / factor).log().abs().argmin())
    assert controller._tracker._behind.argmin() == nearest


@pytest.mark.parametrize(("better", "chosen"), [(0.0, 0), (0.6, 2)])
def test_a_draw_is_planned_with_that_predicted_better_by_more_than_chance(
    unsure: tuple[Path, Model], better: float, chosen: int
) -> None:
    """Errors of five draws by chance, of 30 pieces of time, of which those of the third are less."""
    controller = HandController(unsure[1], hand_task(unsure[0], sensing=NOISE), draws=5)
    tracker, rng, place = controller._tracker, np.random.default_rng(0), np.array([0.1, 0.0, 0.2])
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(30):
        error = 0.004 * rng.normal(size=(6, 3))
        error[2] *= 1 - better
        motion = torch.as_tensor(place + error), torch.as_tensor(np.tile(upright, (6, 1)))
        tracker._weigh(
            _Trial(0.0, motion), ControlState(time_s=0.2, joints={}, position_m=place, quat_wxyz=upright), 0.2
        )
    assert tracker.draw == chosen
    assert tracker._behind.argmin() != 0  # one seems better in any case


def test_late_states_are_predicted_by_what_was_sent(unsure: tuple[Path, Model]) -> None:
    controller = HandController(unsure[1], hand_task(unsure[0]))
    for time_s, target in ((0.0, 0.0), (0.1, 0.2), (0.2, 0.1)):
        controller.note_sent(time_s, {"swing": target, "lift": 0.0})
    later = Targets(times_s=np.array([0.2, 0.3]), values_m=np.array([[0.1, 0.0], [0.5, 0.0]]))
    given = controller._given(later, 0.05, 0.25)
    np.testing.assert_allclose(given.times_s, [0.05, 0.1, 0.2, 0.25])
    np.testing.assert_allclose(given.values_m[:, 0], [0.1, 0.2, 0.1, 0.3])


def test_a_plan_for_late_states_begins_where_what_was_sent_takes_them(unsure: tuple[Path, Model]) -> None:
    controller = HandController(unsure[1], hand_task(unsure[0]))
    plant, interval, names = HandModelPlant(controller.hand), controller.interval_s, controller.joints
    truths = [plant.reset(*hand_start(controller.task, 0))]
    controller.note_sent(0.0, dict(zip(names, controller.hand.home, strict=True)))
    for number in range(1, 11):
        target = np.array([min(0.05 * number, 1.2), 0.0])
        controller.note_sent(number * interval, dict(zip(names, target, strict=True)))
        truths.append(plant.advance(target, interval))
    old, now = truths[6], truths[10]
    state = old.measured(6 * interval, old.position_m, old.quat_wxyz)
    objective, _ = controller._objective(state, 10 * interval)
    assert objective.times_s[0] == objective.acts_s == pytest.approx(10 * interval)
    np.testing.assert_allclose(objective.state.position_m[0, -1].numpy(), now.position_m, atol=5e-4)
    assert np.linalg.norm(now.position_m - old.position_m) > 0.005  # it was pushed meanwhile

"""Tips of fingers, and what their distance from the object costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.models.model import Model
from cgwm.pipeline.control.hand.controller import HandController
from cgwm.pipeline.control.hand.world import hand_world
from cgwm.pipeline.control.planning import ControlState
from helpers import fused_host
from helpers.paddles import JOINTS, hand_task, write_hand
from helpers.pushing import pushed_model

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU"),
]
PLACE = np.array([0.0, 0.06, 1.5])
"""An object high above the hand, which nothing touches."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("tips")
    write_hand(found)
    return found


@pytest.fixture(scope="module")
def model() -> Model:
    return pushed_model(visible=False)


def cost(model: Model, folder: Path, reach_m: float, swing: float = 0.0) -> float:
    """Return the cost of targets that move the swing joint to a value and stay."""
    controller = HandController(model, hand_task(folder, costs={"reach_m": reach_m}))
    state = ControlState(
        time_s=0.0, joints=dict.fromkeys(JOINTS, 0.0), position_m=PLACE, quat_wxyz=np.array([1.0, 0, 0, 0])
    )
    objective, warm = controller._objective(state, 0.0)
    return float(objective.costs((warm + warm.new_tensor([swing / objective.hand.span[0], 0.0]))[None])[0])


def test_the_tip_is_the_corner_of_the_last_link_that_is_farthest_from_its_joint(folder: Path, model: Model) -> None:
    hand = hand_world(model, hand_task(folder))
    assert [hand.world.body_names[link] for link in hand.tips.links] == ["tip"]
    np.testing.assert_allclose(np.abs(hand.tips.points[0].numpy()), (0.035, 0.006, 0.01), atol=5e-4)
    bare = hand_world(model, hand_task(folder, robot={"apart": ("tip",)}))
    assert bare.tips.links == () and len(bare.tips.points) == 0


def test_what_nothing_touches_costs_the_distance_of_the_tips(folder: Path, model: Model) -> None:
    """Without it, all plans that do not touch the object cost the same, and there is none to prefer."""
    off = [cost(model, folder, 1e5, swing) for swing in (0.0, 0.5)]
    assert off[1] == pytest.approx(off[0], rel=1e-3)
    on = [cost(model, folder, 0.1, swing) for swing in (0.0, 0.5)]
    assert on[1] < on[0]  # the swing goes towards the object
    hand = hand_world(model, hand_task(folder))
    fall = 0.5 * 9.81 * np.linspace(0, 0.4, 200) ** 2
    tip = np.array([0.01, 0.0, 0.035]) + hand.tips.points[0].numpy()
    away = np.linalg.norm(PLACE - np.outer(fall, (0, 0, 1)) - tip, axis=1)
    assert on[0] - off[0] == pytest.approx((away**2).mean() / 0.1**2, rel=0.1)

"""A plant in a process of its own does what it does in this one."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cgwm.pipeline.control.hand.plant import HandScenePlant
from helpers.paddles import JOINTS, hand_task, write_hand

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
try:
    from plant_process import PipedPlant
finally:
    sys.path.remove(str(BENCHMARKS))


@pytest.mark.evidence
def test_a_plant_behind_a_pipe_has_the_states_of_one_in_this_process(tmp_path: Path) -> None:
    write_hand(tmp_path)
    hand: Any = SimpleNamespace(task=hand_task(tmp_path), joints=JOINTS, home=np.zeros(2))
    here, there = HandScenePlant(hand), PipedPlant(tmp_path)  # no other packages: the same MuJoCo
    start = np.array(hand.task.start.position_m), np.array([1.0, 0.0, 0.0, 0.0])

    def states_of(plant: Any) -> list[Any]:
        return [plant.reset(*start), *(plant.advance(np.array([0.5, 0.1]), 0.05) for _ in range(6))]

    states = [states_of(here)]
    for _ in range(2):  # another task in the same process
        there.open(hand)
        states.append(states_of(there))
    there.close()
    for one, other in [*zip(states[0], states[1], strict=True), *zip(states[0], states[2], strict=True)]:
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name))
    assert np.linalg.norm(states[0][-1].position_m - states[0][0].position_m) > 1e-3  # the paddle moved it

"""The benchmark of experiments in sequence: its cases, the hand that makes what is asked for, and its table."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import sequence
from hidden_effects import make_capture

STATE = {
    "position_m": [0.1, -0.2, 0.05],
    "quat_wxyz": [1.0, 0.0, 0.0, 0.0],
    "velocity_m_s": [2.0, 0.0, 0.0],
    "omega_body_rad_s": [0.0, 0.0, 6.0],
}


def test_seeds_of_reports_are_never_those_of_development() -> None:
    seeds = {stage: {one.case.seed for one in sequence.sequence_cases(stage)} for stage in sequence.STAGES}
    assert all(seed % 2 == (stage != "development") for stage, some in seeds.items() for seed in some)
    hidden = {(one.group, *one.case.effects) for one in sequence.sequence_cases("development", 1, 0)}
    # these set the friction of every step
    assert ("mujoco_hard", "stribeck_friction") in hidden and ("dart", "stribeck_friction") not in hidden


def test_a_hand_scatters_a_motion_and_keeps_the_body_on_the_ground() -> None:
    case = next(one.case for one in sequence.sequence_cases("development", 1, 0) if one.case.thing == "cube")
    middles, radius = case.drawn_thing().spheres
    state = {**STATE, "position_m": [0.1, -0.2, float(radius - middles[:, 2].min())]}
    made = [sequence.by_hand(case, state, np.random.default_rng(k)) for k in range(300)]
    speeds = np.array([np.linalg.norm(one.velocity_m_s) for one in made])
    headings = np.array([np.arctan2(one.velocity_m_s[1], one.velocity_m_s[0]) for one in made])
    assert speeds.std() == pytest.approx(0.2, rel=0.15)
    assert np.degrees(headings.std()) == pytest.approx(10.0, rel=0.15)
    lowest = [one.position_m[2] + middles[:, 2].min() - radius for one in made]
    assert np.allclose(lowest, sequence.LEAST_HEIGHT_M)
    dropped = [
        sequence.by_hand(
            case, {**state, "position_m": [0.0, 0.0, 0.55], "velocity_m_s": [0.0] * 3}, np.random.default_rng(k)
        )
        for k in range(20)
    ]
    assert np.std([one.position_m[2] for one in dropped]) > 0.02


def test_motions_are_added_to_the_training_split(tmp_path: Path) -> None:
    every = sequence.sequence_cases("development", 1, 0)
    case = replace(next(one.case for one in every if one.group == "mujoco_hard"), train=1, test=1, length_s=0.1)
    capture = tmp_path / "capture"
    make_capture(capture, case, tmp_path / "truth.json")
    before = Capture.open(capture).episodes("train")
    sequence.add_motions(capture, case, [{"what": "a drop", "initial_state": STATE, "duration_s": 0.1}], 1)
    opened = Capture.open(capture)
    assert opened.episodes("train") == [*before, "r1_0"]
    track = opened.tracks("r1_0")[case.thing]
    assert track.time_s[-1] == pytest.approx(0.1, abs=1.5 / case.rate_hz)


def test_the_table_counts_each_round() -> None:
    def row(effect: str | None, *judged: str) -> dict[str, object]:
        rounds = [{"verdict": "", "selected": [], "asked": [], "cpu_s": 1.0}]
        return {"case": "a", "effect": effect, "thing": "cube", "group": "drake", "judged": judged, "rounds": rounds}

    rows = [row("adhesion", "silent", "among", "exact"), row("adhesion", "wrong", "wrong", "wrong")]
    rows += [row(None, "right", "right", "false alarm")]
    lines = sequence.table(rows).splitlines()
    named = [line.split("|")[-3].strip() for line in lines if line.startswith("| all")]
    assert [one.split(" (")[0] for one in named] == ["0 of 2", "0 of 2", "1 of 2"]
    assert "| after round 2 | 1 | 1 of 1" in "\n".join(lines)

"""The scenes with fixed surfaces: what is refused at once, what the rollouts are judged by, and the whole in small."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.synthetic.worlds import plan_world
from cgwm.pipeline.demo.world_demo import _outside, _verdict, run_world
from cgwm.schemas import PhysConfig, RolloutCheck, UsageError, WorldDemoResult, read_json


def test_the_verdict_says_what_the_labels_show() -> None:
    good = {"rollouts": 64, "deepest_m": 0.0004, "at_rest": 1.0, "fastest_end_m_s": 0.001, "escaped": 0}
    assert _verdict(RolloutCheck(**good, labels_hold=True)) == (
        "64 rollouts: no penetration above 0.40 mm at any frame; at the end 100.0 % of the bodies are slower than "
        "5 mm/s, the fastest moves at 1.0 mm/s. Their labels hold."
    )
    bad = _verdict(RolloutCheck(**good | {"escaped": 2}, labels_hold=False))
    assert bad.endswith("1.0 mm/s; a body left the scene in 2. cgwm validate finds faults in their labels.")


def test_bodies_beyond_the_walls_or_below_the_floor_have_left() -> None:
    place = np.array([[0.0, 0.0, 0.05], [0.19, 0.0, 0.05]])
    in_bin, on_ramp = plan_world("bin"), plan_world("ramp")
    assert not _outside(in_bin, place)
    assert _outside(in_bin, place + np.array([0.1, 0.0, 0.0]))
    assert _outside(in_bin, place - np.array([0.0, 0.0, 0.1]))
    assert not _outside(on_ramp, place + np.array([0.5, 0.0, 0.0]))


def test_what_exists_and_wrong_seeds_are_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="exists"):
        run_world(tmp_path / "out", "bin", device="cpu")
    with pytest.raises(UsageError, match="the seed is -1"):
        run_world(tmp_path / "new", "ramp", seed=-1, device="cpu")


@pytest.mark.evidence
@pytest.mark.parametrize("scene", ["bin", "ramp"])
def test_the_whole_scene_in_small(tmp_path: Path, scene: str) -> None:
    physics = PhysConfig(population=8, generations=2, iterations=2, step_s=0.002)
    result = run_world(tmp_path / "out", scene, device="cpu", rollouts=2, physics=physics)
    assert {tmp_path / "out" / path for path in result.paths.values()} <= set((tmp_path / "out").iterdir())
    assert read_json(tmp_path / "out" / "report.json", WorldDemoResult) == result
    assert result.check.labels_hold
    assert result.check.escaped == 0
    assert result.verdict in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")

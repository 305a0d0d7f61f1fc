"""The viewer with jointed bodies: links on their joints, values of joints at each frame, axes in the scene."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.models.model import write_model
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.view import open_view
from cgwm.pipeline.view.motions import can_move, own_motion, recorded_motion, still
from cgwm.pipeline.view.scene_at import radius_m, scene_at, shapes_of
from cgwm.schemas import SynthesizeConfig
from helpers.jointed_model import jointed_model

LIMITS = (-0.5, 1.0)
needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser is not installed: pip install 'cgwm[view]'"
)


def test_links_are_on_their_joints_at_rest_and_in_motion() -> None:
    model = jointed_model(limits=LIMITS)
    rest = still(model)
    np.testing.assert_allclose(rest.joints["elbow"], [0.25])
    np.testing.assert_allclose(rest.position_m[0, 1], rest.position_m[0, 0] + [0.1, 0, 0])
    np.testing.assert_allclose(rest.quat_wxyz[0, 1], [np.cos(0.125), 0, np.sin(0.125), 0])
    assert can_move(model)
    assert not can_move(jointed_model("driven"))
    moved = own_motion(model, 0)
    values = moved.joints["elbow"]
    assert values.shape == moved.times_s.shape
    assert np.ptp(values) > 0.1
    assert LIMITS[0] - 0.1 < values.min() < values.max() < LIMITS[1] + 0.1
    assert scene_at(moved, 3, 0.1).joints == {"elbow": values[3]}
    assert radius_m(model, shapes_of(model)) == pytest.approx(0.04)


@needs_viser
def test_a_dataset_shows_its_joints(tmp_path: Path) -> None:
    write_model(tmp_path / "model", jointed_model(limits=LIMITS))
    config = SynthesizeConfig(rollouts=1, duration_s=0.2, device="cpu")
    synthesize(tmp_path / "model", tmp_path / "data", config)
    reader = RolloutReader(tmp_path / "data")
    recorded = recorded_motion(reader, 0)
    np.testing.assert_array_equal(recorded.joints["elbow"], reader.read(0, "joints/pos")[:, 0])
    with open_view(tmp_path / "data", port=0) as view:
        degrees = f"elbow {np.degrees(recorded.joints['elbow'][0]):.1f} deg"
        assert degrees in view._status.content
        (axis,) = view._joints
        assert axis.name == "/bodies/1/joint"
        np.testing.assert_allclose(axis.points[0, 1] / np.linalg.norm(axis.points[0, 1]), [0, 1, 0], atol=1e-6)
        view._jointed.value = False
        view._refresh()
        assert not axis.visible

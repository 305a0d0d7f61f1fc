"""The camera model: as rich as the residuals support, and intrinsics that are known stay as they are."""

import numpy as np
import pytest
from cgwm.pipeline.calibrate.camera_models import FIRST_TRIED, LADDER, LENS_PARAMETERS, richer, supported


def _lengths(noise: float, count: int = 4000, seed: int = 0, wrong: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lengths = noise * np.linalg.norm(rng.normal(size=(count, 2)), axis=1)
    lengths[: int(wrong * count)] = 40.0
    return lengths


@pytest.mark.parametrize(
    ("gain", "wrong", "taken"),
    [(1.0, 0.0, "SIMPLE_RADIAL"), (0.999, 0.0, "SIMPLE_RADIAL"), (0.95, 0.0, "OPENCV"), (0.95, 0.1, "OPENCV")],
)
def test_a_richer_model_is_taken_where_it_pays(gain: float, wrong: float, taken: str) -> None:
    steps = [(model, _lengths(0.5, wrong=wrong)) for model in ("SIMPLE_RADIAL", "RADIAL")]
    assert supported([*steps, ("OPENCV", _lengths(0.5 * gain, wrong=wrong))], cameras=1) == taken


def test_each_camera_of_its_own_has_to_pay_for_its_lens() -> None:
    steps = [("SIMPLE_PINHOLE", _lengths(0.5, 300)), ("SIMPLE_RADIAL", _lengths(0.46, 300))]
    assert supported(steps, cameras=1) == "SIMPLE_RADIAL"
    assert supported(steps, cameras=30) == "SIMPLE_PINHOLE"


def test_the_ladder_goes_from_simple_to_rich() -> None:
    assert [LENS_PARAMETERS[model] for model in LADDER] == sorted(LENS_PARAMETERS.values())
    assert set(FIRST_TRIED) <= set(LADDER)
    assert richer("SIMPLE_RADIAL", "OPENCV") == ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
    assert richer("OPENCV", "SIMPLE_PINHOLE") == ("OPENCV",)

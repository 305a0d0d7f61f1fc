"""The loop on real throws: drag and tilt are found, and what the fit never saw errs by less than half."""

import sys
from pathlib import Path

import pytest
from cgwm.datasets.capture import Capture
from cgwm.datasets.jugglebot import import_jugglebot
from cgwm.datasets.models import read_model
from cgwm.pipeline.eval import evaluate_model
from cgwm.pipeline.fit import fit
from cgwm.schemas import PhysConfig

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from store import shared_data


def residual_m(model: Path, capture: Path) -> float:
    found = evaluate_model(read_model(model), Capture.open(capture, splits=("test",))).result.state_fitted_residual_m
    assert found is not None
    return found.median


def test_drag_and_tilt_halve_what_is_left_of_throws_that_the_fit_never_saw(tmp_path: Path) -> None:
    data = shared_data()
    if data is None or not (data / "jugglebot").is_dir():
        pytest.skip("the throws of Jugglebot are not there: set CGWM_SHARED_DATA to the folder of measured data")
    capture, base, better = tmp_path / "capture", tmp_path / "m0", tmp_path / "m1"
    import_jugglebot(data / "jugglebot", capture, only="session7", n_train=3, n_test=2)
    fit(capture, base)
    effects = PhysConfig(effects=("quadratic_drag", "gravity_tilt"))
    model = fit(capture, better, "phys-geo", base, phys_config=effects)
    drag = next(p for p in model.parameters if p.name == "quadratic_drag.k")
    assert drag.interval_95 is not None and 0 < drag.interval_95[0] < drag.interval_95[1] < 0.06
    assert any("nothing touches anything" in warning for warning in model.warnings)
    assert residual_m(better, capture) < 0.5 * residual_m(base, capture)

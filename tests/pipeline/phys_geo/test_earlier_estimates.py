"""A fit that starts from a model keeps what its episodes do not observe, with the intervals that the model had."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.models.model import read_model, write_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.phys_geo.tracks import earlier_estimates
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, GROUND_SHIFT
from cgwm.schemas import ContactParameters, Correlation, EffectModel, FittedParameter, ModelFile, PhysConfig
from helpers.diagnosis_data import tosses, world_with, write_capture

VALUES = {"friction": 0.27, "contact_time_s": 0.006, "damping_ratio": 0.43, "ground_offset_m": 3e-4}
ROLLING, DRAG = "rolling_resistance.c_r", 0.3


def fitted(name: str, estimate: float, share: float = 0.05) -> FittedParameter:
    std = share * estimate
    return FittedParameter(
        name=name,
        unit="1",
        estimate=estimate,
        std_error=std,
        interval_95=(estimate - 2 * std, estimate + 2 * std),
    )


FOUND = tuple(fitted(name, value) for name, value in {**VALUES, ROLLING: 0.004}.items())


def test_flights_keep_the_contact_and_the_effects_that_a_model_had_found(tmp_path: Path) -> None:
    """Flights show a drag, and nothing of friction or rolling: those stay, with the model's own intervals."""
    world = world_with("ball", {"linear_drag": {"c": DRAG}})
    parent = write_capture(tmp_path / "flights", world, tosses(world, 5, 5, 0.35, height_m=(2.0, 2.5)))
    model = read_model(parent)
    contact = ContactParameters(**{name: VALUES[name] for name in ("friction", "contact_time_s", "damping_ratio")})
    effects = (EffectModel(name="rolling_resistance", parameters={"c_r": 0.004}),)
    file = model.file.model_copy(update={"contact": contact, "parameters": FOUND, "effects": effects})
    write_model(parent, replace(model, file=file), overwrite=True)

    config = PhysConfig(effects=("linear_drag",), population=12, generations=2)
    new = fit(tmp_path / "flights", tmp_path / "new", parent=parent, phys_config=config)
    numbers = {parameter.name: parameter for parameter in new.parameters}
    for before in FOUND:
        assert numbers[before.name].estimate == before.estimate
        assert numbers[before.name].interval_95 == before.interval_95
        assert numbers[before.name].state == "fitted"
    assert new.contact is not None and new.contact.friction == pytest.approx(contact.friction)
    assert new.ground is not None and new.ground.offset_m == VALUES["ground_offset_m"]
    assert {e.name: e.parameters for e in new.effects}["rolling_resistance"] == {"c_r": 0.004}
    low, high = numbers["linear_drag.c"].interval_95 or (0, 0)
    assert low < DRAG < high
    assert [text for text in new.warnings if "observable" in text] == []
    assert any("keep their earlier values" in text for text in new.warnings)


def test_what_the_episodes_observe_is_not_kept() -> None:
    """Kept and new estimates are independent; kept ones have the correlations that they had."""
    block = Correlation(parameters=("friction", "damping_ratio"), matrix=((1.0, -0.5), (-0.5, 1.0)))
    earlier = earlier_estimates.EarlierEstimates.of(FOUND, (block,))
    std = np.array([0.6, 0.1, 0.7, 1e-4])
    names = [*CONTACT_PARAMETERS, GROUND_SHIFT]
    estimate = ContactEstimate(parameters=names, values=np.zeros(4), covariance=np.outer(std, std))
    found = earlier.kept_in(world_with("ball"), estimate)
    assert list(found.kept) == ["friction", "damping_ratio"]
    assert np.allclose(found.values, [np.log(0.27), 0.0, np.log(0.43), 0.0])
    expected = np.array([[0.0025, 0, -0.00125, 0], [0, 0.01, 0, 1e-5], [-0.00125, 0, 0.0025, 0], [0, 1e-5, 0, 1e-8]])
    assert np.allclose(found.covariance, expected)
    assert (
        earlier_estimates.EarlierEstimates.of(
            [p.model_copy(update={"state": "on_bound"}) for p in FOUND], ()
        ).parameters
        == {}
    )


def test_new_shapes_keep_the_fitted_mass_distribution(tmp_path: Path) -> None:
    world = world_with("ball")
    plain: ModelFile = read_model(write_capture(tmp_path / "ball", world, tosses(world, 1, 3, 0.1))).file
    (body,) = plain.bodies
    weighted = body.model_copy(update={"com_m": (0.001, 0.0, 0.0)})
    given = plain.model_copy(update={"bodies": (weighted,), "contact": ContactParameters(friction=0.6)})
    assert earlier_estimates.with_fitted_physics(plain, given).bodies == (body,)
    parent = given.model_copy(update={"parameters": (fitted(f"{body.name}.com_x_m", 0.001),)})
    found = earlier_estimates.with_fitted_physics(plain, parent)
    assert found.bodies == (weighted,) and found.contact == parent.contact and found.parameters == parent.parameters

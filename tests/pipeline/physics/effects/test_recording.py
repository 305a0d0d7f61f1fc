"""Users' effects that differentiate in reverse: potentials whose forces `torch.autograd` finds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.pipeline.diagnose import diagnose, stage
from cgwm.pipeline.phys_geo.tracks.contact_fit import fit_physics
from cgwm.pipeline.physics import World
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.physics.effects.recording import no_recording
from cgwm.schemas import PhysConfig
from helpers.diagnosis_data import NOISE, tosses, world_with, write_capture

WELL = '''
import torch
from cgwm.pipeline.physics.effects import BodyMotion, Effect, EffectParameter, Values, Wrench


class Closed(Effect):
    """A force towards the origin, in closed form."""

    name = "closed"
    summary = "A pull to the origin."
    formula = "a = -w (x, y, z)"
    parameters = (EffectParameter("w", "1/s2", 0.5, 50.0),)
    phase = "flight"
    reveals = "flights"
    source = "Hooke"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        return Wrench(force=-(values["w"] * motion.mass)[:, None] * motion.com)


class Well(Closed):
    """The same force, as the derivative of its energy."""

    name = "well"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        place = motion.com.detach().requires_grad_()
        energy = 0.5 * values["w"] * motion.mass * place.square().sum(-1)
        return Wrench(force=-torch.autograd.grad(energy.sum(), place)[0])
'''


@pytest.fixture
def well(tmp_path: Path) -> Path:
    path = tmp_path / "well.py"
    path.write_text(WELL)
    return path


def with_effect(well: Path, name: str, w: float) -> World:
    effect = ActiveEffect.of(load_effect(f"{well}:{name}"), {"w": w})
    return replace(world_with("ball", ground=False), effects=(effect,), step_s=0.01)


def test_a_fit_finds_the_force_of_an_energy(well: Path) -> None:
    """With the estimate and the interval of the force in closed form: its forward derivatives are exact, too."""
    episodes = tosses(with_effect(well, "Closed", 4.0), 3, 2, 0.2, 50.0)
    found = [
        fit_physics(with_effect(well, name, 0.0), episodes, PhysConfig(mass_distribution=False), NOISE).parameters[-1]
        for name in ("Closed", "Well")
    ]
    assert [one.name for one in found] == ["closed.w", "well.w"]
    closed, energy = (np.array([one.estimate, *(one.interval_95 or ())]) for one in found)
    np.testing.assert_allclose(energy, closed, rtol=1e-9)
    assert closed[1] < 4.0 < closed[2]


# In the suite: the test above, and the one below for the effects that a diagnosis looks at.
@pytest.mark.evidence
def test_a_diagnosis_names_the_force_of_an_energy(well: Path, tmp_path: Path) -> None:
    episodes = tosses(with_effect(well, "Closed", 4.0), 5, 6, lift_m_s=(2.5, 3.5))
    model = write_capture(tmp_path / "capture", world_with("ball"), episodes, test=1)
    spec = f"{well}:Well"
    assert diagnose(model, tmp_path / "capture", candidates=[spec]).selected == (spec,)


@pytest.mark.parametrize("own", [False, True])
def test_a_diagnosis_asks_its_candidates_whether_torch_may_record(
    own: bool, well: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = write_capture(tmp_path / "capture", world_with("ball"), tosses(world_with("ball"), 5, 2, 0.1), test=1)
    modes = []

    def asked(*_: object) -> None:
        modes.append(torch.is_inference_mode_enabled())
        raise InterruptedError

    monkeypatch.setattr(stage, "prepared_world", asked)
    with pytest.raises(InterruptedError):
        stage.diagnose(model, tmp_path / "capture", candidates=[f"{well}:Well"] if own else [])
    assert modes == [not own]


def test_whole_fits_record_nothing_but_in_users_methods(well: Path) -> None:
    own, drag = load_effect(f"{well}:Well"), load_effect("linear_drag")
    with no_recording([drag]):
        assert torch.is_inference_mode_enabled()
    with no_recording([drag, own]):
        assert not torch.is_inference_mode_enabled() and not torch.is_grad_enabled()
    assert own.has("wrench") and not own.has("flow")
    assert type(own).__name__ == "Well" and type(own).__module__ == "cgwm_effect_well"

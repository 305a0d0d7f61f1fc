"""The contact law of the paper as a setting of the fit: what it gives, where it is recorded, what it refuses."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.mjcf import write_mjcf
from cgwm.datasets.models.model import read_model, write_model
from cgwm.pipeline.control.task_world import require_rigid
from cgwm.pipeline.diagnose import stage
from cgwm.pipeline.phys_geo.paper_setting import paper_config, unstable_sides, widest_side
from cgwm.pipeline.physics import ContactLaw, PaperLaw, world_of_model
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.paper_law import stable_step
from cgwm.pipeline.physics.parameters import apply_parameters, contact_parameters
from cgwm.schemas import Body, CaptureManifest, Ground, InputDataError, Material, PhysConfig, UsageError
from cgwm.schemas import World as Surroundings
from helpers.small_model import MASS, small_model
from helpers.worlds import batch, box_body, state_of, times, world_of
from pydantic import ValidationError

PAPER = PhysConfig(contact_law="paper")


def published():
    """Return the small model with the paper's law."""
    model = small_model()
    solver = model.file.solver.model_copy(update={"contact_model": "paper"})
    return replace(model, file=model.file.model_copy(update={"solver": solver}))


def capture(*materials: Material) -> Capture:
    """Return a capture of one body on a ground."""
    manifest = CaptureManifest(
        format="cgwm-capture/1",
        world=Surroundings(ground=Ground()),
        bodies=(Body(name="cube", mass_kg=1.0),),
        materials=materials,
    )
    return Capture(root=Path("C"), manifest=manifest, cameras=None)


def test_the_model_records_the_law_and_its_world_has_it(tmp_path: Path) -> None:
    write_model(tmp_path / "m", published())
    world, ours = world_of_model(read_model(tmp_path / "m")), world_of_model(small_model())
    assert isinstance(world.contact, PaperLaw) and isinstance(ours.contact, ContactLaw)
    assert float(world.contact.stiffness_n_m) == pytest.approx(MASS / (16 * 0.008**2))
    assert world.bodies[0].on_plane is None and ours.bodies[0].on_plane is not None  # every sphere counts


def test_its_numbers_are_fitted_by_the_names_of_ours() -> None:
    world = world_of_model(published())
    parameters = contact_parameters(world)
    assert [p.name for p in parameters] == ["friction", "contact_time_s", "damping_ratio"]
    assert [p.prior[0] for p in parameters[1:]] == [0.02, 1.0]
    law = apply_parameters(world, parameters, torch.tensor([[0.2, 0.01, 0.5]], dtype=torch.float64)).contact
    assert isinstance(law, PaperLaw)
    assert float(law.damping_n_s_m) == pytest.approx(2 * 0.5 * MASS / (16 * 0.01))


def test_parts_that_assume_our_law_are_left_out_or_refused() -> None:
    assert paper_config(small_model().file, capture(), PAPER).mass_distribution is False
    two = (Material(name="steel", friction=0.2), Material(name="wood", friction=0.4))
    for given, change, named in (
        (capture(), {"effects": ("linear_drag",)}, "the effect 'linear_drag'"),
        (capture(), {"length_scale": True}, "phys-geo.length_scale=true"),
        (capture(*two), {}, "laws of pairs of materials"),
    ):
        with pytest.raises(UsageError, match=f"phys-geo.contact_law=paper with {named}: the paper has one law"):
            paper_config(small_model().file, given, PAPER.model_copy(update=change))


def test_its_steps_are_short_enough_for_flat_sides_unless_others_are_asked_for() -> None:
    step_s = paper_config(small_model().file, capture(), PAPER).step_s
    one = torch.ones(1, dtype=torch.float64)
    law = PaperLaw.of_body(0.5 * one, 0.01 * one, 1.8 * one, MASS, 9.81 * MASS)
    assert 0.9 * step_s < float(stable_step(law, MASS * one, 80 * 4)) < 4 * step_s
    asked = PhysConfig(contact_law="paper", step_s=0.002)
    assert paper_config(small_model().file, capture(), asked).step_s == 0.002


def test_numbers_that_are_not_stable_on_a_wide_side_are_told() -> None:
    """A plate of 100 spheres below and 100 above, on which it stays within the bound, and is thrown up beyond it."""
    grid = torch.linspace(-0.05, 0.05, 10, dtype=torch.float64)
    centers = torch.cartesian_prod(grid, grid, torch.tensor([-0.01, 0.01], dtype=torch.float64))
    body = replace(box_body(mass=MASS), centers=centers[None], radii=torch.full((1, 200), 0.005, dtype=torch.float64))
    numbers = batch(0.5), batch(0.01), batch(1.8)
    world = world_of(body, contact=PaperLaw.of_body(*numbers, MASS, 9.81 * MASS), step_s=1e-4)
    (told,) = unstable_sides(replace(world, step_s=1e-3))
    assert widest_side(body) == 100 and "lies on 100 spheres" in told and unstable_sides(world) == ()
    start = state_of(((0, 0, 0.0149), (1, 0, 0, 0), (0, 0, -0.3), (0, 0, 0)))
    speeds = [
        float(rollout(replace(world, step_s=step_s), start, times(0.3)).velocity_m_s[..., 2].max())
        for step_s in (1e-4, 1e-3)
    ]
    assert speeds[0] < 0.1 and speeds[1] > 0.3


def test_an_unknown_law_is_refused_with_the_two_there_are() -> None:
    with pytest.raises(ValidationError, match="'closed_form' or 'paper'"):
        PhysConfig.model_validate({"contact_law": "published"})


def test_what_knows_our_law_alone_refuses_it() -> None:
    with pytest.raises(InputDataError, match="contact law 'paper', which MJCF does not take"):
        write_mjcf(published())
    with pytest.raises(InputDataError, match="contact law 'paper', which control does not take"):
        require_rigid(published())
    with pytest.raises(InputDataError, match="contact law 'paper', which diagnose does not take"):
        stage._world(published(), capture())

"""A driven body has a contact law of its own; how far the contact model may err by what contact does."""

import math

import pytest
import torch
from cgwm.pipeline.phys_geo.material_pairs import start_laws, with_pusher_law
from cgwm.pipeline.phys_geo.tracks.multiple_shooting import CARRIED_SHARE, MOVING_SHARE, expected_error
from cgwm.schemas import Body, CaptureManifest, Ground, Material, ModelFile, Provenance
from cgwm.schemas import World as Surroundings

FALLEN = torch.tensor([[0.0, 0.0, -0.327]], dtype=torch.float64)
NOT, TOUCHED = torch.tensor([False]), torch.tensor([True])


def manifest(*bodies: Body, materials: tuple[Material, ...] = ()) -> CaptureManifest:
    """Return a capture of bodies on a ground."""
    return CaptureManifest(
        format="cgwm-capture/1", world=Surroundings(ground=Ground()), bodies=bodies, materials=materials
    )


def laws(capture: CaptureManifest) -> list[tuple[str, str]]:
    """Return the pairs of materials that have a law of their own at the start of a fit."""
    return [
        pair.materials for pair in start_laws(ModelFile(bodies=(), provenance=Provenance(capture="")), capture).pairs
    ]


THING, FINGER = Body(name="thing", mass_kg=1.0), Body(name="finger", motion="driven")


def test_what_pushes_has_a_law_beside_that_of_the_ground() -> None:
    assert laws(with_pusher_law(manifest(THING, FINGER))) == [("finger", "thing")]
    assert not laws(manifest(THING, FINGER))
    without_ground = with_pusher_law(manifest(THING, FINGER).model_copy(update={"world": Surroundings()}))
    assert not laws(without_ground)  # the only pair has the plain names


def test_named_materials_and_several_bodies_stay_as_they_are() -> None:
    steel = Body(name="finger", motion="driven", material="steel")
    for given in (manifest(THING), manifest(THING, steel, materials=(Material(name="steel"),))):
        assert with_pusher_law(given) is given
    pushed = manifest(THING, Body(name="other", mass_kg=1.0), FINGER)
    assert with_pusher_law(pushed) is pushed


def velocity(x: float, z: float) -> torch.Tensor:
    """Return a change of velocity by contact (1, 3) [m/s]."""
    return torch.tensor([[x, 0.0, z]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("change", "driven", "expected"),
    [
        (velocity(0, 0), NOT, 0.0),  # flight
        (velocity(0, 0.327), NOT, CARRIED_SHARE * 0.327),  # rest
        (velocity(0, 0.2), NOT, CARRIED_SHARE * 0.2),  # touches late, and falls before
        (velocity(0.1, 0.327), NOT, CARRIED_SHARE * math.hypot(0.1, 0.327) + MOVING_SHARE * 0.1),  # slide
        (velocity(0, 1.327), NOT, CARRIED_SHARE * 1.327 + MOVING_SHARE * 1.0),  # impact
        (velocity(0, -0.5), NOT, (CARRIED_SHARE + MOVING_SHARE) * 0.5),  # nothing that pushes down carries
        (velocity(0, 0.327), TOUCHED, (CARRIED_SHARE + MOVING_SHARE) * 0.327),  # an even push
    ],
)
def test_the_model_errs_by_what_contact_does_beyond_carrying(
    change: torch.Tensor, driven: torch.Tensor, expected: float
) -> None:
    assert float(expected_error(change, FALLEN, driven)) == pytest.approx(expected, abs=1e-9)


def test_without_gravity_nothing_is_carried() -> None:
    error = expected_error(velocity(0, 0.4), torch.zeros(1, 3, dtype=torch.float64), NOT)
    assert float(error) == pytest.approx((CARRIED_SHARE + MOVING_SHARE) * 0.4, abs=1e-9)

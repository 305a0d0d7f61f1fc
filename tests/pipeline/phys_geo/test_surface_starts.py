"""Bodies and links whose tracks begin deep inside a fixed surface."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.phys_geo.stage import CROWDED_SWEEPS, _sweeps
from cgwm.pipeline.phys_geo.surface_starts import require_outside
from cgwm.pipeline.physics import Body, World
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.contact_detection import Placed
from cgwm.pipeline.physics.surfaces.detection import surface_gap
from cgwm.pipeline.physics.surfaces.fixed_surface import BOX, CYLINDER, HALF_SPACE, KINDS, FixedSurface
from cgwm.schemas import InputDataError
from helpers.chains import chained, link
from helpers.fixed_surfaces import surface
from helpers.worlds import ball_body, batch, law, world_of


def capture_of(heights_m: tuple[float, ...], quat: np.ndarray | None) -> Any:
    """Return a capture of one episode, in which the link 'lower' is at heights every 0.1 s."""
    places = np.array([[0.0, 0.0, height] for height in heights_m])
    turns = None if quat is None else np.tile(quat, (len(places), 1))
    track = Track(time_s=0.1 * np.arange(len(places)), position_m=places, quat_wxyz=turns)
    return SimpleNamespace(root=Path("C"), episodes=lambda split: ("one",), tracks=lambda name: {"lower": track})


def resting() -> World:
    """Return two links, of which the second has a sphere of 20 mm, and a table at height 0."""
    spheres = ((0.0, 0.0, 0.0, 0.02),)
    chain = Chain(name="arm", root="upper", base="free", joints=(Joint.of("hinge", "hinge", "lower", "upper"),))
    table = FixedSurface(
        name="table",
        kind=KINDS.index("half_space"),
        position=batch([0.0] * 3),
        quat_wxyz=batch([1.0, 0.0, 0.0, 0.0]),
        size=batch([0.0] * 3),
    )
    return replace(chained(chain, link("upper"), link("lower", spheres=spheres)), surfaces=(table,))


@pytest.mark.parametrize("quat", [np.array([[1.0, 0.0, 0.0, 0.0]]), None])  # None: a ball without orientation
def test_a_link_that_begins_deep_inside_a_surface_is_refused(quat: np.ndarray | None) -> None:
    world = resting()
    assert torch.equal(world.bodies[0].radii, torch.zeros(1, 0))  # a link without spheres touches nothing
    assert require_outside(world, capture_of((0.018, 0.03), quat), "train") == []
    (warning,) = require_outside(world, capture_of((0.018, 0.012, 0.03), quat), "train")
    assert "lower passes through the surface 'table' in 1 episode: 8.0 mm deep in episode 'one' at 0.10 s" in warning
    with pytest.raises(InputDataError, match=r"'table': in episode 'one', 'lower' begins 40\.0 mm deep inside it"):
        require_outside(world, capture_of((-0.02, 0.03), quat), "train")


def test_a_link_on_a_surface_does_not_fly() -> None:
    world = resting()
    heights = (0.15, 0.05, 0.02, 0.01, np.nan)
    body = world.bodies[1]
    places = torch.tensor([[0.0, 0.0, height] for height in heights], dtype=torch.float64)
    turns, still = torch.eye(3, dtype=torch.float64).expand(5, 3, 3), torch.zeros(5, 3, dtype=torch.float64)
    gap = surface_gap(Placed(body, places, turns, still, still), world.surfaces[0])
    np.testing.assert_allclose(gap, [np.inf, 0.03, 0.0, -0.01, np.inf], atol=1e-12)


@pytest.mark.parametrize("motion", ["free", "link"])
def test_a_body_at_rest_has_its_spheres_where_its_frame_is(motion: Literal["free", "link"]) -> None:
    body = Body(
        name="one", motion=motion, mass=torch.ones(1), inertia=torch.eye(3)[None],
        com=torch.tensor([[0.1, -0.2, 0.3]]), centers=torch.tensor([[[0.5, 0.0, 0.0]]]), radii=torch.ones(1, 1),
    )  # fmt: skip
    turn = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    placed = Placed.still(body, torch.tensor([[1.0, 2.0, 3.0]]), turn)
    assert torch.allclose(placed.reference[:, None] + placed.arms(), torch.tensor([[[1.0, 2.5, 3.0]]]))


@pytest.mark.parametrize(
    ("second", "apart"),
    [
        (surface("b", BOX, (0.0, 0.5, 0.0), size=(0.3, 0.1, 0.01)), True),
        (surface("b", BOX, (0.0, 0.31, 0.0), size=(0.3, 0.1, 0.01)), False),
        (surface("b", BOX, (0.0, 0.5, 0.0), quat=(np.cos(0.9), 0.0, 0.0, np.sin(0.9)), size=(0.9, 0.1, 0.01)), False),
        (surface("b", HALF_SPACE, (0.0, 0.0, -0.2)), True),
        (surface("b", HALF_SPACE, (0.0, 0.0, -0.1)), False),
        (surface("b", CYLINDER, (0.6, 0.0, 0.0), size=(0.1, 0.1, 0.5)), True),
    ],
)
def test_surfaces_that_no_body_can_touch_at_once_need_no_more_sweeps(second: FixedSurface, apart: bool) -> None:
    """A ball of 0.12 m; the first surface is 0.6 m by 0.2 m. One that is turned by 103 deg about z reaches it."""
    ball = world_of(ball_body(0.06), contact=law())
    first = surface("a", BOX, size=(0.3, 0.1, 0.01))
    assert first.apart(second, 0.12) == second.apart(first, 0.12) == apart
    assert _sweeps(replace(ball, surfaces=(first, second))) == (10 if apart else CROWDED_SWEEPS)
    assert _sweeps(replace(ball, surfaces=(first,))) == 10

"""Bodies and links whose tracks begin deep inside a fixed surface."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.phys_geo.surface_starts import require_outside
from cgwm.pipeline.physics.chain import Chain, Joint
from cgwm.pipeline.physics.fixed_surface import KINDS, FixedSurface
from cgwm.schemas import InputDataError
from helpers.chains import chained, link
from helpers.worlds import batch


def capture_of(heights_m: tuple[float, ...], quat: np.ndarray | None) -> Any:
    """Return a capture of one episode, in which the link 'lower' is at heights every 0.1 s."""
    places = np.array([[0.0, 0.0, height] for height in heights_m])
    turns = None if quat is None else np.tile(quat, (len(places), 1))
    track = Track(time_s=0.1 * np.arange(len(places)), position_m=places, quat_wxyz=turns)
    return SimpleNamespace(root=Path("C"), episodes=lambda split: ("one",), tracks=lambda name: {"lower": track})


@pytest.mark.parametrize("quat", [np.array([[1.0, 0.0, 0.0, 0.0]]), None])  # None: a ball without orientation
def test_a_link_that_begins_deep_inside_a_surface_is_refused(quat: np.ndarray | None) -> None:
    spheres = ((0.0, 0.0, 0.0, 0.02),)
    chain = Chain(name="arm", root="upper", base="free", joints=(Joint.of("hinge", "hinge", "lower", "upper"),))
    table = FixedSurface(
        name="table",
        kind=KINDS.index("half_space"),
        position=batch([0.0] * 3),
        quat_wxyz=batch([1.0, 0.0, 0.0, 0.0]),
        size=batch([0.0] * 3),
    )
    world = replace(chained(chain, link("upper"), link("lower", spheres=spheres)), surfaces=(table,))
    assert torch.equal(world.bodies[0].radii, torch.zeros(1, 0))  # a link without spheres touches nothing
    assert require_outside(world, capture_of((0.018, 0.03), quat), "train") == []
    (warning,) = require_outside(world, capture_of((0.018, 0.012, 0.03), quat), "train")
    assert "lower passes through the surface 'table' in 1 episode: 8.0 mm deep in episode 'one' at 0.10 s" in warning
    with pytest.raises(InputDataError, match=r"'table': in episode 'one', 'lower' begins 40\.0 mm deep inside it"):
        require_outside(world, capture_of((-0.02, 0.03), quat), "train")

"""Spheres at an edge are as bright as the side of it that a camera sees."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cgwm.pipeline.rendering.edge_light import Edges
from cgwm.pipeline.rendering.relighting import Relighting
from cgwm.schemas import BodyModel, Light

SCALE, LIGHT = 0.002, Light(lamp=(0.1, -0.2, 0.8), sky=0.2)
BODY = BodyModel(name="a", motion="free", mass_kg=1, inertia_kg_m2=(1, 1, 1, 0, 0, 0), com_m=(0, 0, 0))
UP, RIGHT = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])


def _sides(columns: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centres and normals of a top, which ends at x = 0, and of the side below its edge."""
    along, inward = (values.ravel() for values in np.meshgrid(np.arange(6), 0.5 + np.arange(columns)))
    nothing = np.zeros_like(inward)
    top = SCALE * 1.5 * np.stack([-inward, along, nothing], 1)
    side = SCALE * 1.5 * np.stack([nothing, along, -inward], 1)
    normals = torch.cat([UP.expand(len(top), 3), RIGHT.expand(len(side), 3)])
    return torch.as_tensor(np.concatenate([top, side])).float(), normals


def test_only_spheres_close_to_another_side_are_at_an_edge() -> None:
    means, normals = _sides()
    scales = torch.full((len(means),), SCALE)
    edges = Edges.of(means, scales, normals)
    away = torch.hypot(means[:, [0, 2]].abs().amax(1), torch.tensor(0.75 * SCALE))  # of the other side's first row
    assert edges.rows.tolist() == (away <= 3 * SCALE).nonzero()[:, 0].tolist()
    assert torch.equal((edges.normals * edges.others).sum(1), torch.zeros(len(edges.rows)))
    top = normals[:, 2] > 0
    assert len(Edges.of(means[top], scales[top], normals[top]).rows) == 0


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_sphere_of_the_hidden_side_is_as_bright_as_the_side_that_is_seen(turn: float) -> None:
    means, normals = _sides()
    edges = Edges.of(means, torch.full((len(means),), SCALE), normals)
    rotation = torch.tensor(
        [[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]]
    ).float()
    relighting = Relighting.of(LIGHT, BODY, normals)
    own = relighting.brightness(normals @ rotation.T)[:, None]
    albedo, world = torch.tensor([0.2, 0.25, 0.3]), means @ rotation.T
    placed = edges.placed(relighting, rotation[None]).view(0)
    seen = placed.seen(own * albedo, world, rotation @ torch.tensor([-0.5, 0.0, 1.0]))  # from above, not from the side
    top = relighting.brightness((rotation @ UP)[None])
    changed = torch.zeros(len(means), dtype=torch.bool)
    changed[edges.rows] = normals[edges.rows, 0] > 0
    assert changed.sum() >= 6
    assert torch.allclose(seen[changed], (top * albedo).expand(int(changed.sum()), 3), rtol=1e-5)
    assert torch.equal(seen[~changed], (own * albedo)[~changed])
    both = placed.seen(own * albedo, world, rotation @ torch.tensor([1.0, 0.0, 1.0]))  # both sides are seen
    assert torch.equal(both, own * albedo)
    twice = edges.placed(relighting, torch.stack([rotation, torch.eye(3)]))  # views at once are as one by one
    eye = torch.tensor([-0.5, 0.0, 1.0])
    places = torch.stack([world, means])
    together = twice.seen((own * albedo).expand(2, -1, -1), places, eye)
    for k in range(2):
        assert torch.equal(together[k], twice.view(k).seen(own * albedo, places[k], eye))

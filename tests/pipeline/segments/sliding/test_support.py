"""Rolls and slides on fixed surfaces: what carries a body, whole pieces between impacts, states, and what they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.phys_geo.effects.requested_effects import _present
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.prepare import prepare
from cgwm.pipeline.segments.sliding.fit import StartedSliding
from cgwm.pipeline.segments.sliding.segments import segments_on_surfaces
from cgwm.pipeline.segments.sliding.support import LIMITS, Support, on_surfaces
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers import fixed_surfaces as fixed
from helpers.worlds import F64, ball_body, world_of

RADIUS_M, STEEP = 0.02, np.radians(5.0)
DOWN, OUT = np.array([np.cos(STEEP), 0, -np.sin(STEEP)]), np.array([np.sin(STEEP), 0, np.cos(STEEP)])
PLATE = fixed.half_space(position=(0, 0, 0), quat=fixed.turn((0, 1, 0), 5))
WALL = fixed.box((0.02, 0.2, 0.2), "wall", position=(0.72, 0, 0), quat=fixed.turn((0, 1, 0), 5))


def world(*surfaces) -> World:
    """Return a ball above fixed surfaces, without a ground."""
    return replace(world_of(ball_body(RADIUS_M), ground=False), surfaces=surfaces)


def rolls(share: float = 0.0, off_m: float = 0.0, wall: float | None = None) -> list[Episode]:
    """Return rolls down and up a tilted plate, by their equation of motion, 5/7 g sin; with noise of 0.3 mm.

    Args:
        share: Resistance in units of this acceleration, against the motion.
        off_m: Height of all of them above the plate.
        wall: Place at which they stop, along the plate; None for none.
    """
    found, generator = [], np.random.default_rng(3)
    for k, start in enumerate((0.0, 0.3, -0.8, 0.1, -0.6, 0.5)):
        t = np.arange(120) / 100
        pull = 5 / 7 * 9.81 * np.sin(STEEP)
        way, speed, steps = np.zeros(len(t)), start, 50
        for frame in range(1, len(t)):
            way[frame] = way[frame - 1]
            for _ in range(steps):
                speed += 0.01 / steps * pull * (1 - share * np.sign(speed))
                way[frame] += 0.01 / steps * speed
            if wall is not None and way[frame] > wall:
                way[frame], speed = wall, 0.0
        at = np.outer(way, DOWN) + (RADIUS_M + off_m) * OUT + generator.normal(0, 3e-4, (len(t), 3))
        found.append(Episode(str(k), {"ball": Track(t, at, None)}))
    return found


def test_what_carries_a_ball_on_a_plate_in_a_groove_and_in_the_air() -> None:
    groove = fixed.mesh_surface(*fixed.groove(0.5, 4, 0.05), name="groove")
    low = RADIUS_M * 2**0.5
    at = torch.tensor([[0.1, 0, low], [0.1, 0.002, low + 0.002], [0.1, 0.0, 0.1]], dtype=F64)
    flat = torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(3, 4)
    found = Support.of(world(groove), 0, at, flat, 0.005)
    carried = found.carried(0.001)
    assert carried.square().sum((1, 2)).round().tolist() == [2, 1, 0]  # the second touches one side alone
    along = torch.tensor([1.0, 0, 0], dtype=F64)
    assert (carried @ along).abs().max() < 1e-9
    moved = Support.of(world(groove), 0, at[:1] + torch.tensor([0, 0.001, -0.002], dtype=F64), flat[:1], 0.005)
    torch.testing.assert_close(moved.lifted(0.01)[0, 1:], torch.tensor([-0.001, 0.002], dtype=F64), rtol=0, atol=1e-9)
    spin = found.rolling(0.001, 0.3 * along.expand(3, 3), RADIUS_M)
    turns = torch.tensor([0, 0.3 / (RADIUS_M / 2**0.5), 0], dtype=F64)
    torch.testing.assert_close(spin[0], turns, rtol=1e-9, atol=1e-9)
    assert float(np.sin(np.radians(14)) ** 2) < LIMITS.apart < float(np.sin(np.radians(15)) ** 2)


def test_pieces_are_as_long_as_the_roll_and_end_at_a_wall() -> None:
    noise = Noise(3e-4, 1e-3)
    for wall, least in ((None, 118), (0.68, 50)):
        scene = world(PLATE, *([] if wall is None else [WALL]))
        assert on_surfaces(scene)
        whole = whole_episodes(scene, rolls(off_m=0.001, wall=wall))
        none = torch.zeros_like(whole.seen[..., 0], dtype=torch.bool)
        pieces, carrying = segments_on_surfaces(scene, whole, none, noise)
        first = [p for p in pieces if p.episode == 1]
        assert first[0].first == 0 and first[0].last >= least
        if wall is not None:  # 0.3 m/s + 0.61 m/s2: it is there after 1.08 s at 0.96 m/s
            assert first[0].last < 112
    assert float(carrying.gap_m[2, 0]) == pytest.approx(0.001, abs=0.0015)


def test_a_height_that_is_wrong_shows_nothing_and_a_resistance_its_size() -> None:
    """The plate is stated 1 mm too low, the noise is not known: chi2 is its degrees of freedom, without turns too."""
    scene = world(PLATE)
    chi2 = []
    for share in (0.0, 0.08):
        prepared = prepare(scene, rolls(share, off_m=0.001))
        started = StartedSliding.of(prepared, scene, prepared.flight)
        assert started is not None and len(started.segments.items) == 6
        assert started.segments.noise.position_m == pytest.approx(3e-4, rel=0.1)
        dof = started.segments.dof
        torch.testing.assert_close(dof, torch.full_like(dof, 2 * 118.0), rtol=0, atol=1e-6)
        chi2.append(started.base.cost / float(dof.sum()))
    assert 0.85 < chi2[0] < 1.15
    assert chi2[1] > 20


def test_surfaces_are_something_to_touch_for_a_fit_of_an_effect_of_contact() -> None:
    """Without that, the command that a diagnosis ends with is refused."""
    assert "contact" in _present(world(PLATE), rolls())
    assert "contact" not in _present(world(), rolls())

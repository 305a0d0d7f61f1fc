"""Losses of a drawer that a finger shoves without measured forces, from where it glides."""

from dataclasses import replace

import numpy as np
import torch
from cgwm.datasets import Track
from cgwm.datasets.capture.tracks import Episode
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate
from cgwm.pipeline.phys_geo.tracks.glides import fit_gliding_joints, free_runs, interval, moves_on, roughness
from cgwm.pipeline.physics.chains.chain import Chain, Joint
from cgwm.pipeline.physics.chains.parameters import chain_parameters
from cgwm.pipeline.physics.parameters import contact_parameters
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.track_noise import Noise
from helpers.chains import chained, link
from helpers.worlds import F64, ball_body, law

MASS, DAMPING, FRICTION = 2.0, 4.0, 3.0
NOISE = Noise(1e-4, 1e-3)
RATE = 60.0


def world() -> World:
    """A drawer with an almost flat face across x, on a rail along x, and a finger."""
    rail = Joint.of("rail", "slide", "drawer", "case", axis=(1, 0, 0))
    bodies = (link("case", 0.0), link("drawer", MASS, spheres=((50.0, 0.0, 0.0, 50.01),)))
    finger = replace(ball_body(0.01, 0.1), name="finger", motion="driven")
    chain = Chain(name="cabinet", root="case", base="fixed", joints=(rail,))
    made = chained(chain, *bodies, finger, ground=False, contact=law(0.3, 0.004, 1.0))
    return replace(made, gravity=torch.zeros(1, 3, dtype=F64))


def shove(seed: int, glides: bool = True) -> Episode:
    """A drawer that goes with a finger for half a second, and on by itself where the finger stops at once.

    v = (v0 + f / d) exp(-d t / m) - f / d until it stands.
    """
    rng, speed = np.random.default_rng(seed), 0.3 + 0.1 * seed
    times = np.arange(0, 1.2, 1 / RATE)
    finger, after = speed * np.minimum(times, 0.5), np.maximum(times - 0.5, 0.0)
    drawer = finger.copy()
    if glides:
        rest, rate = FRICTION / DAMPING, DAMPING / MASS
        after = np.minimum(after, np.log((speed + rest) / rest) / rate)
        drawer += (speed + rest) / rate * (1 - np.exp(-rate * after)) - rest * after
    zero, quat = np.zeros_like(times), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
    noise = NOISE.position_m * rng.standard_normal((2, len(times), 3))
    tracks = {
        "case": Track(times, np.zeros((len(times), 3)), quat),
        "drawer": Track(times, np.stack((drawer, zero, zero), 1) + noise[0], quat),
        "finger": Track(times, np.stack((finger - 0.02, zero, zero), 1) + noise[1], quat),
    }
    return Episode(f"{seed}", tracks)


def test_glides_tell_losses_by_mass() -> None:
    found = fit_gliding_joints(world(), [shove(seed) for seed in range(4)], NOISE)
    assert found is not None and [p.name for p in found.parameters] == ["rail.damping", "rail.friction"]
    off, std = found.values - np.log([DAMPING, FRICTION]), np.sqrt(np.diag(found.covariance))
    assert (np.abs(off) < 2.5 * std).all() and (std < [0.3, 0.15]).all()
    assert found.record["parts"] == 4 and 0.4 < found.record["misfit"] < 2


def test_a_drawer_that_goes_with_the_finger_tells_nothing() -> None:
    """Where the search has a value with an interval, it gets the width of the prior."""
    found = fit_gliding_joints(world(), [shove(seed, glides=False) for seed in range(2)], NOISE)
    assert found is not None and found.record["parts"] == 0 and not found.told().parameters
    losses = chain_parameters(world())
    searched = ContactEstimate(parameters=losses, values=np.log([1.3, 2.5]), covariance=np.full((2, 2), 0.01))
    left = found.leave_open(found.told().put_in(searched, losses))
    np.testing.assert_allclose(left.values, searched.values)
    np.testing.assert_allclose(left.covariance, np.diag([p.prior[1] ** 2 for p in losses]))


def test_the_law_of_what_pushes_is_left_open() -> None:
    """Depths tell contact time and damping ratio, in which the size and path of the finger count as exact."""
    found = fit_gliding_joints(world(), [shove(0, glides=False)], NOISE)
    assert found is not None
    names = contact_parameters(world())
    searched = ContactEstimate(parameters=names, values=np.zeros(len(names)), covariance=0.01 * np.eye(len(names)))
    left = np.sqrt(np.diag(found.leave_open(searched).covariance))
    np.testing.assert_allclose(left, [0.1, *(p.prior[1] for p in names[1:])])


def test_ends_of_an_interval_where_others_are_positive() -> None:
    """Of x + y = 1 +- 0.1 and y = -1 +- 1, with y >= 0, x is 1 at most; the lower end is where y takes the rest."""
    least = np.array([-np.inf, 0.0])
    rows = np.array([[10.0, 10.0], [0.0, 1.0]])
    middle = np.linalg.solve(rows, [10.0, -1.0])
    low, high = interval(middle, rows.T @ rows, least, 0)
    assert abs(high - 1.196) < 1e-3
    limit = 1 + 1.96**2
    y = np.linspace(0, 3, 200_001)
    best = np.array([(np.square(10 * (x + y - 1)) + (y + 1) ** 2).min() - limit for x in (low - 1e-3, low + 1e-3)])
    assert best[0] > 0 > best[1]
    assert interval(np.array([0.1]), np.eye(1), np.zeros(1), 0)[0] == 0
    np.testing.assert_allclose(interval(np.array([5.0]), np.eye(1), np.zeros(1), 0), [3.04, 6.96], atol=1e-3)


def test_worlds_that_are_left_to_the_search() -> None:
    bodies = tuple(body for body in world().bodies if body.name != "finger")
    free = replace(world(), chains=(replace(world().chains[0], base="free"),))
    episode = shove(0)
    assert fit_gliding_joints(free, [episode], NOISE) is None
    alone = Episode("0", {name: track for name, track in episode.tracks.items() if name != "finger"})
    assert fit_gliding_joints(replace(world(), bodies=bodies), [alone], NOISE) is None


def test_nothing_touches_beyond_the_way_of_what_comes_closer() -> None:
    """At 2 mm and the way by which the gap closes from frame to frame, a hit may lie between two of them."""
    gap = 0.03 * np.sin(np.linspace(0, np.pi, 60))
    ((first, last),) = free_runs(gap)
    assert gap[first] > 0.002 and gap[first - 1] < 0.0025
    fall = gap[last - 1] - gap[last]
    assert gap[last] > 0.002 + fall and gap[last + 1] < 0.0025 + fall
    rough = gap + 1e-3 * np.random.default_rng(0).standard_normal(60)
    assert 5e-4 < roughness(rough) < 2e-3
    assert min(rough[first] for first, _ in free_runs(rough)) > 0.004


def test_a_joint_moves_as_long_as_it_is_seen_to_go_on() -> None:
    times = np.arange(0, 1, 1 / 30)
    way = np.where(times < 0.5, 0.2 * times, 0.1)[:, None]
    sense = moves_on(times, way, np.full_like(way, 1e-4))[:, 0]
    assert (sense[:13] == 1).all() and (sense[14:] == 0).all()
    turned = moves_on(times, 0.1 - np.abs(way - 0.05), np.full_like(way, 1e-4))[:, 0]
    assert set(turned[:6]) == {1.0} and set(turned[9:13]) == {-1.0} and 0.0 in turned[6:9]
    assert not moves_on(times, 1e-4 * np.cos(40 * times)[:, None], np.full_like(way, 1e-4)).any()

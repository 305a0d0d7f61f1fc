"""Bias and intervals of the restitution of a table-tennis ball: `python benchmarks/bounces.py`.

The truth is an integrator of its own: a ball of 40 mm and 2.7 g with quadratic drag and an unknown spin bounces once
(Routh's impact of a shell, restitution 0.95), with some frames before and after. Measured is the centroid alone, with
errors of 0.5 mm that are correlated over 5 to 50 ms and white ones of 0.1 mm. For each frame rate: the fit of
`segments/impacts/restitution.py`, as `cgwm fit` calls it, to captures of 24, 4 and 1 bounces, 200 bounces in all.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.physics import Body, ContactLaw, World
from cgwm.pipeline.segments.impacts.restitution import restitution_of
from cgwm.pipeline.trajectories.segmentation import whole_episodes
from numpy.typing import NDArray

Array = NDArray[np.float64]

RADIUS_M, DRAG_PER_M, FRICTION, GRAVITY_M_S2 = 0.02, 0.13, 0.25, 9.81
SLOW_M, WHITE_M, MEMORY_S = 5e-4, 1e-4, (5e-3, 50e-3)
FRAMES = (6, 16)
STEP_S = 1e-4


def flown(velocity: Array, spin: Array, duration_s: float, direction: float, lift: float) -> Array:
    """Return positions (n, 3) every `STEP_S`, forwards or backwards in time."""

    def pull(v: Array) -> Array:
        return np.array([0, 0, -GRAVITY_M_S2]) - DRAG_PER_M * np.linalg.norm(v) * v + lift * np.cross(spin, v)

    position, step, places = np.zeros(3), direction * STEP_S, [np.zeros(3)]
    for _ in range(int(np.ceil(duration_s / STEP_S))):
        middle = velocity + 0.5 * step * pull(velocity)
        position, velocity = position + step * middle, velocity + step * pull(middle)
        places.append(position)
    return np.array(places)


def struck(velocity: Array, spin: Array, rebound: float) -> tuple[Array, Array]:
    """Return velocity and spin after an impact of a thin shell in one point, with Coulomb friction."""
    arm, normal = np.array([0, 0, -RADIUS_M]), -(1 + rebound) * velocity[2]
    slip = (velocity + np.cross(spin, arm)) * [1, 1, 0]
    push = -slip / (1 + 3 / 2)
    push *= min(1.0, FRICTION * normal / max(float(np.linalg.norm(push)), 1e-12))
    after = velocity + push
    after[2] = -rebound * velocity[2]
    return after, spin + np.cross(arm, push) / (2 / 3 * RADIUS_M**2)


def measured(rng: np.random.Generator, rate_hz: float, rebound: float, lift: float) -> Track:
    """Return the track of one bounce."""
    angle, along = rng.uniform(0, 2 * np.pi), rng.uniform(0, 3)
    velocity = np.array([along * np.cos(angle), along * np.sin(angle), -rng.uniform(1.5, 4.0)])
    spin, (before, after) = rng.normal(0, 40, 3), rng.integers(*FRAMES, 2)
    sides = (
        flown(velocity, spin, (before + 1) / rate_hz, -1.0, lift),
        flown(*struck(velocity, spin, rebound), (after + 1) / rate_hz, 1.0, lift),
    )
    time = rng.uniform(0, 1 / rate_hz) + np.arange(-before, after + 1) / rate_hz
    places = np.array([_between(sides[int(t >= 0)], abs(t)) for t in time]) + np.array([0, 0, RADIUS_M])
    memory = np.exp(-1 / rate_hz / np.exp(rng.uniform(*np.log(MEMORY_S))))
    slow = rng.normal(0, 1, places.shape)
    for k in range(1, len(slow)):
        slow[k] = memory * slow[k - 1] + np.sqrt(1 - memory**2) * slow[k]
    places = places + SLOW_M * slow + rng.normal(0, WHITE_M, places.shape)
    return Track(time_s=time - time[0], position_m=places)


def _between(places: Array, time_s: float) -> Array:
    steps = np.arange(len(places)) * STEP_S
    return np.array([np.interp(time_s, steps, places[:, k]) for k in range(3)])


def ball_over_ground() -> World:
    """Return the ball over the ground at 0; its contact does not enter."""
    one = torch.ones(1, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ball = Body(
        name="ball",
        motion="free",
        mass=0.0027 * one,
        inertia=(2 / 3 * 0.0027 * RADIUS_M**2 * torch.eye(3, dtype=torch.float64))[None],
        com=torch.zeros(1, 3, dtype=torch.float64),
        centers=torch.zeros(1, 1, 3, dtype=torch.float64),
        radii=RADIUS_M * one[None],
    )
    return World(
        bodies=(ball,),
        gravity=-GRAVITY_M_S2 * up[None],
        ground_normal=up,
        ground_offset=0 * one,
        contact=ContactLaw(0.3 * one, 0.003 * one, 0.3 * one),
        step_s=0.001,
    )


def main() -> None:
    """Print a row for each frame rate and size of capture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bounces", type=int, default=200, help="bounces at each frame rate and size")
    parser.add_argument("--restitution", type=float, default=0.95)
    parser.add_argument("--scatter", type=float, default=0.0, help="standard deviation from impact to impact")
    parser.add_argument("--lift", type=float, default=0.0, help="Magnus lift over mass, spin and speed [1]")
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    world = ball_over_ground()
    print("rate_hz in_capture captures bias scatter_of_estimates std_error inside_95 drag_per_m")
    for rate in (60.0, 143.0, 400.0):
        for size in (24, 4, 1):
            rng = np.random.default_rng([args.seed, int(rate), size])
            fits = []
            for _ in range(max(1, round(args.bounces / size))):
                rebounds = np.minimum(args.restitution + args.scatter * rng.normal(size=size), 1.0)
                tracks = [measured(rng, rate, float(rebound), args.lift) for rebound in rebounds]
                episodes = [Episode(str(k), {"ball": track}) for k, track in enumerate(tracks)]
                fit = restitution_of(world, whole_episodes(world, episodes))
                fits += [] if fit is None else [(fit.estimate, fit.std_error, fit.drag_per_m)]
            estimate, error, drag = np.array(fits).T
            off = estimate - args.restitution
            inside = np.mean(np.abs(off) < 1.96 * error)
            row = f"{rate:g} {size} {len(fits)} {off.mean():+.4f} {estimate.std():.4f} {error.mean():.4f}"
            print(f"{row} {inside:.3f} {drag.mean():.3f}", flush=True)


if __name__ == "__main__":
    main()

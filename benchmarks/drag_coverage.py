"""Coverage of the interval of a ball's drag from throws as real tracks show them: `python benchmarks/drag_coverage.py`.

The truth is an integrator of its own: throws of a ball of 70 mm with a linear or a quadratic drag. Measured is the
centroid alone, at 120 to 300 Hz, with white errors of 0.1 mm, errors of 0.3 to 0.7 mm that are correlated over 5 to
50 ms, a tilt of the frame of each session (6 mrad) and one of each throw (0 or 3 mrad). With `--late-s`, throws are
faster, some 7 m/s, and the times of the frames are wrong by so much. For each kind of drag and tilt: the fit of
`cgwm fit --effects NAME` to captures of 12 throws, bias in standard errors, and the share of 95 % intervals that hold
the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import torch
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.pipeline.phys_geo.effects.effect_fit import fit_effects
from cgwm.pipeline.physics import Body, ContactLaw, World
from cgwm.pipeline.physics.effects import ActiveEffect, load_effect
from cgwm.pipeline.trajectories.track_noise import estimate_noise
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY_M_S2, RADIUS_M, THROWS, WHITE_M = 9.81, 0.035, 12, 1e-4
DRAGS = {"quadratic_drag": ("k", 0.025, 2.0), "linear_drag": ("c", 0.11, 1.0)}
"""Parameter, its true value and the exponent of the speed, by effect."""
STEP_S = 5e-4
SPEEDS_M_S, FAST_M_S = (0.5, 2.0), (4.0, 6.5)
"""Ranges of horizontal speeds, the second with errors of times."""


def thrown(rng: np.random.Generator, effect: str, tilt_rad: Array, own_rad: float, late_s: float = 0.0) -> Track:
    """Return the track of one throw in a frame that is tilted; late_s: standard deviation of the errors of times."""
    _, size, exponent = DRAGS[effect]
    angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*(SPEEDS_M_S if not late_s else FAST_M_S))
    velocity = np.array([speed * np.cos(angle), speed * np.sin(angle), rng.uniform(3.0, 5.0)])
    rate, length_s = rng.uniform(120, 300), rng.uniform(0.7, 1.0)
    leaning = tilt_rad + own_rad * rng.standard_normal(2)
    gravity = GRAVITY_M_S2 * np.array([-leaning[1], leaning[0], -1.0])

    def pull(v: Array) -> Array:
        return gravity - size * np.linalg.norm(v) ** (exponent - 1) * v

    position, places = np.zeros(3), [np.zeros(3)]
    for _ in range(int(length_s / STEP_S) + 2):
        middle = velocity + 0.5 * STEP_S * pull(velocity)
        position, velocity = position + STEP_S * middle, velocity + STEP_S * pull(middle)
        places.append(position)
    times = np.arange(int(length_s * rate)) / rate
    every = np.arange(len(places)) * STEP_S
    exposed = np.clip(times + late_s * rng.standard_normal(len(times)), 0.0, every[-1])
    path = np.stack([np.interp(exposed, every, axis) for axis in np.array(places).T], 1)
    slow, kept = rng.uniform(3e-4, 7e-4), np.exp(-1 / rate / rng.uniform(0.005, 0.05))
    away = rng.standard_normal((len(times), 3))
    for k in range(1, len(times)):
        away[k] = kept * away[k - 1] + np.sqrt(1 - kept**2) * away[k]
    noise = WHITE_M * rng.standard_normal(path.shape)
    return Track(time_s=times, position_m=path + slow * away + noise + [0, 0, 1.0], quat_wxyz=None)


def ball() -> World:
    """Return a world with a ball in free fall."""
    one = torch.ones(1, dtype=torch.float64)
    body = Body(
        name="ball",
        motion="free",
        mass=0.1 * one,
        inertia=(0.4 * 0.1 * RADIUS_M**2 * torch.eye(3, dtype=torch.float64))[None],
        com=torch.zeros(1, 3, dtype=torch.float64),
        centers=torch.zeros(1, 1, 3, dtype=torch.float64),
        radii=RADIUS_M * one[None],
    )
    return World(
        bodies=(body,),
        gravity=torch.tensor([[0.0, 0.0, -GRAVITY_M_S2]], dtype=torch.float64),
        ground_normal=None,
        ground_offset=None,
        contact=ContactLaw(0.3 * one, 0.003 * one, 0.4 * one),
    )


def fitted(task: tuple[int, str, float, float]) -> tuple[str, float, float, float, float]:
    """Return effect, tilt of each throw, estimate and interval of one capture."""
    seed, effect, own_rad, late_s = task
    torch.set_num_threads(1)
    rng = np.random.default_rng([seed, list(DRAGS).index(effect), round(1e4 * own_rad)])
    tilt = 6e-3 * rng.standard_normal(2)
    tracks = [thrown(rng, effect, tilt, own_rad, late_s) for _ in range(THROWS)]
    episodes = [Episode(f"{k:02d}", {"ball": track}) for k, track in enumerate(tracks)]
    world = ball()
    like = world.gravity[0, :1]
    active = tuple(ActiveEffect.of(load_effect(name), {}, like) for name in (effect, "gravity_tilt"))
    found = fit_effects(replace(world, effects=active), episodes, [], estimate_noise(tracks))
    number = next(p for p in found.parameters if p.name == f"{effect}.{DRAGS[effect][0]}")
    low, high = number.interval_95 or (-np.inf, np.inf)
    return effect, own_rad, number.estimate, low, high


def rows(found: Sequence[tuple[str, float, float, float, float]]) -> list[str]:
    """Return a row for each kind of drag and tilt."""
    lines = []
    for effect, own in sorted({one[:2] for one in found}):
        truth = DRAGS[effect][1]
        values = np.array([one[2:] for one in found if one[:2] == (effect, own)])
        error = (values[:, 2] - values[:, 1]) / 3.92
        inside = (values[:, 1] <= truth) & (truth <= values[:, 2])
        off = (values[:, 0] - truth) / error
        lines.append(
            f"{effect} {1e3 * own:g} {len(values)} {truth:g} {values[:, 0].mean():.5f} {values[:, 0].std():.5f} "
            f"{error.mean():.5f} {off.mean():+.2f} {inside.mean():.3f}"
        )
    return lines


def main() -> None:
    """Print a row for each kind of drag and tilt."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=200, help="captures of each kind of drag and tilt")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--late-s", type=float, default=0.0, help="standard deviation of errors of the frames' times")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + args.captures)
    tasks = [(seed, effect, own, args.late_s) for seed in seeds for effect in DRAGS for own in (0.0, 3e-3)]
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(fitted, tasks))
    print("effect own_tilt_mrad captures truth mean scatter std_error bias_in_std_errors inside_95")
    print("\n".join(rows(found)))


if __name__ == "__main__":
    main()

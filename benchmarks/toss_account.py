"""What the open-loop error on tosses is made of: where it arises, and how far other starts or contacts lower it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.geometry.rotation import geodesic_angle
from cgwm.pipeline.physics.parameters import CONTACT_PARAMETERS, apply_parameters
from cgwm.pipeline.physics.rollout import simulate
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.segments.release_detection import from_releases
from cgwm.pipeline.trajectories.initial_state import clearance, estimate_states, warmup_frames
from cgwm.pipeline.trajectories.observations import Observations, track_episodes
from cgwm.pipeline.trajectories.residuals import retract
from cgwm.pipeline.trajectories.state_uncertainty import covariance_root
from cgwm.pipeline.trajectories.track_noise import estimate_noise
from torch import Tensor

Motions = tuple[Tensor, Tensor]
"""Positions (K, E, T, 1, 3) [m] and orientations (K, E, T, 1, 4)."""
WARMUP_S = 0.1
SAMPLES = 32
BATCH = 1000
SURFACE_M = 0.073
"""Mean distance of the cube's surface from its centre [m]: what a rotation is worth."""
STATE_JITTER = (0.0, 0.0, 0.01, 0.05)
"""Standard deviations, by axis, of the perturbed start: position [m], rotation [rad], velocity [m/s], spin [rad/s]."""
CONTACT_JITTER = (0.1, 0.3, 0.15)
"""Standard deviations of the logarithms of friction, contact time and damping ratio from toss to toss."""
LANDED_M = 0.004
"""The first contact: the cube's lowest corner is this near to the ground."""


@dataclass(frozen=True, eq=False)
class Account:
    """Tosses with the states of their warm-ups.

    warm (E, T); covariance (E, 12, 12): of the states, widened by what the warm-up's residuals exceed the noise by.
    """

    world: World
    observations: Observations
    warm: Tensor
    covariance: Tensor

    @staticmethod
    def of(world: World, capture: Capture, split: str, most: int | None = None) -> Account:
        """Estimate the states of a split's tosses by the model, from their warm-ups; of the first `most` of them."""
        episodes = track_episodes(capture, split)[:most]
        noise = estimate_noise([track for _, tracks in episodes for track in tracks.values()])
        episodes, _ = from_releases(world, episodes, noise)  # as `cgwm eval`
        observations = Observations.of(world, episodes, [(-np.inf, np.inf)] * len(episodes))
        warm = warmup_frames(world, observations, WARMUP_S)
        observations, solution = estimate_states(world, observations, warm, noise)
        used = warm[:, : solution.chi2.shape[1]].to(solution.chi2)
        excess = (solution.chi2 * used).sum(1) / (6 * used.sum(1) - 12).clamp_min(6)
        return Account(world, observations, warm, solution.state_cov * excess.clamp_min(1.0)[:, None, None])

    def report(self, seed: int) -> dict[str, Any]:
        """Return the account; errors are means over tosses, translation [m] and rotation [deg]."""
        rng, count = np.random.default_rng(seed), len(self.observations.names)
        # a generator for each kind, so that the samples of one do not hang on another's
        normal = [torch.as_tensor(g.standard_normal((SAMPLES, count, 12))) for g in rng.spawn(3)]
        uncertain = (covariance_root(self.covariance) @ normal[0][..., None]).squeeze(-1)
        jitter = normal[1] * torch.tensor([s for s in STATE_JITTER for _ in range(3)], dtype=torch.float64)
        law = self.world.contact
        contact = torch.cat((law.friction, law.contact_time_s, law.damping_ratio))
        contact = contact * (normal[2][..., :3] * torch.tensor(CONTACT_JITTER, dtype=torch.float64)).exp()
        measured = self.observations.position_m[None], self.observations.quat_wxyz[None]
        itself = self._rollouts(None, None)
        finer = replace(self, world=replace(self.world, step_s=0.5 * self.world.step_s))._rollouts(None, None)
        moved = {
            "uncertainty_of_state": self._rollouts(None, uncertain),
            "jitter_of_state": self._rollouts(None, jitter),
            "jitter_of_contact": self._rollouts(contact, None),
            "jitter_of_both": self._rollouts(contact, jitter),
        }
        base = self._apart(itself, measured)
        errors = {name: self._apart(sample, measured) for name, sample in moved.items()}
        return {
            "error": _means(base),
            "median_error_by_time_after_first_contact": self._by_time(itself),
            "state_std_median": self.covariance.diagonal(dim1=1, dim2=2).sqrt().median(0).values.tolist(),
            "moved_by_half_the_step": _means(self._apart(finer, itself)),
            "moved_by": {name: _means(self._apart(sample, itself)) for name, sample in moved.items()},
            "error_of_samples": {name: _means(error) for name, error in errors.items()},
            "error_of_best_sample": {name: _best(base, error) for name, error in errors.items()},
        }

    def _rollouts(self, contact: Tensor | None, change: Tensor | None) -> Motions:
        """Return the motions (K, E, T, ...) for samples of contacts (K, E, 3) and state changes (K, E, 12)."""
        seen, count = self.observations, len(self.observations.names)
        samples = next((x.shape[0] for x in (contact, change) if x is not None), 1)
        items = torch.arange(count).repeat(samples)
        position, quat = seen.position_m[items], seen.quat_wxyz[items]
        # tosses of similar length together, since a batch is as long as its longest
        for rows in seen.frames[items].argsort(stable=True).split(BATCH):
            tosses = items[rows]
            longest = int(seen.frames[tosses].max())
            state = seen.state.at(tosses)
            if change is not None:
                state = retract(state, change.flatten(0, 1)[rows], seen.free)
            world = self.world
            if contact is not None:
                world = apply_parameters(world, CONTACT_PARAMETERS, contact.flatten(0, 1)[rows])
            with torch.no_grad():
                found = simulate(world, state, seen.times_s[tosses, :longest])
            position[rows, :longest], quat[rows, :longest] = found.position_m, found.quat_wxyz
        return position.unflatten(0, (samples, count)), quat.unflatten(0, (samples, count))

    def _apart(self, one: Motions, other: Motions) -> list[Tensor]:
        """Return the mean distance [m] and angle [deg] (K, E) of motions over the frames after the warm-up."""
        weight = self.observations.seen[..., 0] * (~self.warm).to(self.covariance)
        return [(error * weight).sum(-1) / weight.sum(-1) for error in _frames(one, other)]

    def _by_time(self, motion: Motions) -> list[dict[str, float | None]]:
        """Return the median errors in the flight before the first contact, and in bins of 50 ms after it."""
        seen = self.observations
        landed = (clearance(self.world, seen) < LANDED_M).to(torch.int64).argmax(1)
        time = seen.times_s - seen.times_s.gather(1, landed[:, None])
        counted = (seen.seen[..., 0] > 0) & ~self.warm
        distance, angle = (x[0] for x in _frames(motion, (seen.position_m[None], seen.quat_wxyz[None])))
        rows: list[dict[str, float | None]] = []
        for start in (-1.0, *(0.05 * k for k in range(12))):
            chosen = counted & (time >= start) & (time < (0.0 if start < 0 else start + 0.05))
            if int(chosen.sum()) > 20:
                rows.append(
                    {
                        "from_s": round(start, 3) if start >= 0 else None,
                        "translation_m": float(distance[chosen].median()),
                        "rotation_deg": float(angle[chosen].median()),
                    }
                )
        return rows


def _frames(one: Motions, other: Motions) -> tuple[Tensor, Tensor]:
    distance = (one[0] - other[0]).square().sum(-1).sqrt()[..., 0]
    return distance, torch.rad2deg(geodesic_angle(one[1], other[1]))[..., 0]


def _means(errors: Sequence[Tensor]) -> dict[str, float]:
    return {"translation_m": float(errors[0].mean()), "rotation_deg": float(errors[1].mean())}


def _best(base: Sequence[Tensor], samples: Sequence[Tensor]) -> dict[str, dict[str, float]]:
    """Return the mean errors of each toss's best among the rollout itself and the first 8 or all samples."""
    errors = [torch.cat((one, more)) for one, more in zip(base, samples, strict=True)]
    cost = (errors[0].square() + (SURFACE_M * torch.deg2rad(errors[1])).square()).sqrt()
    found = {}
    for count in (8, cost.shape[0] - 1):
        choice = cost[: count + 1].argmin(0, keepdim=True)
        found[str(count)] = _means([e.gather(0, choice)[0] for e in errors])
    return found

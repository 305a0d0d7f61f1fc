"""Whether a model describes measured motion at all: better than a body that stands still, and touching what it touches.

Open-loop predictions of some of the episodes are compared with a body that keeps its place, one that keeps its
velocity, and the same model without any contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ...schemas import NotDescribed
from ..physics.observation_model import measure
from ..physics.world import World
from ..trajectories.initial_state import clearance, estimate_states, warmup_frames
from ..trajectories.observations import Observations
from ..trajectories.track_noise import Noise
from .thresholds import SEGMENT_THRESHOLDS

LIMITS = SEGMENT_THRESHOLDS.described
MAX_EPISODES = 12
"""Maximum number of episodes that are predicted, evenly spread."""
WARMUP_S = 0.1
"""Duration of the warm-up [s], as that of `cgwm eval`."""


def not_described(world: World, episodes: Sequence[Episode], noise: Noise) -> NotDescribed | None:
    """Return why a model does not describe the episodes; None if it does.

    Args:
        world: The model's world.
        episodes: Name and tracks by body of each episode.
        noise: Standard deviations of the tracks (position [m], rotation [rad]).
    """
    chosen = np.linspace(0, len(episodes) - 1, min(len(episodes), MAX_EPISODES)).round().astype(int)
    some = [episodes[k] for k in np.unique(chosen)]
    return _Predicted.of(world, some, noise).verdict()


@dataclass(frozen=True, eq=False, kw_only=True)
class _Predicted:
    """Open-loop predictions of episodes (E) at their frames (T)."""

    world: World
    """The model's world."""
    seen: Observations
    """The measured motion."""
    after: Tensor
    """Measured frames after the warm-up, shape (E, T, nf)."""
    last: Tensor
    """Last frame of the warm-up, shape (E,)."""
    model: Tensor
    """Positions of the free bodies [m], shape (E, T, nf, 3); inf where the rollout diverged."""
    free: Tensor
    """The same without any contact."""
    noise: Noise
    """Standard deviations of the tracks."""

    @staticmethod
    def of(world: World, episodes: Sequence[Episode], noise: Noise) -> _Predicted:
        """Predict episodes from their warm-up."""
        starts = [min(float(track.time_s[0]) for track in tracks.values()) for _, tracks in episodes]
        seen = Observations.of(world, episodes, [(start - 1e-9, start + LIMITS.longest_s) for start in starts])
        warm = warmup_frames(world, seen, WARMUP_S)
        seen, _ = estimate_states(world, seen, warm, noise, 5)
        number = torch.arange(warm.shape[1])
        last = (warm * number).amax(1)
        beyond = (seen.seen > 0) & (number[None, :, None] > last[:, None, None])
        columns = list(seen.free)
        with torch.no_grad():
            model, free = (
                measure(seen.world(one), seen.state, seen.times_s, seen.drives).position_m[:, :, columns]
                for one in (world, replace(world, touching=False))
            )
        model = torch.nan_to_num(model, nan=torch.inf)
        return _Predicted(world=world, seen=seen, after=beyond, last=last, model=model, free=free, noise=noise)

    @property
    def size_m(self) -> float:
        """Largest distance of a free body's surface from its frame's origin [m]."""
        bodies = [self.world.bodies[k] for k in self.seen.free]
        return max(float((body.centers[0].norm(dim=-1) + body.radii[0]).max()) for body in bodies)

    def verdict(self) -> NotDescribed | None:
        """Return why the model does not describe the motion."""
        ours = self._errors(self.model)
        still, steady = (self._errors(self._held(moving)) for moving in (False, True))
        other: Literal["still", "steady"] = "still" if float(still.mean()) <= float(steady.mean()) else "steady"
        errors = still if other == "still" else steady
        worse = float(ours.mean()) > LIMITS.times_worse * float(errors.mean()) + LIMITS.sizes_worse * self.size_m
        worse &= float((ours > errors).double().mean()) >= LIMITS.episodes_worse
        touched = self._touched_in_tracks()
        passing = touched & ~self._touches_in_model()
        never = bool(touched.any()) and float(passing.sum() / touched.sum()) >= LIMITS.episodes_worse
        never &= float(touched.double().mean()) >= LIMITS.touched_share  # one episode may be a wrong measurement
        if not worse and not never:
            return None
        error = float(ours.mean())
        cause, worse_than = self._cause(), other if worse else None
        return NotDescribed(
            sentence=_sentence(error, float(errors.mean()), worse_than, int(touched.sum()) if never else 0, cause),
            cause=cause,
            episodes=len(ours),
            error_m=error if np.isfinite(error) else None,
            still_error_m=float(still.mean()),
            steady_error_m=float(steady.mean()),
            never_touches=never,
            worse_than=worse_than,
        )

    def _errors(self, positions: Tensor) -> Tensor:
        """Return the mean distance [m] of positions (E, T, nf, 3) from the measured ones after the warm-up, (E,)."""
        distance = torch.where(self.after, (positions - self.seen.position_m).norm(dim=-1), 0.0)
        return distance.sum((1, 2)) / self.after.sum((1, 2)).clamp_min(1)

    def _held(self, moving: bool) -> Tensor:
        """Return bodies that stay where the warm-up ended, or keep the velocity that they had in it, (E, T, nf, 3)."""
        item, at, times = torch.arange(len(self.last)), self.seen.position_m, self.seen.times_s
        place = at[item, self.last][:, None]
        if not moving:
            return place.expand_as(at)
        span = (times[item, self.last] - times[:, 0]).clamp_min(1e-9)
        velocity = (place[:, 0] - at[:, 0]) / span[:, None, None]
        return place + (times - times[item, self.last][:, None])[..., None, None] * velocity[:, None]

    def _touches_in_model(self) -> Tensor:
        """Return in which episodes (E,) contact changes the predicted motion."""
        moved = torch.where(self.after, (self.model - self.free).norm(dim=-1), 0.0)
        return moved.amax((1, 2)) > LIMITS.touch_m

    def _touched_in_tracks(self) -> Tensor:
        """Return in which episodes (E,) a measured body stays at one height, or turns from falling to rising."""
        up = -self.world.gravity[0]
        pull = float(up.norm())
        found = torch.zeros(len(self.last), dtype=torch.bool)
        if pull == 0:
            return found
        heights = self.seen.position_m @ (up / pull)
        for item in range(len(found)):
            for column in range(heights.shape[2]):
                at = self.seen.seen[item, :, column] > 0
                times_s, height_m = self.seen.times_s[item, at], heights[item, at, column]
                found[item] |= _supported(times_s, height_m, pull, self.noise.position_m)
        return found

    def _cause(self) -> str:
        """Return the likely cause, from the measured distance to what could be touched and where the model leads."""
        others = [body.name for body in self.world.bodies if not body.free]
        gap = clearance(self.world, self.seen)
        measured = self.seen.seen.amax(-1) > 0
        nearest = float(torch.where(measured, gap, torch.inf).amin(1).median())
        if nearest == np.inf:
            gravity = self.world.gravity.flatten()[-3:]
            up = ", ".join(f"{-float(part) + 0.0:.6g}" for part in gravity / gravity.norm())
            return (
                "the model has nothing to touch: no ground, no surface and no other body. Add [world] ground to "
                f"capture.toml: ground = {{ normal = [{up}], offset_m = 0 }}"
            )
        if nearest > LIMITS.near_sizes * self.size_m:
            return (
                f"the measured body stays {1e3 * nearest:.0f} mm away from all that it could touch: the ground lies "
                "too low, a shape is too small, or the units are wrong"
            )
        if nearest < -LIMITS.inside_sizes * self.size_m:
            return (
                f"the measured body lies {-1e3 * nearest:.0f} mm inside of what it touches: the ground lies too high, "
                "a shape is too large, or the units are wrong"
            )
        if others and self._sinks():
            return (
                f"the body falls through: the colliding spheres of '{others[0]}' leave gaps. If it does not move, give "
                "its mesh in capture.toml as one of the [[surfaces]], whose triangles are touched exactly, in place of "
                "the body; or cover it with more spheres (--set sg-gs.max_collision_spheres=N)"
            )
        return "a wrong shape, ground or start; look at the motion with cgwm compare"

    def _sinks(self) -> bool:
        """Return whether the model ends below the measured motion in most episodes, by more than the body's size."""
        up = -self.world.gravity[0] / self.world.gravity[0].norm().clamp_min(1e-9)
        below = torch.where(self.after, (self.seen.position_m - self.model) @ up, 0.0).amax((1, 2))
        return float((below > self.size_m).double().mean()) >= 0.5


def _sentence(error_m: float, other_m: float, worse_than: str | None, touched: int, cause: str) -> str:
    """Return the statement in words.

    Args:
        error_m: Error of the model [m].
        other_m: Error of what predicts better [m].
        worse_than: What predicts better; None if nothing does.
        touched: Number of episodes whose tracks show contact, if the model shows none; else 0.
        cause: The likely cause.
    """
    parts = []
    if touched:
        parts.append(f"nothing touches anything in it, while the tracks show contact in {touched} of the episodes")
    if worse_than is not None:
        body = "stands still" if worse_than == "still" else "keeps its velocity"
        ours = f"it is {error_m:.2g} m off" if np.isfinite(error_m) else "its rollout diverges"
        parts.append(f"{ours}, a body that {body} {other_m:.2g} m")
    return f"The model does not describe this motion: {'; '.join(parts)}. Likely cause: {cause}."


def _supported(times_s: Tensor, height_m: Tensor, pull_m_s2: float, noise_m: float = 0.0) -> bool:
    """Return whether heights (T,) stay level for a while, or turn from falling to rising at once."""
    if len(times_s) < 4:
        return False
    return _stays_level(times_s, height_m, pull_m_s2) or _turns_up(times_s, height_m, pull_m_s2, noise_m)


def _stays_level(times_s: Tensor, height_m: Tensor, pull_m_s2: float) -> bool:
    """Return whether heights (T,) stay level for a while, other than at the top of a flight that lift makes flat."""
    free_m = 0.5 * pull_m_s2 * (LIMITS.level_s / 2) ** 2
    level_m = LIMITS.level_share * free_m
    ends = torch.searchsorted(times_s, times_s + LIMITS.level_s)
    for first, end in enumerate(ends.tolist()):
        part = height_m[first : end + 1]
        if end < len(times_s) and len(part) > 3 and float(part.max() - part.min()) < level_m:
            around = [height for height in (height_m[:first], height_m[end + 1 :]) if len(height)]
            if not around or not all(float(part.min() - height.min()) > level_m for height in around):
                return True
    return False


def _turns_up(times_s: Tensor, height_m: Tensor, pull_m_s2: float, noise_m: float) -> bool:
    """Return whether heights (T,) turn from falling to rising between two neighbouring pieces of a track.

    The pieces are so long that noise does not show such a turn. A step between them, as of a track that goes on with
    another body, is none.
    """
    step_s = float(times_s.diff().median())
    most = max(3, int(LIMITS.level_s / 2 / max(step_s, 1e-9)))
    count, least = 3, LIMITS.turn_m_s
    while count < most and _slope_error(count, step_s, noise_m) > least / LIMITS.turn_sigmas:
        count += 1
    if len(times_s) < 2 * count:
        return False
    at, height = times_s.unfold(0, count, 1), height_m.unfold(0, count, 1)
    off = at - at.mean(1, keepdim=True)
    rate = (off * height).sum(1) / off.square().sum(1).clamp_min(1e-18)
    down, up = rate[:-count], rate[count:]
    fitted = height.mean(1, keepdim=True) + rate[:, None] * off
    # within a piece gravity bends, and a step between bodies does more
    bent_m = pull_m_s2 * (count * step_s) ** 2 / 8 + LIMITS.turn_sigmas * noise_m
    straight = (height - fitted).abs().amax(1) <= bent_m
    gap_s, step_m = at[count:, 0] - at[:-count, -1], (height[count:, 0] - height[:-count, -1]).abs()
    joined = step_m <= torch.maximum(-down, up) * gap_s + LIMITS.turn_sigmas * noise_m
    least = max(least, LIMITS.turn_sigmas * _slope_error(count, step_s, noise_m))
    turned = (down < -least) & (up > least) & joined & straight[:-count] & straight[count:]
    return bool(turned.any())


def _slope_error(count: int, step_s: float, noise_m: float) -> float:
    """Return the standard error [m/s] of a line's slope through so many frames."""
    return noise_m / max(step_s, 1e-9) * (12 / (count * (count**2 - 1))) ** 0.5

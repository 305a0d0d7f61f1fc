"""Open-loop predictions of measured episodes, and what stands beside them: a frozen and a ballistic body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datasets.tracks import Track
from .estimation.observations import Observations
from .estimation.states import StartUncertainty
from .estimation.warmup import estimate_states, warmup_frames
from .physics.checks import require_finite
from .physics.measured import measure
from .physics.rollout import Rollout
from .physics.rotation import quat_exp, quat_multiply, quat_to_matrix
from .physics.world import World

Array = NDArray[np.float64]
Episode = tuple[str, dict[str, Track]]

MODEL, FROZEN, BALLISTIC = "model", "frozen", "ballistic"
BASELINES = (FROZEN, BALLISTIC)

BATCH = 64
"""Episodes rolled out together: more run out of the processor's cache."""
SAME_TIME_S = 1e-6
"""Frames of tracks and videos closer than this count as one moment."""
STATE_FIT_EPISODES = 10
"""Of more episodes than this, the state-fitted residual is that of so many, evenly spread: it costs fifty rollouts."""
STATE_FIT_ITERATIONS = 3
WARMUP_ITERATIONS = 5
"""Of the fit to the warm-up: mostly free flight, which is close to linear."""
SAMPLES = (2, 8)
"""Least and most samples of the initial state for one episode."""
SAMPLES_IN_ALL = 160


@dataclass(frozen=True, eq=False)
class Motion:
    """Predicted poses of all bodies: position_m (G, nb, 3) of the body frames' origins, world; quat_wxyz (G, nb, 4)."""

    position_m: Array
    quat_wxyz: Array


@dataclass(frozen=True, eq=False)
class EpisodePrediction:
    """One episode: what was measured, and what each method predicts.

    Attributes:
        episode: Its name.
        bodies: Names of the free bodies (nf).
        free: Their places among the model's bodies (nb).
        time_s: Times of the measured frames [s], shape (T,).
        warmup: Which of them the methods may see, shape (T,).
        position_m: Measured positions of the free bodies [m], world, shape (T, nf, 3).
        quat_wxyz: Measured orientations, shape (T, nf, 4).
        seen: Where a position was measured, shape (T, nf).
        turned: Where an orientation was measured, shape (T, nf).
        grid_s: Times of the predictions: those of tracks and videos together [s], shape (G,).
        rows: Place of each measured frame among them, shape (T,).
        motions: Predicted motion by method: model, frozen, ballistic.
        noise_floor_m: Error that the uncertainty of the initial state alone predicts [m].
        state_fitted_m: Error of the model from the state that fits the whole episode [m]; None where not computed.
    """

    episode: str
    bodies: tuple[str, ...]
    free: tuple[int, ...]
    time_s: Array
    warmup: NDArray[np.bool_]
    position_m: Array
    quat_wxyz: Array
    seen: NDArray[np.bool_]
    turned: NDArray[np.bool_]
    grid_s: Array
    rows: NDArray[np.int64]
    motions: dict[str, Motion]
    noise_floor_m: float
    state_fitted_m: float | None

    @property
    def warmup_end_s(self) -> float:
        """Time of the last frame of the warm-up [s]."""
        return float(self.time_s[self.warmup][-1])

    def predicted(self, method: str = MODEL) -> tuple[Array, Array]:
        """Return positions (T, nf, 3) [m] and orientations (T, nf, 4) of the free bodies at the measured frames."""
        motion, free = self.motions[method], list(self.free)
        return motion.position_m[self.rows][:, free], motion.quat_wxyz[self.rows][:, free]

    def translation_error_m(self, method: str = MODEL) -> Array:
        """Return the distance between predicted and measured position (T, nf) [m]; NaN where none was measured."""
        error = np.linalg.norm(self.predicted(method)[0] - self.position_m, axis=-1)
        return np.where(self.seen, error, np.nan)

    def rotation_error_deg(self, method: str = MODEL) -> Array:
        """Return the geodesic angle between predicted and measured orientation (T, nf) [deg]; NaN without one."""
        a, b = self.predicted(method)[1], self.quat_wxyz
        # |a - b| = 2 sin(angle / 4) keeps its precision at small angles, where acos(a . b) has none; q and -q are one
        apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
        angle = 4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))
        return np.where(self.turned, np.degrees(angle), np.nan)


def predict(
    world: World,
    episodes: Sequence[Episode],
    noise: tuple[float, float],
    warmup_s: float,
    video_times_s: Sequence[Array],
    on_step: Callable[[int], object] = lambda _: None,
    state_fits: int = STATE_FIT_EPISODES,
    fitted_world: World | None = None,
) -> list[EpisodePrediction]:
    """Predict episodes open loop from their warm-ups.

    Args:
        world: The model's world.
        episodes: Names, and tracks of all free and driven bodies.
        noise: Standard deviations of the measurement (position [m], rotation [rad]).
        warmup_s: Length of the warm-up [s].
        video_times_s: For each episode, further times at which to predict [s].
        on_step: Called with a number of finished episodes.
        state_fits: For how many of them, at most, the state is fitted to the whole episode.
        fitted_world: The world with all episodes' own numbers, for these fits; None for the same.

    Returns:
        The predictions, in the order of the episodes.

    Raises:
        NotConvergedError: If a rollout diverges.
    """
    count = len(episodes)
    samples = min(max(SAMPLES_IN_ALL // count, SAMPLES[0]), SAMPLES[1])
    with_own = world if fitted_world is None else fitted_world
    fitted = set(np.linspace(0, count - 1, min(count, state_fits)).round().astype(int).tolist())
    # those to fit in one batch; then episodes of similar length together, since a batch is as long as its longest
    order = sorted(range(count), key=lambda i: (i not in fitted, max(len(track) for track in episodes[i][1].values())))
    found: dict[int, EpisodePrediction] = {}
    for first in range(0, count, BATCH):
        numbers = order[first : first + BATCH]
        batch = _Batch.of(world, [episodes[i] for i in numbers], noise, warmup_s)
        floor = batch.uncertainty().noise_floor(samples, numbers)
        best = batch.state_fitted([k for k, number in enumerate(numbers) if number in fitted], noise, with_own)
        for k, prediction in enumerate(batch.predictions([video_times_s[i] for i in numbers])):
            figures = {"noise_floor_m": float(floor[k]), "state_fitted_m": best.get(k)}
            found[numbers[k]] = replace(prediction, **figures)
        on_step(len(numbers))
    return [found[number] for number in range(count)]


@dataclass(frozen=True)
class _Batch:
    """Episodes that are rolled out together, their states at the warm-up's estimate; warm (B, T)."""

    world: World
    observations: Observations
    warm: Tensor
    covariance: Tensor

    @staticmethod
    def of(world: World, episodes: Sequence[Episode], noise: tuple[float, float], warmup_s: float) -> _Batch:
        everything = [(-np.inf, np.inf)] * len(episodes)
        observations = Observations.of(world, episodes, everything)
        warm = warmup_frames(world, observations, warmup_s)
        observations, solution = estimate_states(world, observations, warm, noise, WARMUP_ITERATIONS)
        return _Batch(world, observations, warm, solution.state_cov)

    def weight(self) -> Tensor:
        """Return the measured frames after the warm-up (B, T, nf)."""
        return self.observations.seen * (~self.warm)[..., None].to(self.observations.seen.dtype)

    def uncertainty(self) -> StartUncertainty:
        return StartUncertainty(self.world, self.observations, self.covariance, self.weight())

    def state_fitted(self, items: list[int], noise: tuple[float, float], world: World) -> dict[int, float]:
        """Return the state-fitted residual [m] of some items of the batch."""
        if not items:
            return {}
        chosen = StartUncertainty(
            self.world, self.observations.select(items).with_own(world), self.covariance[items], self.weight()[items]
        )
        return dict(zip(items, chosen.fit(noise, STATE_FIT_ITERATIONS).tolist(), strict=True))

    def predictions(self, video_times_s: Sequence[Array]) -> list[EpisodePrediction]:
        """Roll out on the times of tracks and videos together, and add the baselines."""
        seen = self.observations
        times = [seen.times_s[k, : int(n)].numpy() for k, n in enumerate(_lengths(seen))]
        grids = [_merged(track, video) for track, video in zip(times, video_times_s, strict=True)]
        longest = max(len(grid) for grid, _ in grids)
        padded = np.stack([_padded(grid, longest) for grid, _ in grids])
        with torch.no_grad():
            rollout = measure(seen.world(self.world), seen.state, torch.as_tensor(padded).to(seen.times_s), seen.drives)
        require_finite(
            rollout, self.world, seen.state, [f"episode '{name}'" for name in seen.names], [len(g) for g, _ in grids]
        )
        return [self._prediction(k, time, *grids[k], rollout) for k, time in enumerate(times)]

    def _prediction(
        self, item: int, time: Array, grid: Array, rows: NDArray[np.int64], rollout: Rollout
    ) -> EpisodePrediction:
        seen, count = self.observations, len(time)
        model = Motion(rollout.position_m[item, : len(grid)].numpy(), rollout.quat_wxyz[item, : len(grid)].numpy())
        warm = self.warm[item, :count].numpy()
        last = int(rows[np.flatnonzero(warm)[-1]])
        prediction = EpisodePrediction(
            seen.names[item],
            tuple(self.world.bodies[k].name for k in seen.free),
            seen.free,
            time,
            warm,
            seen.position_m[item, :count].numpy(),
            seen.quat_wxyz[item, :count].numpy(),
            seen.seen[item, :count].numpy() > 0,
            seen.turned[item, :count].numpy() > 0,
            grid,
            rows,
            {MODEL: model},
            float("nan"),
            None,
        )
        prediction.motions[FROZEN] = _frozen(prediction, model, last)
        prediction.motions[BALLISTIC] = _ballistic(self.world, grid, rollout, item, model, last)
        return prediction


def _frozen(prediction: EpisodePrediction, model: Motion, last: int) -> Motion:
    """Return the free bodies at their last measured pose of the warm-up; an unmeasured one is the model's there."""
    position, quat = model.position_m.copy(), model.quat_wxyz.copy()
    for column, body in enumerate(prediction.free):
        position[:, body], quat[:, body] = model.position_m[last, body], model.quat_wxyz[last, body]
        for mask, target, measured in (
            (prediction.seen, position, prediction.position_m),
            (prediction.turned, quat, prediction.quat_wxyz),
        ):
            at = np.flatnonzero(prediction.warmup & mask[:, column])
            if len(at):
                target[:, body] = measured[at[-1], column]
    return Motion(position, quat)


def _ballistic(world: World, grid: Array, rollout: Rollout, item: int, model: Motion, last: int) -> Motion:
    """Return the free bodies in free flight from the estimated state at the end of the warm-up, through everything.

    The centre of mass follows a parabola; the angular velocity is constant.
    """
    position, quat = model.position_m.copy(), model.quat_wxyz.copy()
    time = torch.as_tensor(grid - grid[last]).to(rollout.position_m)[:, None]
    for body in world.free:
        start = rollout.quat_wxyz[item, last, body]
        omega, velocity = rollout.omega_body_rad_s[item, last, body], rollout.velocity_m_s[item, last, body]
        com = world.bodies[body].com[0]
        rotation = quat_to_matrix(start)
        com_velocity = velocity + rotation @ torch.linalg.cross(omega, com)
        turned = quat_multiply(start.expand(len(grid), 4), quat_exp(time * omega))
        center = rollout.position_m[item, last, body] + rotation @ com
        path = center + time * com_velocity + 0.5 * time.square() * world.gravity[0]
        position[:, body] = (path - quat_to_matrix(turned) @ com).numpy()
        quat[:, body] = turned.numpy()
    return Motion(position, quat)


def _lengths(observations: Observations) -> Tensor:
    """Return the number of frames (B,) of each item up to its last measured one."""
    place = torch.arange(1, observations.times_s.shape[1] + 1)
    return ((observations.seen.amax(-1) > 0) * place).amax(1)


def _merged(track_s: Array, video_s: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the times of a track and a video in one (G,), from the track's start on, and the track's places (T,)."""
    later = video_s[video_s > track_s[0] + SAME_TIME_S]
    if len(later):
        nearest = np.abs(track_s[:, None] - later).min(0)
        later = later[nearest > SAME_TIME_S]
    later = later[np.diff(later, prepend=-np.inf) > SAME_TIME_S]
    grid = np.sort(np.concatenate((track_s, later)))
    return grid, np.searchsorted(grid, track_s)


def _padded(grid: Array, length: int) -> Array:
    step = float(np.diff(grid).mean()) if len(grid) > 1 else 1.0
    return np.concatenate((grid, grid[-1] + step * np.arange(1, length - len(grid) + 1)))

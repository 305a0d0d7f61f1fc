"""Open-loop predictions of measured episodes, and two baselines: a frozen and a ballistic body."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...datasets.capture.tracks import Episode
from ..geometry.rotation import quat_exp, quat_multiply, quat_to_matrix
from ..physics.observation_model import measure
from ..physics.rollout import Rollout, require_finite
from ..physics.world import World
from ..trajectories.initial_state import estimate_states, warmup_frames
from ..trajectories.observations import Observations
from ..trajectories.rolling_start import rolling_items
from ..trajectories.state_uncertainty import StartUncertainty
from ..trajectories.track_noise import Noise

Array = NDArray[np.float64]

MODEL, FROZEN, BALLISTIC = "model", "frozen", "ballistic"
BASELINES = (FROZEN, BALLISTIC)

BATCH = 64
"""Number of episodes rolled out together; more exceed the cache of the processor."""
SAME_TIME_S = 1e-6
"""Maximum difference between times of tracks and videos that count as one time [s]."""
STATE_FIT_EPISODES = 10
"""Maximum number of episodes with a state-fitted residual, evenly spread; each costs about fifty rollouts."""
STATE_FIT_ITERATIONS = 3
WARMUP_ITERATIONS = 5
"""Number of iterations of the fit to the warm-up, which is mostly free flight and close to linear."""
SAMPLES = (2, 8)
"""Minimum and maximum number of samples of the initial state for one episode."""
SAMPLES_IN_ALL = 160


@dataclass(frozen=True, eq=False)
class Motion:
    """Predicted poses of all bodies."""

    position_m: Array
    """Positions of the origins of the body frames [m], world frame, shape (G, nb, 3)."""
    quat_wxyz: Array
    """Orientations (body to world), shape (G, nb, 4)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodePrediction:
    """Measurements of one episode and the predictions of each method."""

    episode: str
    """Name of the episode."""
    bodies: tuple[str, ...]
    """Names of the free bodies (nf)."""
    free: tuple[int, ...]
    """Indices of the free bodies among the bodies of the model (nb)."""
    time_s: Array
    """Times of the measured frames [s], shape (T,)."""
    warmup: NDArray[np.bool_]
    """Whether a frame belongs to the warm-up, which the methods may use, shape (T,)."""
    position_m: Array
    """Measured positions of the free bodies [m], world frame, shape (T, nf, 3)."""
    quat_wxyz: Array
    """Measured orientations of the free bodies (body to world), shape (T, nf, 4)."""
    seen: NDArray[np.bool_]
    """Whether a position was measured, shape (T, nf)."""
    turned: NDArray[np.bool_]
    """Whether an orientation was measured, shape (T, nf)."""
    grid_s: Array
    """Times of the predictions, the union of those of tracks and videos [s], shape (G,)."""
    rows: NDArray[np.int64]
    """Index of each measured frame in `grid_s`, shape (T,)."""
    motions: dict[str, Motion]
    """Predicted motion by method: model, frozen, ballistic."""
    noise_floor_m: float
    """Expected error due to the uncertainty of the initial state alone [m]."""
    state_fitted_m: float | None
    """Error of the model from the state fitted to the whole episode [m]; None if not computed."""
    rolls: bool = False
    """Whether its spin, which nothing measured, is that of a ball that rolls."""

    @property
    def warmup_end_s(self) -> float:
        """Time of the last frame of the warm-up [s]."""
        return float(self.time_s[self.warmup][-1])

    def predicted(self, method: str = MODEL) -> tuple[Array, Array]:
        """Return positions (T, nf, 3) [m] and orientations (T, nf, 4) of the free bodies at the measured frames."""
        motion, free = self.motions[method], list(self.free)
        return motion.position_m[self.rows][:, free], motion.quat_wxyz[self.rows][:, free]

    def translation_error_m(self, method: str = MODEL) -> Array:
        """Return the distance between predicted and measured position [m], (T, nf); NaN where not measured."""
        error = np.linalg.norm(self.predicted(method)[0] - self.position_m, axis=-1)
        return np.where(self.seen, error, np.nan)

    def rotation_error_deg(self, method: str = MODEL) -> Array:
        """Return the angle between predicted and measured orientation [deg], (T, nf); NaN where not measured."""
        a, b = self.predicted(method)[1], self.quat_wxyz
        # |a - b| = 2 sin(angle / 4) is precise at small angles, unlike acos(a . b); q and -q are equivalent.
        apart, together = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
        angle = 4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))
        return np.where(self.turned, np.degrees(angle), np.nan)


def predict(
    world: World,
    episodes: Sequence[Episode],
    noise: Noise,
    warmup_s: float,
    video_times_s: Sequence[Array],
    on_step: Callable[[int], object] = lambda _: None,
    state_fits: int = STATE_FIT_EPISODES,
    fitted_world: World | None = None,
) -> list[EpisodePrediction]:
    """Predict episodes in open loop from their warm-ups.

    Args:
        world: The model's world.
        episodes: Names and tracks of all free and driven bodies.
        noise: Standard deviations of the measurement (position [m], rotation [rad]).
        warmup_s: Length of the warm-up [s].
        video_times_s: Further times of predictions [s], for each episode.
        on_step: Function called with numbers of finished episodes.
        state_fits: Maximum number of episodes with a state fitted to the whole episode.
        fitted_world: World with the random effects of all episodes, for these fits; None for `world`.

    Returns:
        The predictions, in the order of the episodes.

    Raises:
        NotConvergedError: If a rollout diverges.
    """
    count = len(episodes)
    samples = min(max(SAMPLES_IN_ALL // count, SAMPLES[0]), SAMPLES[1])
    with_own = world if fitted_world is None else fitted_world
    fitted = set(np.linspace(0, count - 1, min(count, state_fits)).round().astype(int).tolist())
    # Episodes to fit form one batch; the others are grouped by length, since a batch is as long as its longest.
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
    """Batch of B episodes that are rolled out together."""

    world: World
    """World of the batch."""
    observations: Observations
    """Measurements, with initial states estimated from the warm-ups."""
    warm: Tensor
    """Whether a frame belongs to the warm-up, shape (B, T)."""
    covariance: Tensor
    """Covariance of the initial states, by episode."""
    rolling: Tensor
    """Episodes whose spin is that of a ball that rolls, shape (B,)."""

    @staticmethod
    def of(world: World, episodes: Sequence[Episode], noise: Noise, warmup_s: float) -> _Batch:
        everything = [(-np.inf, np.inf)] * len(episodes)
        observations = Observations.of(world, episodes, everything)
        warm = warmup_frames(world, observations, warmup_s)
        observations, solution = estimate_states(world, observations, warm, noise, WARMUP_ITERATIONS)
        rolling = rolling_items(world, observations, warm)
        return _Batch(world, observations, warm, solution.state_cov, rolling)

    def weight(self) -> Tensor:
        """Return the weights of the frames after the warm-up, shape (B, T, nf)."""
        return self.observations.seen * (~self.warm)[..., None].to(self.observations.seen.dtype)

    def uncertainty(self) -> StartUncertainty:
        return StartUncertainty(self.world, self.observations, self.covariance, self.weight())

    def state_fitted(self, items: list[int], noise: Noise, world: World) -> dict[int, float]:
        """Return the state-fitted residual [m] of items of the batch, by item."""
        if not items:
            return {}
        chosen = StartUncertainty(
            self.world, self.observations.select(items).with_own(world), self.covariance[items], self.weight()[items]
        )
        return dict(zip(items, chosen.fit(noise, STATE_FIT_ITERATIONS).tolist(), strict=True))

    def predictions(self, video_times_s: Sequence[Array]) -> list[EpisodePrediction]:
        """Return predictions at the times of tracks and videos, with the baselines."""
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
            episode=seen.names[item],
            bodies=tuple(self.world.bodies[k].name for k in seen.free),
            free=seen.free,
            time_s=time,
            warmup=warm,
            position_m=seen.position_m[item, :count].numpy(),
            quat_wxyz=seen.quat_wxyz[item, :count].numpy(),
            seen=seen.seen[item, :count].numpy() > 0,
            turned=seen.has_orientation[item, :count].numpy() > 0,
            grid_s=grid,
            rows=rows,
            motions={MODEL: model},
            noise_floor_m=float("nan"),
            state_fitted_m=None,
            rolls=bool(self.rolling[item]),
        )
        prediction.motions[FROZEN] = _frozen(prediction, model, last)
        prediction.motions[BALLISTIC] = _ballistic(self.world, grid, rollout, item, model, last)
        return prediction


def _frozen(prediction: EpisodePrediction, model: Motion, last: int) -> Motion:
    """Return the free bodies at their last measured pose of the warm-up, or at the model's pose if unmeasured."""
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
    """Return the free bodies in free flight from the estimated state at the end of the warm-up, without contact.

    The centre of mass follows a parabola; the angular velocity is constant.
    """
    position, quat = model.position_m.copy(), model.quat_wxyz.copy()
    time = torch.as_tensor(grid - grid[last]).to(rollout.position_m)[:, None]
    for body in world.tracked:
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
    """Return the times of a track and a video together (G,), from the track's start, and the track's rows (T,)."""
    later = video_s[video_s > track_s[0] + SAME_TIME_S]
    if len(later):
        after = np.searchsorted(track_s, later).clip(1, len(track_s) - 1)  # tracks have two samples or more
        nearest = np.minimum(np.abs(track_s[after - 1] - later), np.abs(track_s[after] - later))
        later = later[nearest > SAME_TIME_S]
    later = later[np.diff(later, prepend=-np.inf) > SAME_TIME_S]
    grid = np.sort(np.concatenate((track_s, later)))
    return grid, np.searchsorted(grid, track_s)


def _padded(grid: Array, length: int) -> Array:
    step = float(np.diff(grid).mean()) if len(grid) > 1 else 1.0
    return np.concatenate((grid, grid[-1] + step * np.arange(1, length - len(grid) + 1)))

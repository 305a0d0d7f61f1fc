"""The training episode as a fit may see it: frames, masks, cameras, and the commands of driven bodies.

And what contenders find in it with the same tools: the track of poses, and the state at the first frame. Pictures
have the sizes that `cgwm fit` has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Episode, Track
from cgwm.datasets.models.model import Model, read_model
from cgwm.pipeline.phys_geo.images.coarse_spheres import coarse_model
from cgwm.pipeline.phys_geo.images.image_loss import ImageLoss
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseTrack, PoseTracker, pose_noise
from cgwm.pipeline.phys_geo.images.video_episodes import COARSE_SIZE, commands, kinematic_poses
from cgwm.pipeline.phys_geo.images.video_frames import Footage, load_footage
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.observation_model import measure
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.trajectories.initial_state import estimate_states, flight_frames, warmup_frames
from cgwm.pipeline.trajectories.observations import START_FRAMES, Observations, first_state
from cgwm.schemas import ContactParameters, NotConvergedError, PhysConfig
from torch import Tensor

from .base import TRAIN_EPISODE, Array, Cell, Prediction

WARMUP_S = 0.1
"""The state at the first frame is first estimated from the track over this long, cut at the first contact."""

WARMUP_ITERATIONS = 5
WIDER, LEAST_STD = 2.0, (1e-3, 0.01, 0.02, 0.1)
"""A search over the start looks this many standard errors around it, and at least so far (m, rad, m/s, rad/s): the
track's pixels do not know of errors of shape and looks."""


@dataclass(frozen=True, eq=False)
class Training:
    """The training episode.

    model: the splats; world: their collision spheres, with a contact law that nobody has fitted yet; loss: the image
    loss of its frames; drives: commands of the driven bodies; position_m (I, nb, 3), quat_wxyz (I, nb, 4): poses of the
    driven bodies at the instants of the footage, the others at the origin.
    """

    model: Model
    world: World
    loss: ImageLoss
    drives: dict[str, Track]
    position_m: Tensor
    quat_wxyz: Tensor

    @property
    def footage(self) -> Footage:
        """The frames, reduced."""
        return self.loss.footage

    @property
    def times_s(self) -> Array:
        """Times of the instants at which any camera took a frame [s], shape (I,)."""
        return self.footage.times_s

    def costs(self, position_m: Tensor, quat_wxyz: Tensor) -> Tensor:
        """Return the image loss (B,) of motions (B, I, nb, ...): mean over the instants; infinite where not finite."""
        batch, count = position_m.shape[:2]
        finite = (position_m.isfinite().flatten(1).all(1) & quat_wxyz.isfinite().flatten(1).all(1)).nonzero()[:, 0]
        costs = torch.full((batch,), torch.inf, dtype=torch.float64)
        if len(finite):
            instants = torch.arange(count).repeat(len(finite))
            values = self.loss.values(instants, position_m[finite].flatten(0, 1), quat_wxyz[finite].flatten(0, 1))
            costs[finite] = values.double().cpu().view(len(finite), count).mean(1)
        return costs


def open_training(cell: Cell) -> Training:
    """Open a cell's training episode; no track of a free body is kept, and no truth is read.

    Raises:
        InputDataError: If frames, cameras or the command of a driven body are missing.
    """
    capture = Capture.open(cell.capture, splits=("train",))
    model = read_model(cell.splats)
    file = model.file.model_copy(update={"contact": ContactParameters()})
    model = replace(model, file=file)
    world = world_of_model(model)
    footage = load_footage(capture, TRAIN_EPISODE, PhysConfig().image_size, cell.device)
    drives = commands(world, capture, TRAIN_EPISODE, capture.tracks(TRAIN_EPISODE))
    position, quat = kinematic_poses(world, drives, footage.times_s)
    return Training(model, world, ImageLoss(model, footage, world.free), drives, position, quat)


def find_poses(training: Training, cell: Cell) -> PoseTrack:
    """Return the poses at every instant, found in the images by `cgwm fit`'s own tracker.

    Raises:
        NotConvergedError: If the body is found in fewer than half of the instants.
    """
    coarse = small_pictures(training, cell).loss
    return PoseTracker(coarse, training.loss, training.position_m, training.quat_wxyz).run()


def small_pictures(training: Training, cell: Cell) -> Training:
    """Return the episode with smaller pictures and fewer spheres: coarser, and cheaper to compare."""
    capture = Capture.open(cell.capture, check=False, splits=("train",))
    footage = load_footage(capture, TRAIN_EPISODE, COARSE_SIZE, cell.device)
    return replace(training, loss=ImageLoss(coarse_model(training.model), footage, training.world.free))


@dataclass(frozen=True, eq=False)
class Found:
    """What the images of the training episode show by themselves.

    observations: the track, one item, on the grid of the footage's instants, with the first one's state; noise: of the
    track (position [m], rotation [rad]); root (S, S): the factor of the covariance of the start's change, see
    `estimation.trajectory.retract`.
    """

    observations: Observations
    noise: tuple[float, float]
    root: Array

    @property
    def start(self) -> State:
        """The state at the first instant."""
        return self.observations.state


def observed(training: Training, found: PoseTrack) -> Found:
    """Return the track as observations, and the state at the first instant with its uncertainty.

    A body in flight has the state that its flight tells, one that touches something that of a straight line.
    """
    world, times = training.world, training.times_s
    position, quat = found.position_m.cpu().numpy(), found.quat_wxyz.cpu().numpy()
    tracks = {world.bodies[k].name: Track(times, position[:, k], quat[:, k]) for k in world.free}
    window = (float(times[0]) - 1e-9, float(times[-1]) + 1e-9)
    observations = Observations.of(world, [Episode(TRAIN_EPISODE, tracks | training.drives)], [window])
    seen = found.found.cpu().to(observations.seen)[None, :, None].expand_as(observations.seen)
    observations = replace(observations, seen=seen.clone(), has_orientation=seen.clone())
    observations = replace(observations, state=first_state(world, observations))  # of what was seen alone
    noise = pose_noise([found])
    span = float(times[START_FRAMES - 1] - times[0])
    spread = [std for std in (*noise, noise[0] / span, noise[1] / span) for _ in range(3)] * len(world.free)
    covariance = torch.diag(torch.tensor(spread, dtype=torch.float64).square())
    if bool(flight_frames(world, observations)[0, 0]):  # through contact it costs much, and is no better than a line
        warm = warmup_frames(world, observations, WARMUP_S)
        observations, solution = estimate_states(world, observations, warm, noise, WARMUP_ITERATIONS)
        covariance = solution.state_cov[0].cpu()
    least = torch.tensor([std**2 for std in LEAST_STD for _ in range(3)] * len(world.free), dtype=torch.float64)
    return Found(observations, noise, torch.linalg.cholesky(WIDER**2 * covariance + torch.diag(least)).numpy())


def rolled_out(world: World, start: State, drives: Mapping[str, Track], times_s: Array) -> Prediction:
    """Return the open-loop prediction of our engine.

    Raises:
        NotConvergedError: If it diverges.
    """
    with torch.no_grad():
        rollout = measure(world, start, torch.as_tensor(times_s), drives)
    return checked(rollout.position_m[0].numpy(), rollout.quat_wxyz[0].numpy())


def checked(position_m: Array, quat_wxyz: Array) -> Prediction:
    """Return a prediction of finite poses.

    Raises:
        NotConvergedError: If they are not finite.
    """
    finite = np.isfinite(position_m).all((1, 2)) & np.isfinite(quat_wxyz).all((1, 2))
    if not finite.all():
        raise NotConvergedError(f"the prediction diverges at frame {int(np.argmin(finite))} of {finite.size}.")
    return Prediction(position_m, quat_wxyz)


def starts(found: Found) -> dict[str, State]:
    """Return guesses of the state at the first instant: moving as the track does, and at rest."""
    state = found.start
    still = torch.zeros_like(state.velocity_m_s)
    return {"moving": state, "at rest": State(state.position_m, state.quat_wxyz, still, still)}

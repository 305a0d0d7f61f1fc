"""The learned rival: a small recurrent latent world model, from the same 15 frames or from 100 true trajectories.

Its first row learns from the frames of the training episode; its pose targets are what cgwm's own tracker finds in
them, and velocities the differences of those. Its second row has, as is usual for such models, many trajectories with
ground truth: the true object by MuJoCo, filmed by the splats in the cameras' exposure. Both begin a test as all
contenders do, at the true state of its first frame; the frames of that moment are rendered by the splats.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import ContactTruth, matrix_from_quat
from cgwm.datasets.synthetic.objects import SolidObject
from cgwm.pipeline.geometry.rotation import matrix_to_quat, quat_conjugate, quat_log, quat_multiply, quat_to_matrix
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseTrack
from cgwm.pipeline.phys_geo.images.video_episodes import kinematic_poses
from cgwm.pipeline.phys_geo.images.video_exposure import estimate_exposures
from cgwm.pipeline.physics.state import State
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.rendering.render import render
from cgwm.schemas import Exposure, UsageError
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from .base import TRAIN_EPISODE, Array, Cell, Prediction
from .latent_model import LatentModel, Sequences, predicted, stopwatch, train
from .training import Training, checked, find_poses, open_training
from .trajectories import Trajectory, draw_trajectories

Image = NDArray[np.uint8]

WIDTH, HEIGHT = 64, 48
TEST_FRAMES = 60
TRAJECTORIES = 100
MOST_STEPS = 20_000
FREE_STEPS = 300
"""Steps of training without a budget: for tests."""


@dataclass(frozen=True, eq=False)
class LatentPrediction(Prediction):
    """Poses, and the model's own frames by camera, uint8 RGB (F, 48, 64, 3)."""

    images: Mapping[str, Image]


@dataclass(frozen=True)
class Latent:
    """The latent world model.

    Attributes:
        name: The row's name.
        solid: Reads the true solid of a capture, to learn from trajectories with ground truth; None: to learn from the
            training episode's frames alone, without tracks and truth.
        trajectories: How many of them.
    """

    name: str
    solid: Callable[[Path], SolidObject] | None = None
    trajectories: int = TRAJECTORIES

    def fit(self, cell: Cell, budget_s: float | None) -> FittedLatent:
        """Learn until the budget is spent; poses are found in frames within it, trajectories are given.

        Raises:
            InputDataError, NotConvergedError: See `open_training` and `find_poses`.
            UsageError: If more than one body is free.
        """
        began, left = time.perf_counter(), stopwatch(budget_s)
        training = open_training(cell)
        if len(training.world.free) != 1:
            raise UsageError(f"{len(training.world.free)} free bodies; the latent model knows one.", "one.")
        cameras = Cameras.of(training, cell)
        if self.solid is None:
            data = filmed(training, find_poses(training, cell))
        else:
            data = simulated(training, cameras, cell, self.solid(cell.capture), self.trajectories)
            left = stopwatch(budget_s)
        made_s = time.perf_counter() - began
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cell.seed)
            model = LatentModel(data.images.mean((0, 1)).cpu(), data.driven_m.shape[2]).to(cell.device)
        horizon = min(TEST_FRAMES, data.images.shape[1])
        steps = FREE_STEPS if budget_s is None else MOST_STEPS
        started = time.perf_counter()
        losses = train(model, data, cell.seed, steps, left, horizon)
        trained_s = time.perf_counter() - started
        record = {
            "seconds": round(trained_s + (made_s if self.solid is None else 0.0), 2),
            "seconds_by_step": {"poses" if self.solid is None else "trajectories": round(made_s, 2),
                                "training": round(trained_s, 2)},
            "evaluations": len(losses),
            "sequences": list(data.images.shape[:2]),
            "loss": [round(float(np.mean(part)), 4) for part in (losses[:10], losses[-10:]) if part],
            "parameters": {},
        }  # fmt: skip
        return FittedLatent(partial(predicted, model.eval()), training.world, cameras, frame_s(training), record)


def simulated(training: Training, cameras: Cameras, cell: Cell, solid: SolidObject, count: int) -> Sequences:
    """Return so many trajectories of the true solid with ground truth, and what the cameras see of them."""
    true = read_truth(cell.capture).contact
    world, times = training.world, np.asarray(frame_s(training) * np.arange(TEST_FRAMES), np.float64)
    index, pushed = world.free[0], bool(training.drives)
    tip = true.friction if true.friction_fingertip is None else true.friction_fingertip
    contact = ContactTruth(
        friction=true.friction,
        friction_fingertip=tip,
        natural_time=true.natural_time_s,
        damping_ratio=true.damping_ratio,
        impedance=true.impedance,
    )
    down = -matrix_from_quat(np.asarray(training.model.file.bodies[index].photo_pose.quat_wxyz))[2]
    ways = draw_trajectories(solid, contact, down, pushed, count, times, cell.seed)
    return _stacked([_filmed_trajectory(way, world, cameras) for way in ways], cell.device)


@dataclass(frozen=True, eq=False)
class Cameras:
    """The video cameras as the model sees through them: small, without distortion, in their exposure.

    views: by name; backgrounds: what each sees of the scene alone (H, W, 3); bodies: number of each moving sphere's
    body (N,); spheres: the moving ones, each in its body's frame.
    """

    views: Mapping[str, Camera]
    exposures: Mapping[str, Exposure]
    backgrounds: Mapping[str, Tensor]
    bodies: Tensor
    spheres: Spheres

    @staticmethod
    def of(training: Training, cell: Cell) -> Cameras:
        """Prepare the cameras of the training episode."""
        capture, model = Capture.open(cell.capture, check=False, splits=("train",)), training.model
        names = [video.camera for video in training.footage.videos]
        views = {name: _small(capture.video_camera(name, TRAIN_EPISODE, 0)) for name in names}
        shown = [k for k, body in enumerate(model.file.bodies) if body.name in model.body_splats]
        parts = [Spheres.from_numpy(model.body_splats[model.file.bodies[k].name], device=cell.device) for k in shown]
        bodies = torch.cat([torch.full((len(part),), k) for k, part in zip(shown, parts, strict=True)])
        backgrounds = {}
        for name, view in views.items():
            black = torch.zeros(HEIGHT, WIDTH, 3, device=cell.device)
            if model.scene is not None:
                scene = Spheres.from_numpy(model.scene, device=cell.device)
                scene = scene.seen_from(torch.as_tensor(view.center, dtype=torch.float32, device=cell.device))
                black = _rendered(view, scene, scene.means[None])[0][0]
            backgrounds[name] = black
        exposures = estimate_exposures(model, capture, "train", cell.device)
        return Cameras(views, exposures, backgrounds, bodies.to(cell.device), Spheres.joined(parts))

    @torch.no_grad()
    def film(self, position_m: Array, quat_wxyz: Array) -> Tensor:
        """Return frames (T, 3 cameras, H, W) in [0, 1] of poses of all bodies (T, nb, ...), on the device.

        Bodies are drawn over the background, all frames at once: nothing of the scene stands before them.
        """
        like = self.spheres.means
        position, quat = (torch.as_tensor(values).to(like) for values in (position_m, quat_wxyz))
        turned = quat_to_matrix(quat)[:, self.bodies] @ like[..., None]
        means = turned.squeeze(-1) + position[:, self.bodies]
        frames = []
        for name, view in self.views.items():
            colors, alpha = _rendered(view, self.spheres, means)
            picture = (colors + (1 - alpha[..., None]) * self.backgrounds[name]).clamp(0, 1)
            exposure = self.exposures.get(name, Exposure())
            gain, offset = (torch.tensor(values).to(like) for values in (exposure.gain_rgb, exposure.offset_rgb))
            frames.append((gain * picture + offset).clamp(0, 1).permute(0, 3, 1, 2))
        return torch.cat(frames, 1)


def _rendered(view: Camera, spheres: Spheres, means: Tensor) -> tuple[Tensor, Tensor]:
    """Return colours (T, H, W, 3) and alpha (T, H, W) of spheres whose centres (T, N, 3) differ by frame."""
    viewmat, K = (torch.as_tensor(a).to(means).expand(len(means), *a.shape) for a in (view.T_cam_world, view.K))
    size = (view.width, view.height)
    picture = render(means, spheres.scales, spheres.opacities, spheres.colors, viewmat, K, *size)
    return picture.features, picture.alpha


@dataclass(frozen=True, eq=False)
class FittedLatent:
    """A trained model; frame_s: time from one of its frames to the next [s].

    ahead: returns positions (S, T, 3), rotations (S, T, 3, 3) and images (S, T, C, H, W) of sequences, open loop from
    their first frames.
    """

    ahead: Callable[[Sequences], tuple[Tensor, Tensor, Tensor]]
    world: World
    cameras: Cameras
    frame_s: float
    record: dict[str, Any]

    def predict(self, start: State, drives: Mapping[str, Track], times_s: Array) -> LatentPrediction:
        """Predict open loop from the start's state and its rendered frames; between its frames poses are interpolated.

        Raises:
            NotConvergedError: If the prediction is not finite.
        """
        index = self.world.free[0]
        count = int(np.ceil((times_s[-1] - times_s[0]) / self.frame_s - 1e-6)) + 1
        grid = times_s[0] + self.frame_s * np.arange(max(count, 2))
        every_position, every_quat = kinematic_poses(self.world, drives, grid)
        every_position[:, index], every_quat[:, index] = start.position_m[0, index], start.quat_wxyz[0, index]
        first = self.cameras.film(every_position[:1].numpy(), every_quat[:1].numpy())
        rotation = quat_to_matrix(every_quat[:, index])
        omega = rotation[0] @ start.omega_body_rad_s[0, index]
        data = Sequences(
            images=first.cpu().expand(len(grid), -1, -1, -1),
            position_m=every_position[:, index],
            rotation=rotation,
            velocity_m_s=start.velocity_m_s[:, index].expand(len(grid), 3),
            omega_world_rad_s=omega.expand(len(grid), 3),
            driven_m=every_position[:, _driven(self.world)],
            known=torch.ones(len(grid), dtype=torch.bool),
        )
        position, rotation, images = (
            values[0].cpu() for values in self.ahead(_stacked([data], self.cameras.spheres.means.device))
        )
        place, quat = _interpolated(grid, position.double(), matrix_to_quat(rotation.double()), times_s)
        position_m, quat_wxyz = (values.numpy() for values in kinematic_poses(self.world, drives, times_s))
        position_m[:, index], quat_wxyz[:, index] = place, quat
        position_m[0, index], quat_wxyz[0, index] = start.position_m[0, index], start.quat_wxyz[0, index]
        nearest = np.abs(grid[:, None] - times_s).argmin(0)
        frames = (images[nearest].permute(0, 2, 3, 1) * 255).round().to(torch.uint8).numpy()
        shown = {name: frames[..., 3 * k : 3 * k + 3] for k, name in enumerate(self.cameras.views)}
        poses = checked(position_m, quat_wxyz)
        return LatentPrediction(poses.position_m, poses.quat_wxyz, shown)


def own_psnr_db(prediction: LatentPrediction, times_s: Array, capture: Capture, episode: str) -> float:
    """Return the PSNR [dB] of the model's own frames, enlarged to the videos' size, after the first one.

    Args:
        prediction: Of the episode.
        times_s: Times of its frames [s], shape (F,).
        capture: With the episode's videos.
        episode: Its name.
    """
    ratios = []
    for camera, images in prediction.images.items():
        view = capture.video_camera(camera, episode, 0)
        frames, seen_s = capture.video_frames(camera, episode), capture.frame_times(camera, episode)
        inside = view.undistorted(np.full(frames.shape[1:3], 255, np.uint8))[0] == 255
        for frame, time_s in zip(frames[1:], seen_s[1:], strict=True):
            small = images[np.abs(times_s - time_s).argmin()]
            large = cv2.resize(small, frame.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            apart = (large.astype(np.float64) - view.undistorted(frame)[0]) / 255
            ratios.append(-10 * np.log10(max(np.square(apart)[inside].mean(), 1e-10)))
    return float(np.mean(ratios))


def filmed(training: Training, track: PoseTrack) -> Sequences:
    """Return the training episode: its frames as they are, poses and velocities as they were found in them."""
    footage, index = training.footage, training.world.free[0]
    instants = np.flatnonzero(footage.frame_at[0] >= 0)
    images = []
    for video in footage.videos:
        frames = [int(np.abs(video.times_s - time_s).argmin()) for time_s in footage.times_s[instants]]
        small = torch.nn.functional.interpolate(video.frames[frames].permute(0, 3, 1, 2), (HEIGHT, WIDTH), mode="area")
        images.append(small)
    position, quat = track.position_m[instants, index].cpu(), track.quat_wxyz[instants, index].cpu()
    times = torch.as_tensor(footage.times_s[instants])
    # central differences, at the ends to the one neighbour
    row = torch.arange(len(times))
    before, after = (row - 1).clamp_min(0), (row + 1).clamp_max(len(times) - 1)
    length = (times[after] - times[before])[:, None]
    turn = quat_log(quat_multiply(quat[after], quat_conjugate(quat[before])))
    sequence = Sequences(
        images=torch.cat(images, 1),
        position_m=position,
        rotation=quat_to_matrix(quat),
        velocity_m_s=(position[after] - position[before]) / length,
        omega_world_rad_s=turn / length,
        driven_m=training.position_m[instants][:, _driven(training.world)].cpu(),
        known=track.found[instants].cpu(),
    )
    return _stacked([sequence], training.footage.videos[0].frames.device)


def _filmed_trajectory(way: Trajectory, world: World, cameras: Cameras) -> Sequences:
    """Return a true motion with the frames that the splats give of it."""
    count, index, driven = len(way.position_m), world.free[0], _driven(world)
    position = np.zeros((count, len(world.bodies), 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, len(world.bodies), 1))
    position[:, index], quat[:, index] = way.position_m, way.quat_wxyz
    for body in driven:
        position[:, body] = way.fingertip_m
    rotation = quat_to_matrix(torch.as_tensor(way.quat_wxyz))
    omega = (rotation @ torch.as_tensor(way.omega_body_rad_s)[..., None])[..., 0]
    return Sequences(
        images=cameras.film(position, quat).cpu(),
        position_m=torch.as_tensor(way.position_m),
        rotation=rotation,
        velocity_m_s=torch.as_tensor(way.velocity_m_s),
        omega_world_rad_s=omega,
        driven_m=torch.as_tensor(position[:, driven]),
        known=torch.ones(count, dtype=torch.bool),
    )


def _stacked(rows: list[Sequences], device: torch.device | str) -> Sequences:
    """Return single sequences (T, ...) as a batch (S, T, ...), in single precision."""
    stacked = {name: torch.stack([getattr(row, name) for row in rows]).to(device) for name in vars(rows[0])}
    known = stacked.pop("known")
    return Sequences(**{name: value.float() for name, value in stacked.items()}, known=known)


def _interpolated(grid: Array, position: Tensor, quat_wxyz: Tensor, times_s: Array) -> tuple[Array, Array]:
    at = np.clip(times_s, grid[0], grid[-1])
    place = np.stack([np.interp(at, grid, position[:, axis].numpy()) for axis in range(3)], -1).astype(np.float64)
    turns = Slerp(grid, Rotation.from_quat(quat_wxyz.numpy(), scalar_first=True))(at)
    return place, turns.as_quat(scalar_first=True)


def _small(camera: Camera) -> Camera:
    return replace(camera, distortion=np.zeros(0)).resized(WIDTH, HEIGHT)


def _driven(world: World) -> list[int]:
    return [index for index, body in enumerate(world.bodies) if body.motion == "driven"]


def frame_s(training: Training) -> float:
    """Return the time from one frame of a camera to the next [s]."""
    return float(np.median(np.diff(training.footage.videos[0].times_s)))

"""Initial states, estimated by the model from the first frames of an episode and never past its first contact."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..geometry.rotation import continuous_turns, quat_to_matrix
from ..optimization.levenberg_marquardt import Solution, minimise
from ..physics.body import Body
from ..physics.chains.state import on_joints
from ..physics.contact_detection import Placed
from ..physics.smooth_distance import union_distance
from ..physics.surfaces.detection import surface_gap
from ..physics.world import World
from .observations import START_FRAMES, Observations, straight_line
from .residuals import STATE_SIZE, TrajectoryResiduals, retract, state_prior
from .rolling_start import PASSES, SPIN_LEAST_RAD_S, SPIN_SHARE, rolling_items, with_rolling
from .track_noise import Noise

MIN_FRAMES = 4
"""Minimum number of frames of the warm-up."""
FLIGHT_MARGIN_M = 0.003
"""Gap [m] that, plus three quarters of its last change, excludes a contact since the frame before."""

LINE_MISFIT = 2.0
"""Maximum mean square residual, in units of the noise variance, of frames that lie on a straight line."""
LINE_SPREAD = 2.0
"""Prior standard deviation of a velocity in contact about that of such a line, in standard errors of the line."""


HELD = 1e8
"""Information [1/rad2] that holds an orientation which nothing measured."""


def clearance(world: World, observations: Observations) -> Tensor:
    """Return the smallest measured gap (B, T) [m] of any free body to the ground, a surface or another body."""
    gaps = []
    for column, index in enumerate(observations.free):
        body = world.bodies[index]
        rotation = quat_to_matrix(observations.quat_wxyz[:, :, column])
        position = observations.position_m[:, :, column]
        if world.ground_normal is not None and world.ground_offset is not None:
            chosen = slice(None) if body.on_plane is None else body.on_plane
            along = (rotation.transpose(-1, -2) @ world.ground_normal) @ body.centers[0, chosen].T
            height = position @ world.ground_normal - world.ground_offset[0]
            gaps.append(height + (along - body.radii[0, chosen]).amin(-1))
        if observations.drives or any(other.motion == "fixed" for other in world.bodies):
            gaps += _gaps_to_bodies(world, observations, body, position[:, :, None] + body.centers[0] @ rotation.mT)
        if world.surfaces and body.radii.shape[-1]:
            gaps.append(_gap_to_surfaces(world, body, position, rotation))
    if not gaps:
        return torch.full_like(observations.times_s, torch.inf)
    return torch.stack(gaps).amin(0)


def _gaps_to_bodies(world: World, observations: Observations, body: Body, centers: Tensor) -> list[Tensor]:
    """Return the gaps (B, T) [m] of a body, its spheres at `centers` (B, T, N, 3), to each driven and fixed body."""
    gaps = []
    for name, drive in observations.drives.items():
        other = next(body for body in world.bodies if body.name == name)
        columns = []
        for frame in range(observations.times_s.shape[1]):
            pose = drive.at(observations.times_s[:, frame])
            points = pose.com[:, None] + other.centers[0] @ quat_to_matrix(pose.quat_wxyz).transpose(-1, -2)
            distance, _ = union_distance(points, centers[:, frame], body.radii.expand(len(points), -1), width=1e-3)
            columns.append((distance - other.radii).amin(-1))
        gaps.append(torch.stack(columns, 1))
    for other in world.bodies:
        if other.motion == "fixed" and other.place is not None:
            gaps.append(_gap_to_fixed(other, centers, body.radii))
    return gaps


def _gap_to_fixed(other: Body, centers: Tensor, radii: Tensor) -> Tensor:
    """Return the smallest gap (B, T) [m] of spheres (B, T, n, 3), of radii (1, n), to those of a fixed body."""
    assert other.place is not None
    place = other.place.reshape(-1, 7)[:1]
    points = place[:, None, :3] + other.centers[:1] @ quat_to_matrix(place[:, 3:]).transpose(-1, -2)
    away = torch.cdist(centers.flatten(0, -2), points[0]) - other.radii[:1]
    return (away.amin(-1).view(centers.shape[:-1]) - radii[0]).amin(-1)


def _gap_to_surfaces(world: World, body: Body, origin: Tensor, rotation: Tensor) -> Tensor:
    """Return the smallest gap (B, T) [m] of a body at origins (B, T, 3) to the fixed surfaces, as `surface_gap`."""
    placed = Placed.still(body, origin.flatten(0, 1), rotation.flatten(0, 1))
    found = [surface_gap(placed, surface) for surface in world.surfaces]
    return torch.stack(found).amin(0).view(origin.shape[:2])


def flight_frames(world: World, observations: Observations) -> Tensor:
    """Return the frames (B, T) before each item's first contact."""
    return separate_frames(world, observations).to(observations.times_s.dtype).cumprod(1) > 0


def separate_frames(world: World, observations: Observations) -> Tensor:
    """Return the frames (B, T) at which no free body touches anything, nor has since the frame before."""
    gap = clearance(world, observations)
    move = torch.zeros_like(gap)
    move[:, 1:] = gap.diff(dim=1).abs()
    return gap > FLIGHT_MARGIN_M + 0.75 * torch.nan_to_num(move, posinf=0.0)


def warmup_frames(world: World, observations: Observations, warmup_s: float) -> Tensor:
    """Return the frames (B, T) of the warm-up: its length or four frames, cut at the first contact after flight."""
    time = observations.times_s - observations.times_s[:, :1]
    measured = observations.seen.amax(-1) > 0
    early = time <= warmup_s + 1e-9
    first = measured.to(torch.int64).cumsum(1) <= MIN_FRAMES
    wanted = (early | first) & measured
    flight = flight_frames(world, observations)
    two = measured.to(torch.int64).cumsum(1) <= 2  # a velocity needs two frames, in flight or not
    return torch.where(flight[:, :1], wanted & (flight | two), wanted)


def estimate_states(
    world: World, observations: Observations, frames: Tensor, noise: Noise, iterations: int = 12
) -> tuple[Observations, Solution]:
    """Fit the states at the first frames to the chosen frames (B, T), by the model itself.

    Returns:
        The observations with the states moved to the estimate, and the solution (its state_cov is the uncertainty).
    """
    last = int(frames.any(0).nonzero().max()) + 1
    keep = frames[:, :last, None].to(observations.seen.dtype)
    warm = replace(
        observations,
        times_s=observations.times_s[:, :last],
        position_m=observations.position_m[:, :last],
        quat_wxyz=observations.quat_wxyz[:, :last],
        seen=observations.seen[:, :last] * keep,
        has_orientation=observations.has_orientation[:, :last] * keep,
    )
    rolling = rolling_items(world, warm, frames[:, :last])
    if not bool(rolling.any()):
        return _fitted_states(world, observations, warm, noise, iterations, rolling)
    for _ in range(PASSES):
        observations = with_rolling(world, observations, rolling)
        warm = replace(warm, state=observations.state)
        observations, solution = _fitted_states(world, observations, warm, noise, iterations, rolling)
    return observations, solution


def _fitted_states(
    world: World, observations: Observations, warm: Observations, noise: Noise, iterations: int, rolling: Tensor
) -> tuple[Observations, Solution]:
    """Return the observations with the states fitted to the frames of `warm`, and the solution."""
    like = world.gravity
    states = torch.zeros(len(observations.names), 12 * len(observations.free)).to(like)
    nothing = torch.zeros(0).to(like)
    solution = minimise(
        TrajectoryResiduals(world, [], warm, *noise, differences=True),
        nothing,
        states,
        torch.zeros(0, 2).to(like),
        robust_scale=5.0,
        iterations=iterations,
        prior_information=_information(world, warm, noise, rolling),
    )
    moved = on_joints(world, retract(observations.state, solution.states, observations.free))
    return replace(observations, state=moved), solution


def _information(world: World, warm: Observations, noise: Noise, rolling: Tensor) -> Tensor:
    """Return the information (B, S) of the prior on state changes, tighter for a body in contact that moves evenly.

    Contact removes a velocity at once, so that later frames do not determine it: the fit would use it to follow the
    noise of the first frame, and a body at rest would start with a hop. Items that roll (B,) keep near their spin.
    """
    bodies = len(warm.free)
    information = state_prior(bodies).to(world.gravity).repeat(len(warm.names), 1)
    if bool(rolling.any()):
        spin = warm.state.omega_body_rad_s[rolling, warm.free[0]].norm(dim=-1)
        information[rolling, 3:6] = HELD  # a turn would turn the spin with it
        information[rolling, 9:12] = (SPIN_SHARE * spin).clamp_min(SPIN_LEAST_RAD_S).pow(-2)[:, None]
    touching = clearance(world, warm)[:, 0] <= FLIGHT_MARGIN_M
    for item in touching.nonzero()[:, 0].tolist():
        for column in range(bodies):
            rolls = bool(rolling[item])
            known = warm.seen[item, :, column] * (1 if rolls else warm.has_orientation[item, :, column])
            at = torch.nonzero(known)[:START_FRAMES, 0]
            if len(at) < 3:
                continue
            t = warm.times_s[item, at] - warm.times_s[item, 0]
            measured = [warm.position_m[item, at, column] / noise.position_m]
            if not rolls:
                turn = continuous_turns(t, warm.quat_wxyz[item, at, column])
                measured.append(turn / noise.rotation_rad)
            lines = [straight_line(t, values) for values in measured]
            away = torch.stack([v - (a + t[:, None] * b) for v, (a, b) in zip(measured, lines, strict=True)])
            if float(away.square().sum()) < LINE_MISFIT * 3 * len(measured) * (len(at) - 2):
                spread = LINE_SPREAD / (t - t.mean()).square().sum().sqrt()
                first = STATE_SIZE * column + 6
                for place, sigma in zip((first, first + 3)[: len(measured)], noise, strict=False):
                    information[item, place : place + 3] += 1 / (sigma * spread).square()
    return information

"""Friction of driven bodies on the links that they push, from measured forces where they slide for sure.

Where a driven body slides along a link, the force along the slip is the friction times the force along the normal,
whatever the law of the contact along it. The path of the body and the tracks of the links have noise, and any slip,
however slow, lets Coulomb's law exert all of its friction: a body that only seems to slide would make a friction of
almost nothing. So samples count where the speed of the slip is beyond the errors of both tracks. Between pushes the
scatter counts, and for all of them the directions: those of normals vary over a surface that is made of spheres, and
the axes of a force sensor are mounted to half a degree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ....datasets.capture.tracks import Track
from ....datasets.shapes.interpolation import by_column
from ...geometry.rotation import quat_to_matrix, quat_turn
from ...physics.contact_detection import Placed, all_body_points
from ...physics.parameters import FRICTION
from ...trajectories.track_noise import estimate_noise
from .force_driven import LOADED
from .joint_tracks import JointTracks, parabola_speeds

SLIDES = 6.0
"""Speed of a slip, in standard deviations, from which on it is one: its direction is right to 1 % of the force."""
AXES_RAD = 0.01
"""Error of the angle between a force and the normal of a surface [rad]: axes of sensors, mounts and faces."""
LEAST = 3
"""Fewest samples of a push that count."""


@dataclass(frozen=True, kw_only=True)
class Sliding:
    """A driven body on a link, in one episode; K samples."""

    along: NDArray[np.float64]
    """Force along the slip [N], shape (K,)."""
    normal: NDArray[np.float64]
    """Force along the normal [N], shape (K,)."""
    std_n: float
    """Noise of a component [N]."""
    bent: float
    """Scatter of the normal along the slip [rad]."""

    @property
    def ratio(self) -> tuple[float, float]:
        """Friction and its variance by the noise alone."""
        weight = float(np.square(self.normal).sum())
        return float(self.along @ self.normal) / weight, self.std_n**2 / weight


def slip_friction(
    tracks: JointTracks, name: str, link: int, pushes: Sequence[tuple[int, Track, float]]
) -> tuple[float, float] | None:
    """Return the logarithm of the friction of a driven body on a link and its variance; None where nothing slides.

    Args:
        tracks: Joints of the links.
        name: Of the driven body.
        link: Place of the link in the chain.
        pushes: Episode, track with forces, and the noise of a component of these [N].
    """
    found = [one for push in pushes if (one := _sliding(tracks, name, link, *push)) is not None]
    if not found:
        return None
    ratios = np.array([one.ratio for one in found])
    weight = 1 / ratios[:, 1]
    mean = float((weight * ratios[:, 0]).sum() / weight.sum())
    misfit = float((weight * np.square(ratios[:, 0] - mean)).sum() / max(len(found) - 1, 1))
    bent = float(np.mean([one.bent**2 for one in found]))
    variance = max(misfit, 1.0) / float(weight.sum()) + (1 + mean**2) ** 2 * (AXES_RAD**2 + bent)
    low, high = FRICTION.bounds
    return (float(np.log(mean)), variance / mean**2) if low < mean < high else None


def _sliding(tracks: JointTracks, name: str, link: int, episode: int, track: Track, std_n: float) -> Sliding | None:
    """Return the samples of an episode at which a driven body slides for sure; None without enough of them."""
    shown = tracks.shown[episode].numpy()
    times = tracks.times_s[episode].numpy()[shown]
    assert track.force_n is not None
    if len(times) < LEAST or len(track) < LEAST:
        return None
    force = by_column(times, track.time_s, track.force_n)
    place, moved, errors = _path(track, times)
    turn = _turns(track, times)
    point, normal = _contact(tracks, name, link, episode, shown, place, turn)
    slip, std = _slips(tracks, link, episode, shown, point, moved, errors)
    if track.turns:
        spin = parabola_speeds(times, _turned(turn), np.ones_like(place))[0]
        slip = slip + np.cross(spin, point - place)
    slip = slip - (slip * normal).sum(1, keepdims=True) * normal
    speed = np.linalg.norm(slip, axis=1)
    pressed = (force * normal).sum(1)
    sure = (speed > SLIDES * std) & (pressed > LOADED * std_n)
    if sure.sum() < LEAST:
        return None
    ahead = slip[sure] / speed[sure, None]
    middle = normal[sure].mean(0)
    bent = float(np.sqrt(np.mean(np.square(((normal[sure] - middle) * ahead).sum(1)))))
    return Sliding(along=(force[sure] * ahead).sum(1), normal=pressed[sure], std_n=std_n, bent=bent)


def _path(track: Track, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return places (K, 3), speeds (K, 3) and the errors of a component of these (K,) of a driven body at times."""
    noise = estimate_noise([track]).position_m
    place = by_column(times, track.time_s, track.position_m)
    speeds, std = parabola_speeds(times, place, np.full_like(place, noise))
    return place, speeds, std[:, 0]


def _turns(track: Track, times: NDArray[np.float64]) -> Tensor:
    """Return the orientations (K, 4) of a driven body at the samples nearest to times."""
    if track.quat_wxyz is None:
        return torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(len(times), 4)
    nearest = np.abs(track.time_s[None] - times[:, None]).argmin(1)
    return torch.as_tensor(track.quat_wxyz[nearest])


def _turned(turn: Tensor) -> NDArray[np.float64]:
    """Return the rotation vectors (K, 3), world frame [rad], from the first orientation on."""
    steps = quat_turn(turn[:-1], turn[1:])
    return np.concatenate((np.zeros((1, 3)), steps.numpy().cumsum(0)))


def _contact(
    tracks: JointTracks, name: str, link: int, episode: int, shown: NDArray[np.bool_], place: NDArray, turn: Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points (K, 3) where a driven body is nearest to a link, and the normals (K, 3) from it to the link."""
    values = tracks.values[episode, torch.as_tensor(shown)]
    root = (tracks.root[:3].expand(len(values), 3), tracks.root[3:].expand(len(values), 4))
    places, turns = tracks.chain.poses(*root, values)
    bodies = {body.name: body for body in tracks.world.bodies}
    a = Placed.still(bodies[tracks.chain.links[link]], places[:, link], quat_to_matrix(turns[:, link]))
    b = Placed.still(bodies[name], torch.as_tensor(place), quat_to_matrix(turn))
    points = all_body_points(a, b)
    nearest = points.gap.argmin(1)
    every = torch.arange(len(values))
    return points.position[every, nearest].numpy(), points.normal[every, nearest].numpy()


def _slips(
    tracks: JointTracks,
    link: int,
    episode: int,
    shown: NDArray[np.bool_],
    point: NDArray[np.float64],
    moved: NDArray[np.float64],
    errors: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the speed (K, 3) of a driven body relative to a link at points, and the error (K,) of a component."""
    at = torch.as_tensor(shown)
    balance = tracks.balance
    size = tracks.values.shape[:2]
    rows = balance.rows[:, link].unflatten(0, size)[episode, at].numpy()
    origin = balance.origin[:, link].unflatten(0, size)[episode, at].numpy()
    arm = rows[:, :3] + np.cross(rows[:, 3:], (point - origin)[:, :, None], axis=1)
    speeds, std = tracks.speeds[episode, at].numpy(), tracks.speed_std[episode, at].numpy()
    slip = moved - (arm @ speeds[..., None])[..., 0]
    std = np.minimum(std, 1e9)  # where no speed is known, times 0 is 0
    return slip, np.sqrt(np.square(errors) + np.square(arm * std[:, None]).sum((1, 2)))

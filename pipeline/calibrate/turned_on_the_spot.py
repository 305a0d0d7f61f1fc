"""Whether photos were taken from one place, by a camera that only turned: they tell no depth, and no cameras.

A reconstruction of such photos may agree with every match to a twentieth of a pixel: with a wrong focal length and a
wrong lens the turns become a ring of cameras around points that no one photographed. So the matches are also explained
by turns alone, one for each pair of photos, with a focal length, two numbers of distortion and a principal point.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.optimize import least_squares

from .bundle import all_errors_px
from .consistency_check import PAIR_MIN_INLIERS
from .observation_noise import noise_px
from .reconstruction import Array, SfmModel, VerifiedPair

_MOST_PAIRS, _MATCHES = 60, 40
"""Pairs that are looked at, drawn evenly from those with many matches and with few, and matches of each."""
_FOCALS = (0.5, 0.8, 1.3, 2.0)
"""Focal lengths from which the search begins, in longer sides of the picture: one of them is near enough."""
_TIMES_NOISE = 3.0
"""Noise of matches under turns alone, in that of the model's observations, up to which they explain the photos."""
_LEAST_NOISE = 3e-4
"""Noise that counts as none, in longer sides of the picture."""
_LOSS_SCALE = 0.003
"""Scale of the loss of matches that are wrong, in longer sides."""
_LOWEST, _HIGHEST = np.array([np.log(0.3), -0.6, -0.6, -0.1, -0.1]), np.array([np.log(6.0), 0.6, 0.6, 0.1, 0.1])
"""Bounds of what a lens is: the logarithm of its focal length, two numbers of distortion, its principal point."""
_OF_PAIRS = 0.8
"""Share of the pairs that turns have to explain."""
_STEPS = 40
_MEDIAN_LENGTH = 1.67
"""Median length of the difference of two places with a noise of 1 for each coordinate: sqrt(2) sqrt(2 ln 2)."""


def turned_on_the_spot(model: SfmModel, pairs: Iterable[VerifiedPair]) -> bool:
    """Return whether turns alone explain the matches about as well as the model does.

    Args:
        model: The model; photos of several cameras are not looked at.
        pairs: Verified pairs.
    """
    camera = next(iter(model.cameras.values()))
    side = float(max(camera.width, camera.height))
    matches = _drawn(model, pairs, 0.5 * np.array([camera.width, camera.height]), side)
    if len(model.cameras) != 1 or matches is None:
        return False
    limit = max(_TIMES_NOISE * noise_px(all_errors_px(model)) / side, _LEAST_NOISE)
    return any(noise_of_turns(*matches, focal) < limit for focal in _FOCALS)


def _drawn(model: SfmModel, pairs: Iterable[VerifiedPair], middle: Array, side: float) -> tuple[Array, Array] | None:
    """Return matches of pairs in both photos, from the middle of the picture in longer sides, (pair, match, 2) each."""
    known = [pair for pair in pairs if pair.image_a in model.T_cam_world and pair.image_b in model.T_cam_world]
    used = sorted((pair for pair in known if len(pair.xy_a) >= PAIR_MIN_INLIERS), key=lambda pair: -len(pair.xy_a))
    if len(used) < len(model.T_cam_world) - 1:  # too few to tell
        return None
    used = [used[k] for k in np.unique(np.linspace(0, len(used) - 1, _MOST_PAIRS).astype(int))]
    drawn = [np.linspace(0, len(pair.xy_a) - 1, _MATCHES).astype(int) for pair in used]
    first = [(pair.xy_a[index] - middle) / side for pair, index in zip(used, drawn, strict=True)]
    second = [(pair.xy_b[index] - middle) / side for pair, index in zip(used, drawn, strict=True)]
    return np.array(first), np.array(second)


def noise_of_turns(first: Array, second: Array, focal: float) -> float:
    """Return the noise of a coordinate that turns alone leave to matches, in longer sides of the picture.

    Args:
        first: Places in the first photo of each pair from the middle, in longer sides, shape (pair, match, 2).
        second: Those in the second.
        focal: Focal length at which the search begins, in longer sides.
    """

    def residuals(lens: Array) -> Array:
        rays = [_rays(places, lens) for places in (first, second)]
        turned = rays[0] @ _turns(*rays)
        return (np.exp(lens[0]) * (turned - rays[1])).ravel()

    start = np.r_[np.log(focal), np.zeros(4)]
    found = least_squares(
        residuals, start, bounds=(_LOWEST, _HIGHEST), loss="cauchy", f_scale=_LOSS_SCALE, x_scale=0.1, max_nfev=_STEPS
    )
    by_pair = np.median(np.linalg.norm(found.fun.reshape(len(first), -1, 3), axis=2), axis=1)
    return float(np.quantile(by_pair, _OF_PAIRS)) / _MEDIAN_LENGTH


def _rays(places: Array, lens: Array) -> Array:
    """Return unit rays (pair, match, 3) through places; for the numbers of a lens see `_LOWEST`."""
    slopes = (places - lens[3:]) / np.exp(lens[0])
    square = (slopes**2).sum(-1, keepdims=True)
    slopes = slopes * (1.0 + square * (lens[1] + square * lens[2]))
    rays = np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _turns(first: Array, second: Array) -> Array:
    """Return the rotations (pair, 3, 3), to be multiplied from the right, that turn rays best into others (Kabsch)."""
    u, _, v = np.linalg.svd(np.swapaxes(first, 1, 2) @ second)
    proper = np.ones((len(u), 3))
    proper[:, 2] = np.sign(np.linalg.det(u @ v))
    return (u * proper[:, None]) @ v

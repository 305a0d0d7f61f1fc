"""Poses from masks of a body that looks the same from several sides: one choice of its sides for all episodes.

A mask does not tell a box from the same box after half a turn about one of its axes, so that each episode has poses in
body axes that are known up to such turns. What is fixed to the body, as an offset of its centre of mass, then points
another way in each episode, and looks like a force that differs from episode to episode. The turns of the episodes are
chosen with which one centre of mass falls freely in all of their flights; the first episode keeps its own, as the
turns of all together remain unknown.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import chi2

from ....datasets.capture.tracks import Episode
from ....datasets.shapes.meshes import Mesh
from ...geometry.rotation import matrix_to_quat, quat_multiply, quat_to_matrix
from ...physics.world import World
from ...trajectories.segmentation import cut_episodes, whole_episodes
from ...trajectories.track_noise import Noise

Array = NDArray[np.float64]

ALIKE = 0.02
"""Greatest distance by which a turn may miss the corners of a body that looks the same after it, as a share of its
size: one pixel of a body of fifty."""
CHANCE = 1e-6
"""Greatest probability, over all choices of turns, with which noise alone makes flights ask for other turns."""
LEFT = 0.1
"""Greatest share of what flights lack that one centre of mass may leave: of forces that have nothing to do with the
body's axes, the best choice of turns explains half and less."""
OTHER = 30.0
"""Chi-square, in units of the scatter about each flight's own centre of mass, from which on an episode has another
one: three numbers that noise moves stay below it."""
MOST = 2 / 3
"""Least share of the episodes with flights that one centre of mass explains; the others' poses are wrong."""
_ROUNDS = 50
"""Most passes over the episodes of a choice of turns; it ends when none changes, after three to five."""
WARNING = (
    "'{body}' looks the same from {sides} sides in masks: the poses of {count} of {episodes} episodes were turned so "
    "that one centre of mass explains their flights, which is known up to these turns; colours of the body in photos "
    "and videos, or a mark that changes its outline, would tell them."
)
"""Warning about turned poses."""


@dataclass(frozen=True)
class _Falls:
    """Normal equations of the centre of mass in the body frame from the flights of one episode, in units of noise."""

    matrix: Array
    """Information, shape (3, 3)."""
    vector: Array
    """Right side, shape (3,)."""
    total: float
    """Chi-square of free falls of the body frame's origin."""
    free: int
    """Degrees of freedom."""

    @property
    def own(self) -> Array:
        """Centre of mass that these flights alone ask for [m], shape (3,)."""
        return np.linalg.pinv(self.matrix) @ self.vector

    def left(self, center: Array) -> float:
        """Return chi-square with a centre of mass [m]."""
        return self.total - float(2 * self.vector @ center - center @ self.matrix @ center)


def with_alike_sides(
    world: World, episodes: Sequence[Episode], outlines: Mapping[str, Mesh], noise: Noise
) -> tuple[list[Episode], tuple[str, ...]]:
    """Return the episodes, turned where flights ask for it, and a warning if any is.

    Args:
        world: The world; only the poses of a single free body are turned.
        episodes: The episodes, whose poses were found in masks.
        outlines: Surface of each body by name, with which they were found.
        noise: Of the poses.
    """
    found = list(episodes)
    if len(world.free) != 1 or world.chains or not noise.position_m or len(found) < 2:
        return found, ()
    body = world.bodies[world.free[0]].name
    turns = alike_turns(outlines[body].vertices) if body in outlines else np.eye(3)[None]
    falls = _falls(world, found, noise) if len(turns) > 1 else {}
    chosen = _chosen(list(falls.values()), turns)
    turned = {place: turns[turn] for place, turn in zip(falls, chosen, strict=True) if turn}
    for place, turn in turned.items():
        track = found[place].tracks[body]
        if track.quat_wxyz is None:
            continue
        quat = quat_multiply(torch.as_tensor(track.quat_wxyz), matrix_to_quat(torch.as_tensor(turn))[None])
        found[place] = found[place]._replace(
            tracks=found[place].tracks | {body: replace(track, quat_wxyz=quat.numpy())}
        )
    words = {"body": body, "sides": len(turns), "count": len(turned), "episodes": len(found)}
    return found, (WARNING.format(**words),) if turned else ()


def alike_turns(corners: Array) -> Array:
    """Return the turns (G, 3, 3) about the origin after which corners (V, 3) lie where some lay, the identity first.

    Quarter and half turns about the axes of the corners' second moment are tried, and what follows from these.
    """
    axes = np.linalg.eigh(corners.T @ corners)[1]
    size = float(np.linalg.norm(corners, axis=1).max())
    found = [np.eye(3)]
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3)):
        swapped = np.zeros((3, 3))
        swapped[range(3), order] = signs
        turn = axes @ swapped @ axes.T
        missed = np.linalg.norm((corners @ turn.T)[:, None] - corners[None], axis=2).min(1).max()
        if np.linalg.det(turn) > 0 and missed < ALIKE * size and not np.allclose(turn, np.eye(3)):
            found.append(turn)
    return np.array(found)


def _falls(world: World, episodes: Sequence[Episode], noise: Noise) -> dict[int, _Falls]:
    """Return the normal equations of each episode with flights, by its place.

    The origin p of the body frame and the orientation R of a body with its centre of mass at r follow
    p + R r = a + b t + g t^2 / 2, in which a, b and r are unknown.
    """
    whole = whole_episodes(world, episodes)
    gravity = world.gravity[0].numpy()
    found: dict[int, _Falls] = {}
    for item in cut_episodes(world, whole, noise)[0]:
        frames = slice(item.first, item.last + 1)
        known = (whole.seen[item.episode, frames, 0] > 0) & (whole.has_orientation[item.episode, frames, 0] > 0)
        t = whole.times_s[item.episode, frames][known].numpy()
        if len(t) < 4:
            continue
        place = whole.position_m[item.episode, frames, 0][known].numpy() - 0.5 * gravity * t[:, None] ** 2
        turn = quat_to_matrix(whole.quat_wxyz[item.episode, frames, 0][known]).numpy().reshape(len(t), 9)
        line = np.linalg.qr(np.stack([np.ones_like(t), t - t.mean()], 1))[0]
        place, turn = ((v - line @ (line.T @ v)) / noise.position_m for v in (place, -turn))
        turn = turn.reshape(-1, 3, 3)
        before = found.get(item.episode, _Falls(np.zeros((3, 3)), np.zeros(3), 0.0, 0))
        found[item.episode] = _Falls(
            before.matrix + np.einsum("tij,tik->jk", turn, turn),
            before.vector + np.einsum("tij,ti->j", turn, place),
            before.total + float(np.square(place).sum()),
            before.free + 3 * (len(t) - 2),
        )
    return found


def _chosen(falls: Sequence[_Falls], turns: Array) -> list[int]:
    """Return the turn of each episode (E) with which one centre of mass explains their flights; 0 where none is."""
    as_found = [0] * len(falls)
    if len(falls) < 2 or len(turns) < 2:
        return as_found
    scatter = max(1.0, float(np.median([one.left(one.own) / max(one.free - 3, 1) for one in falls])))
    found = [_settled(falls, turns, one.own, OTHER * scatter) for one in falls]
    explained = [_explained([falls[k] for k in kept], turns, [c[k] for k in kept]) for c, kept in found]
    choice, kept = max(zip(found, explained, strict=True), key=lambda one: (len(one[0][1]), one[1]))[0]
    inside, best = [falls[k] for k in kept], [choice[k] for k in kept]
    if len(inside) < max(2, MOST * len(falls)):
        return as_found
    gained, total = _explained(inside, turns, best), sum(one.total for one in inside)
    more = (gained - _explained(inside, turns, [0] * len(inside))) / scatter
    chance = (len(inside) - 1) * math.log(len(turns)) + float(chi2.logsf(more, 3))
    told = chance < math.log(CHANCE) and total - gained < LEFT * total
    return _from_the_first(choice, turns) if told else as_found


def _settled(falls: Sequence[_Falls], turns: Array, center: Array, most: float) -> tuple[list[int], list[int]]:
    """Return turns (E) that suit a centre of mass, which is then found with them, until none changes.

    Args:
        falls: The flights of each episode.
        turns: The turns.
        center: The centre of mass to begin with [m].
        most: Chi-square by which a shared centre of mass may be worse than an episode's own: it is found without the
            others, whose poses are wrong.

    Returns:
        The turns, and the places of the episodes that the centre of mass explains.
    """
    before: tuple[list[int], list[int]] = [], []
    for _ in range(_ROUNDS):
        left = np.array([[one.left(turn @ center) for turn in turns] for one in falls])
        choice = left.argmin(1).tolist()
        kept = [k for k, one in enumerate(falls) if left[k].min() - one.left(one.own) < most]
        if (choice, kept) == before or not kept:
            return choice, kept
        before = choice, kept
        center = _center([falls[k] for k in kept], turns, [choice[k] for k in kept])
    return before


def _from_the_first(choice: Sequence[int], turns: Array) -> list[int]:
    """Return the same choice with body axes in which the first episode is as it was found."""
    # R_e G_e r = R_e (G_e G_0^-1) (G_0 r)
    others = turns[list(choice)] @ turns[choice[0]].T
    return [int(np.square(turns - other).sum((1, 2)).argmin()) for other in others]


def _center(falls: Sequence[_Falls], turns: Array, choice: Sequence[int]) -> Array:
    """Return the centre of mass [m] that all episodes together ask for, each with a turn."""
    matrix, vector = _joined(falls, turns, choice)
    return np.linalg.pinv(matrix) @ vector


def _joined(falls: Sequence[_Falls], turns: Array, choice: Sequence[int]) -> tuple[Array, Array]:
    """Return the normal equations of all episodes, each with a turn."""
    used = turns[list(choice)]
    matrix = sum((turn.T @ one.matrix @ turn for one, turn in zip(falls, used, strict=True)), np.zeros((3, 3)))
    vector = sum((turn.T @ one.vector for one, turn in zip(falls, used, strict=True)), np.zeros(3))
    return matrix, vector


def _explained(falls: Sequence[_Falls], turns: Array, choice: Sequence[int]) -> float:
    """Return the fall of chi-square by one centre of mass."""
    matrix, vector = _joined(falls, turns, choice)
    return float(vector @ np.linalg.pinv(matrix) @ vector)

"""Rejection of rollouts by the rules of a plan, and the loop that draws until each rollout is accepted.

A rollout's draws depend on the seed, its number and the attempt alone, so neither sharding nor batches change them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ...datasets.models.model import Model
from ...datasets.rollouts.rollouts import RolloutLabels
from ...schemas import NotConvergedError, RejectionRules
from ..geometry.viewpoint import rotation_matrix
from .plan import Extent, extent, up_direction
from .simulator import Diverged

DrawT = TypeVar("DrawT")
DIVERGED = "diverged"
"""Key under which diverged draws are counted, next to the names of the rules."""
MOST_DIVERGED = 5
"""Maximum number of diverged draws of one rollout; above it the fault is in the model, not in the draw."""
REMEDY = {
    "off_table_m": "slow the starts down, shorten the rollouts or raise off_table_m",
    "no_contact": "start lower, aim the pusher better (push_miss) or lengthen the rollouts",
    "penetration_m": "slow the starts down or raise penetration_m",
    "unrest_m_s": "lengthen the rollouts or raise unrest_m_s",
    "unseen_share": "move the cameras back (view_distance_m) or raise unseen_share",
}


@dataclass(frozen=True)
class Rejection:
    """Rejection rules of a plan, prepared for a model."""

    rules: RejectionRules
    """Rules of the plan."""
    extents: tuple[Extent, ...]
    """Bounding spheres of the bodies."""
    home_m: np.ndarray
    """Centres of the bounding spheres at the poses of the photos [m], world frame, shape (B, 3)."""
    up: np.ndarray
    """Normal of the ground, world frame, shape (3,)."""
    moved: tuple[bool, ...]
    """Whether physics moves each body: free ones, and links that a joint or a free root moves."""

    @staticmethod
    def of(model: Model, rules: RejectionRules) -> Rejection:
        """Prepare the rules for a model."""
        extents = tuple(extent(model, body) for body in model.file.bodies)
        roots = {link: model.body(one.root) for one in model.file.articulations for link in one.links}
        poses = [roots.get(body.name, body).photo_pose for body in model.file.bodies]
        home = np.array(
            [
                rotation_matrix(np.array(pose.quat_wxyz)) @ size.center_m + pose.position_m
                for pose, size in zip(poses, extents, strict=True)
            ]
        )
        moved = tuple(body.name in model.file.tracked for body in model.file.bodies)
        return Rejection(rules, extents, home, up_direction(model.file), moved)

    def reason(self, labels: RolloutLabels) -> str | None:
        """Return the name of the first rule that a rollout violates; None if it is accepted."""
        free = [index for index, moved in enumerate(self.moved) if moved]
        centers = {
            index: labels.position_m[:, index]
            + rotation_matrix(labels.quat_wxyz[:, index]) @ self.extents[index].center_m
            for index in free
        }
        rules = self.rules
        if self._leaves_table(centers):
            return "off_table_m"
        if rules.no_contact and not self._touched(labels, free):
            return "no_contact"
        if rules.penetration_m is not None and -labels.contacts.distance_m.min(initial=0.0) > rules.penetration_m:
            return "penetration_m"
        if self._moves_at_end(labels, free):
            return "unrest_m_s"
        if self._leaves_view(labels, centers):
            return "unseen_share"
        return None

    def _leaves_table(self, centers: Mapping[int, np.ndarray]) -> bool:
        """Return whether a body's centre (T, 3) [m] is ever too far, along the ground, from its place in the photos."""
        if self.rules.off_table_m is None:
            return False
        for index, center in centers.items():
            away = center - self.home_m[index]
            level = away - (away @ self.up)[:, None] * self.up
            if np.linalg.norm(level, axis=1).max() > self.rules.off_table_m:
                return True
        return False

    def _moves_at_end(self, labels: RolloutLabels, free: Sequence[int]) -> bool:
        """Return whether a point of a free body may be too fast in the last frame."""
        if self.rules.unrest_m_s is None:
            return False
        for index in free:
            spin = float(np.linalg.norm(labels.omega_body_rad_s[-1, index])) * self.extents[index].radius_m
            if np.linalg.norm(labels.velocity_m_s[-1, index]) + spin > self.rules.unrest_m_s:
                return True
        return False

    def _leaves_view(self, labels: RolloutLabels, centers: Mapping[int, np.ndarray]) -> bool:
        """Return whether the centre (T, 3) [m] of a body is outside all pictures in too many frames."""
        limit = self.rules.unseen_share
        if limit is None or not labels.cameras:
            return False
        return any(self._unseen_share(labels, center) > limit for center in centers.values())

    @staticmethod
    def _touched(labels: RolloutLabels, free: Sequence[int]) -> bool:
        a, b = labels.contacts.body_a, labels.contacts.body_b
        pushed = np.abs(labels.contacts.impulse_n_s).max(-1, initial=0.0) > 0
        driven = [index for index, motion in enumerate(labels.motions) if motion == "driven"]
        if driven:
            pair = (np.isin(a, free) & np.isin(b, driven)) | (np.isin(a, driven) & np.isin(b, free))
        else:
            pair = np.isin(a, free) | np.isin(b, free)
        return bool((pair & pushed).any())

    @staticmethod
    def _unseen_share(labels: RolloutLabels, center: np.ndarray) -> float:
        seen = np.zeros(len(center), bool)
        for camera in (labels.cameras or {}).values():
            pixels, depth = camera.project(center)
            inside = (pixels >= 0).all(1) & (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height)
            seen |= (depth > 0) & inside
        return float(1.0 - seen.mean())


def accepted_rollouts(
    indices: Sequence[int],
    draw: Callable[[int, int], DrawT],
    simulate: Callable[[Sequence[DrawT]], Sequence[RolloutLabels | Diverged]],
    reason: Callable[[RolloutLabels], str | None],
    attempts: int,
    rejected: Counter[str],
) -> Iterator[tuple[DrawT, RolloutLabels]]:
    """Yield the accepted rollout of each number, in order; rejected rollouts of the batch are drawn again.

    Args:
        indices: Global numbers of the rollouts of a batch.
        draw: Function that draws the rollout of a number at an attempt.
        simulate: Function that simulates draws, in their order.
        reason: Function that returns the name of the rule that a rollout violates, or None.
        attempts: Maximum number of draws for one rollout.
        rejected: Count of rejected draws by rule, updated in place; diverged draws count under `DIVERGED`.

    Raises:
        NotConvergedError: If all draws for a rollout are rejected, with the count by rule; or `MOST_DIVERGED` of them
            diverge, with the start of the last one.
    """
    found: dict[int, tuple[DrawT, RolloutLabels]] = {}
    broken: dict[int, Counter[str]] = {index: Counter() for index in indices}
    waiting = list(indices)
    for attempt in range(attempts):
        draws = [draw(index, attempt) for index in waiting]
        again = []
        for index, drawn, result in zip(waiting, draws, simulate(draws), strict=True):
            if isinstance(result, Diverged):
                rule = DIVERGED
                if broken[index][rule] + 1 >= min(MOST_DIVERGED, attempts):
                    raise result.error
            else:
                rule = reason(result)
                if rule is None:
                    found[index] = drawn, result
                    continue
            broken[index][rule] += 1
            rejected[rule] += 1
            again.append(index)
        waiting = again
        if not waiting:
            break
    if waiting:
        raise _exhausted(waiting[0], attempts, broken[waiting[0]])
    for index in indices:
        yield found[index]


def _exhausted(index: int, attempts: int, broken: Mapping[str, int]) -> NotConvergedError:
    counts = ", ".join(f"{rule} {count}" for rule, count in sorted(broken.items(), key=lambda item: -item[1]))
    worst = max((rule for rule in broken if rule in REMEDY), key=lambda rule: broken[rule])
    return NotConvergedError(
        f"the plan's rules rejected all {attempts} draws for rollout {index}: {counts}.",
        todo=f"{REMEDY[worst]}, under [reject].",
    )

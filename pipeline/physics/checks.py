"""Worlds, starts and rollouts that cannot be right, refused with what was found and where."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...schemas import InputDataError, NotConvergedError
from .contact import ContactLaw
from .detection import GROUND, Placed, body_points, near_body, pairs_of, plain
from .published import stable_step
from .rotation import quat_to_matrix
from .world import State, World

if TYPE_CHECKING:
    from .rollout import Rollout

DEEPEST_SHARE = 0.25
"""Bodies may begin inside each other by this share of the smaller one's radius; deeper, contact would throw them."""
TRIANGLE_TOLERANCE = 1e-6


def require_physical(world: World) -> None:
    """Check that masses, inertias, contact numbers and the step can be simulated.

    Raises:
        InputDataError: If one cannot, with the body or number, its value and the environment.
    """
    for body in world.bodies:
        if not body.free:
            continue
        _require(plain(body.mass) > 0, plain(body.mass), f"body '{body.name}': mass", "kg", "above 0 kg")
        _require(
            torch.isfinite(plain(body.inertia)).flatten(1).all(-1),
            plain(body.inertia).flatten(1).sum(-1),
            f"body '{body.name}': the sum of its inertia",
            "kg m2",
            "finite",
        )
        moments = torch.linalg.eigvalsh(plain(body.inertia))
        _require(
            moments[..., 0] > 0, moments[..., 0], f"body '{body.name}': smallest moment of inertia", "kg m2", "above 0"
        )
        excess = moments[..., 2] - moments[..., 0] - moments[..., 1]
        _require(
            excess <= TRIANGLE_TOLERANCE * moments[..., 2],
            moments[..., 2],
            f"body '{body.name}': largest moment of inertia",
            "kg m2",
            "at most the sum of the two smaller ones: no distribution of mass has more",
        )
        _require(
            (plain(body.radii) > 0).all(-1), plain(body.radii).amin(-1), f"body '{body.name}': radius", "m", "above 0"
        )
    law = world.contact
    _require(plain(law.friction) >= 0, plain(law.friction), "friction", "1", "0 or more")
    if isinstance(law, ContactLaw):
        time, ratio = plain(law.contact_time_s), plain(law.damping_ratio)
        _require(time > 0, time, "contact_time_s", "s", "above 0 s")
        _require(ratio >= 0, ratio, "damping_ratio", "1", "0 or more")
    else:
        _require(plain(law.stiffness_n_m) > 0, plain(law.stiffness_n_m), "stiffness", "N/m", "above 0 N/m")
        _require(plain(law.damping_n_s_m) >= 0, plain(law.damping_n_s_m), "damping", "N s/m", "0 or more")
    bound = largest_step(world)
    if not 0 < world.step_s <= bound:
        raise InputDataError(
            f"the step of {1e3 * world.step_s:g} ms is beyond the bound of its contacts, {1e3 * bound:.3g} ms.",
            f"a step above 0 and up to {1e3 * bound:.3g} ms.",
            "take a smaller step (--set phys-geo.step_s=...), or a softer contact.",
        )


def largest_step(world: World) -> float:
    """Return the largest step [s] that the contact law admits.

    The default law is stable at any step, since one step has the eigenvalues of the exact motion; but a contact must
    not end within the step in which it begins: h < pi tau / sqrt(1 - zeta^2) (derived; half a period). The published
    law is unstable beyond `stable_step`, taken for one contact on the lightest body: more at once bear less.
    """
    law = world.contact
    if isinstance(law, ContactLaw):
        swing = (1 - plain(law.damping_ratio).square()).clamp_min(0.0).sqrt()
        period = torch.where(swing > 0, math.pi * plain(law.contact_time_s) / swing.clamp_min(1e-12), torch.inf)
        return float(period.min())
    masses = [plain(body.mass) for body in world.bodies if body.free]
    return min((float(plain(stable_step(law, mass, law.directions)).min()) for mass in masses), default=math.inf)


def require_state(state: State, names: Sequence[str]) -> None:
    """Check that a start is finite.

    Raises:
        InputDataError: If it is not, with the environment, the body and the quantity.
    """
    for key in State.__dataclass_fields__:
        wrong = (~torch.isfinite(plain(getattr(state, key)))).any(-1).nonzero()
        if len(wrong):
            item, body = (int(k) for k in wrong[0])
            raise InputDataError(
                f"the start of environment {item}: {key} of body '{names[body]}' is not finite.",
                todo="check what the start was made from.",
            )


def require_apart(world: World, state: State, name: str | None = None) -> None:
    """Check that no two bodies, and no body and the ground, begin deep inside each other.

    Args:
        world: The world.
        state: The start.
        name: What the environment is called, where there is one; its number where left out.

    Raises:
        InputDataError: If two do, with their names, the depth and the environment.
    """
    for overlap in overlaps(world, state):
        depth, size = overlap.depth_m, overlap.size_m
        deepest = int((depth - DEEPEST_SHARE * size).argmax())
        limit = float(DEEPEST_SHARE * size[deepest])
        if float(depth[deepest]) > limit:
            raise InputDataError(
                f"{name or f'environment {deepest}'}: body '{overlap.body}' begins "
                f"{1e3 * float(depth[deepest]):.1f} mm deep inside {overlap.other}.",
                f"up to {1e3 * limit:.1f} mm; deeper, the contact would throw them apart.",
                "check the start's poses, the ground's height and the sizes of the bodies.",
            )


@dataclass(frozen=True)
class Overlap:
    """How deep a body is in another or in the ground: depth_m (B,), 0 where apart; size_m (B,): the smaller radius."""

    body: str
    other: str
    depth_m: Tensor
    size_m: Tensor


@torch.no_grad()
def overlaps(world: World, state: State) -> Iterator[Overlap]:
    """Yield how deep bodies that can touch, and bodies and the ground, are in each other."""
    rotations = quat_to_matrix(state.quat_wxyz)
    zero = torch.zeros_like(state.position_m[:, 0])
    placed = []
    for index, body in enumerate(world.bodies):
        position, rotation = state.position_m[:, index], rotations[:, index]
        com = (rotation @ body.com[..., None]).squeeze(-1) if body.free else torch.zeros_like(position)
        placed.append(Placed(body, position + com, rotation, zero, zero))
    for a, b in pairs_of(world):
        depth = _depth(world, placed[a], None if b == GROUND else placed[b])
        size = placed[a].reach if b == GROUND else torch.minimum(placed[a].reach, placed[b].reach)
        other = "the ground" if b == GROUND else f"body '{world.bodies[b].name}'"
        yield Overlap(world.bodies[a].name, other, depth, size.expand_as(depth))


def require_finite(
    rollout: Rollout, world: World, state: State, names: Sequence[str] = (), frames: Sequence[int] = ()
) -> None:
    """Check that a rollout stayed finite; where it did not, save the start so that it can be replayed.

    Args:
        rollout: The rollout.
        world: The world it was made of.
        state: The state it began in.
        names: What the environments are called; by their numbers where left out.
        frames: How many frames of each count; all where left out.

    Raises:
        NotConvergedError: If it did not, with the environment, the step and the file with its start.
    """
    poses = torch.cat((rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s), -1)
    finite = torch.isfinite(poses).flatten(2).all(-1)
    for item, count in enumerate(frames):
        finite[item, count:] = True
    wrong = (~finite).nonzero()
    if not len(wrong):
        return
    item, frame = (int(k) for k in wrong[0])
    times = rollout.times_s if rollout.times_s.ndim == 1 else rollout.times_s[min(item, len(rollout.times_s) - 1)]
    since = float(times[frame] - times[0])
    path = Path(tempfile.mkdtemp(prefix="cgwm-diverged-")) / "start.json"
    path.write_text(json.dumps(_start(state, world.body_names, item), indent=2) + "\n")
    raise NotConvergedError(
        f"{names[item] if names else f'environment {item}'} diverged by step {math.ceil(since / world.step_s - 1e-6)}, "
        f"{since:.4g} s after its start: its state is not finite. Its start is in {path}.",
        todo="fit again with a smaller step (--set phys-geo.step_s=...), or check masses, units and the sampling plan.",
    )


def _start(state: State, names: Sequence[str], item: int) -> dict[str, dict[str, list[float]]]:
    """Return the state of one environment by body."""
    fields = {key: getattr(state, key) for key in State.__dataclass_fields__}
    return {
        name: {key: values[min(item, len(values) - 1), index].tolist() for key, values in fields.items()}
        for index, name in enumerate(names)
    }


def _depth(world: World, a: Placed, b: Placed | None) -> Tensor:
    """Return how deep (B,) [m] two bodies are in each other; 0 where they are apart."""
    if b is None:
        normal, offset = world.ground_normal, world.ground_offset
        assert normal is not None and offset is not None
        return -(a.centers() @ normal - offset[:, None] - a.radii()).amin(-1).clamp_max(0.0)
    zero = torch.zeros_like(a.reference[:, 0])
    if not bool(near_body(a, b, zero).any()):
        return zero
    points = body_points(a, b, zero)
    return zero if points is None else -points.gap.amin(-1).clamp_max(0.0)


def _require(good: Tensor, values: Tensor, what: str, unit: str, allowed: str) -> None:
    good = good & torch.isfinite(values)
    if bool(good.all()):
        return
    item = int((~good).nonzero()[0, 0])
    where = f" in environment {item}" if len(values) > 1 else ""
    raise InputDataError(
        f"{what} is {float(values[item]):g} {unit}{where}.", f"{allowed}.", "correct the capture or the model."
    )

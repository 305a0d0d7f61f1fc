"""Checks of worlds and initial states before a simulation; errors name the value, the body and the environment."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from ...schemas.materials import of_pair
from ..geometry.rotation import quat_to_matrix
from .body import Body
from .chains.state import require_chains
from .contact_detection import GROUND, Placed, body_points, near_body, pairs_of, plain
from .contact_law import ContactLaw
from .pair_laws import laws_in_use
from .paper_law import PaperLaw, stable_step
from .state import State
from .surfaces.detection import surface_depth
from .world import World, called

DEEPEST_SHARE = 0.25
"""Maximum initial overlap as a share of the smaller radius; from deeper overlaps contact would throw bodies apart."""
TRIANGLE_TOLERANCE = 1e-6
"""Relative tolerance of the triangle inequality between principal moments of inertia."""


def require_physical(world: World) -> None:
    """Check that masses, inertias, contact coefficients and the step can be simulated.

    Raises:
        InputDataError: If one cannot, with the body or coefficient, its value and the environment.
    """
    check = _BodyCheck(world.source)
    for body in world.bodies:
        if body.free:
            body.once(check)
    require_chains(world)
    if world.pair_laws and not isinstance(world.contact, ContactLaw):
        raise UsageError(
            f"the contact law '{world.contact.name}' has no laws of pairs of materials.",
            "closed_form with them.",
            todo="take the pairs of materials out, or fit with closed_form.",
        )
    for pair, law in ((None, world.contact), *world.pair_laws.items()):
        _require_law(world, pair, law)
    bound = largest_step(world)
    if not 0 < world.step_s <= bound:
        raise InputDataError(
            f"{world.called('the step')} of {1e3 * world.step_s:g} ms is beyond the bound of its contacts, "
            f"{1e3 * bound:.3g} ms.",
            f"a step above 0 and up to {1e3 * bound:.3g} ms.",
            "take a smaller step (--set phys-geo.step_s=...), or a softer contact.",
        )


@dataclass(frozen=True)
class _BodyCheck:
    """Checks that mass, inertia and radii of a body can be simulated; messages name the file that they come from."""

    source: str
    """As `World.source`."""

    def __call__(self, body: Body) -> None:
        place = called(self.source, f"body '{body.name}'")
        mass, inertia, radii = plain(body.mass), plain(body.inertia), plain(body.radii)
        _require(mass > 0, mass, f"{place}: mass", "kg", "above 0 kg")
        finite = torch.isfinite(inertia).flatten(1).all(-1)
        _require(finite, inertia.flatten(1).sum(-1), f"{place}: the sum of its inertia", "kg m2", "finite")
        moments = torch.linalg.eigvalsh(inertia)
        _require(moments[..., 0] > 0, moments[..., 0], f"{place}: smallest moment of inertia", "kg m2", "above 0")
        excess = moments[..., 2] - moments[..., 0] - moments[..., 1]
        _require(
            excess <= TRIANGLE_TOLERANCE * moments[..., 2],
            moments[..., 2],
            f"{place}: largest moment of inertia",
            "kg m2",
            "at most the sum of the two smaller ones: no distribution of mass has more",
        )
        _require((radii > 0).all(-1), radii.amin(-1), f"{place}: radius", "m", "above 0")


def _require_law(world: World, pair: tuple[str, str] | None, law: ContactLaw | PaperLaw) -> None:
    friction = plain(law.friction)
    _require(friction >= 0, friction, world.called(of_pair("friction", pair)), "1", "0 or more")
    if isinstance(law, ContactLaw):
        time, ratio = plain(law.contact_time_s), plain(law.damping_ratio)
        _require(time > 0, time, world.called(of_pair("contact_time_s", pair)), "s", "above 0 s")
        _require(ratio >= 0, ratio, world.called(of_pair("damping_ratio", pair)), "1", "0 or more")
        return
    _require(plain(law.stiffness_n_m) > 0, plain(law.stiffness_n_m), world.called("stiffness"), "N/m", "above 0 N/m")
    _require(plain(law.damping_n_s_m) >= 0, plain(law.damping_n_s_m), world.called("damping"), "N s/m", "0 or more")


def largest_step(world: World) -> float:
    """Return the largest step [s] that the contact law admits.

    The default law is stable at any step, since one step has the eigenvalues of the exact motion; but a contact must
    not end within the step in which it begins: h < pi tau / sqrt(1 - zeta^2) (derived; half a period). The paper's
    law is unstable beyond `stable_step`, taken for one contact on the lightest body; several contacts at once need a
    smaller step.
    """
    return min(_largest_step(law, world) for law in laws_in_use(world).laws)


def _largest_step(law: ContactLaw | PaperLaw, world: World) -> float:
    if isinstance(law, ContactLaw):
        swing = (1 - plain(law.damping_ratio).square()).clamp_min(0.0).sqrt()
        period = torch.where(swing > 0, math.pi * plain(law.contact_time_s) / swing.clamp_min(1e-12), torch.inf)
        return float(period.min())
    masses = [plain(body.mass) for body in world.bodies if body.free]
    return min((float(plain(stable_step(law, mass, law.directions)).min()) for mass in masses), default=math.inf)


def require_state(state: State, names: Sequence[str]) -> None:
    """Check that an initial state is finite.

    Raises:
        InputDataError: If it is not, with the environment, the body and the quantity.
    """
    # a sum has one answer to wait for, and is finite only if all that it adds up is
    if bool(torch.isfinite(torch.stack([plain(part).sum() for part in state.tensors]).sum())):
        return
    for key in State.__dataclass_fields__:
        wrong = (~torch.isfinite(plain(getattr(state, key)))).any(-1).nonzero()
        if len(wrong):
            item, body = (int(k) for k in wrong[0])
            raise InputDataError(
                f"the start of environment {item}: {key} of body '{names[body]}' is not finite.",
                todo="check what the start was made from.",
            )


def require_apart(world: World, state: State, name: str | None = None) -> None:
    """Check that bodies do not begin deep inside each other or the ground.

    Args:
        world: The world.
        state: The initial state.
        name: Name of the environment in messages; its number where left out.

    Raises:
        InputDataError: If two do, with their names, the depth and the environment.
    """
    for overlap in overlaps(world, state):
        depth, size = overlap.depth_m, overlap.size_m
        deepest = int((depth - DEEPEST_SHARE * size).argmax())
        limit = float(DEEPEST_SHARE * size[deepest])
        if float(depth[deepest]) > limit:
            raise InputDataError(
                f"{name or world.called(f'environment {deepest}')}: body '{overlap.body}' begins "
                f"{1e3 * float(depth[deepest]):.1f} mm deep inside {overlap.other}.",
                f"up to {1e3 * limit:.1f} mm; deeper, the contact would throw them apart.",
                "check the start's poses, the ground's height and the sizes of the bodies.",
            )


@dataclass(frozen=True)
class Overlap:
    """Penetration of a body into another or into the ground."""

    body: str
    """Name of the body."""
    other: str
    """The other body or the ground, in words."""
    depth_m: Tensor
    """Depth [m], 0 where they are apart, shape (B,)."""
    size_m: Tensor
    """Radius of the smaller one about its reference point [m], shape (B,)."""


@torch.no_grad()
def overlaps(world: World, state: State) -> Iterator[Overlap]:
    """Yield the overlap of each pair of bodies that can touch, and of bodies with the ground and with surfaces."""
    rotations = quat_to_matrix(state.quat_wxyz)
    placed = [
        Placed.still(body, state.position_m[:, index], rotations[:, index]) for index, body in enumerate(world.bodies)
    ]
    for a, b in pairs_of(world):
        surface = world.surface(b)
        if surface is not None:
            depth = surface_depth(placed[a], surface)
        else:
            depth = _depth(world, placed[a], None if b == GROUND else placed[b])
        size = placed[a].reach if b < 0 else torch.minimum(placed[a].reach, placed[b].reach)
        yield Overlap(world.bodies[a].name, world.named(b), depth, size.expand_as(depth))


def _depth(world: World, a: Placed, b: Placed | None) -> Tensor:
    """Return the penetration depth (B,) [m] of two bodies, of a and the ground for None; 0 where they are apart."""
    if b is None:
        normal, offset = world.ground
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

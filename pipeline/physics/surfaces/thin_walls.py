"""Walls of fixed surfaces that a body could pass, and the speeds at which it does.

A sphere is pushed out of a wall by the shortest way: to where it came from only until its centre has passed the wall's
middle (derived). It reaches that depth at once if it moves so far in a step; or during an impact, since a contact
without weight that begins at speed v is at most

    v tau exp(-zeta / s atan(s / zeta)),  s = sqrt(1 - zeta^2)

deep (the free oscillator of the contact law at the end of its approach; derived; atanh and s = sqrt(zeta^2 - 1) above
zeta = 1).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from ....schemas import InputDataError
from ..contact_detection import plain
from ..contact_law import ContactLaw
from ..state import State
from ..world import World
from .fixed_surface import BOX, CYLINDER, HALF_SPACE, FixedSurface
from .surface_mesh import SurfaceMesh

_PAIRS = 4_000_000
"""Maximum number of pairs of a ray and a triangle by which a mesh's thickness is found; larger ones are sampled."""
_KEPT = 16
_SAID: set[str] = set()
"""Bodies that a warning was given of: the rollouts of a dataset are alike."""


@dataclass(frozen=True, kw_only=True)
class Wall:
    """What a body needs to pass a wall."""

    body: str
    """Name of the body."""
    number: int
    """Its index."""
    surface: FixedSurface
    """The wall."""
    depth_m: float
    """Depth of the smallest sphere at which its centre is in the middle of the wall [m]."""
    jump_m_s: float
    """Speed at which it is that deep after one step [m/s]."""
    impact_m_s: float
    """Speed of an impact at whose end it is that deep [m/s]."""


def walls(world: World) -> Iterator[Wall]:
    """Yield the walls that each moving body could pass; half spaces have no other side."""
    for a, b in world.pairs:
        surface, body = world.surface(b), world.bodies[a]
        law = world.law_of(a, b)
        if surface is None or surface.kind == HALF_SPACE or not isinstance(law, ContactLaw):
            continue
        radius = float(plain(body.radii).min())
        depth = radius + _half_thickness(surface, radius)
        share = float(_deepest(law).max())
        yield Wall(
            body=body.name, number=a, surface=surface, depth_m=depth,
            jump_m_s=depth / world.step_s, impact_m_s=depth / share,
        )  # fmt: skip


def require_thick_walls(world: World, state: State, name: str | None = None) -> None:
    """Check that no body begins so fast that a step takes it through a wall; warn where its fall may do so.

    Args:
        world: The world.
        state: The initial state.
        name: Name of the environment in messages; its number where left out.

    Raises:
        InputDataError: If one does, with body, surface, speed and depth.
    """
    weakest: dict[str, tuple[float, str]] = {}
    for wall in walls(world) if world.surfaces else ():
        speed = _speeds(world, state, wall.number)
        fastest = int(speed.argmax())
        begin, fall = float(speed[fastest]), float(_after_fall(world, state, wall, speed).max())
        place = f"{name or world.called(f'environment {fastest}')}: body '{wall.body}'"
        thick = (
            f"surface '{wall.surface.name}', whose middle its smallest sphere reaches {1e3 * wall.depth_m:.3g} mm deep"
        )
        if begin > wall.jump_m_s:
            raise InputDataError(
                f"{place} begins at {begin:.3g} m/s, {1e3 * begin * world.step_s:.3g} mm in a step: it can jump over "
                f"{thick}.",
                f"up to {wall.jump_m_s:.3g} m/s.",
                "make the wall a thicker box, take a smaller step, or begin slower.",
            )
        text = f"{place} may reach {fall:.3g} m/s, and from {wall.impact_m_s:.3g} m/s on an impact takes it through "
        text += f"{thick}. A thicker wall or a stiffer contact (a smaller contact_time_s) holds it."
        weakest[wall.body] = max(weakest.get(wall.body, (1.0, "")), (fall / wall.impact_m_s, text))
    for body, (excess, text) in weakest.items():
        if excess > 1 and body not in _SAID:
            _SAID.add(body)
            logging.getLogger("cgwm").warning("%s", text)


def thin_wall_warnings(world: World) -> list[str]:
    """Return what a fall by its own diameter takes a body through, in words."""
    gravity = float(plain(world.gravity).norm(dim=-1).max())
    found = []
    for wall in walls(world):
        body = world.bodies[wall.number]
        around = plain(body.centers).norm(dim=-1) + plain(body.radii)
        speed = (2 * gravity * 2 * float(around.max())) ** 0.5
        if speed > wall.impact_m_s:
            found.append(
                f"a fall of body '{wall.body}' by its own diameter ({speed:.3g} m/s) takes it through surface "
                f"'{wall.surface.name}': from {wall.impact_m_s:.3g} m/s on, its smallest sphere sinks "
                f"{1e3 * wall.depth_m:.3g} mm, to the wall's middle. Make the wall a thicker box."
            )
    return found


def _speeds(world: World, state: State, number: int) -> torch.Tensor:
    """Return bounds (B,) of the speeds of a body's points [m/s]."""
    body = world.bodies[number]
    reach = (plain(body.centers).norm(dim=-1) + plain(body.radii)).amax(-1)
    return (
        plain(state.velocity_m_s)[:, number].norm(dim=-1)
        + plain(state.omega_body_rad_s)[:, number].norm(dim=-1) * reach
    )


def _after_fall(world: World, state: State, wall: Wall, speed: torch.Tensor) -> torch.Tensor:
    """Return the speeds (B,) [m/s] after a fall without resistance to the lowest point of a wall."""
    low, high = (torch.as_tensor(x).to(speed) for x in _bounds(wall.surface))
    corners = torch.cartesian_prod(*torch.stack((low, high), 1))[None]
    places = wall.surface.to_world(corners) + plain(wall.surface.position)[:, None]
    lowest = (places * world.up[:, None]).sum(-1).amin(-1)
    height = (plain(state.position_m)[:, wall.number] * world.up).sum(-1) - lowest
    gravity = plain(world.gravity).norm(dim=-1)
    return (speed.square() + 2 * gravity * height.clamp_min(0.0)).sqrt()


def _bounds(surface: FixedSurface) -> np.ndarray:
    if surface.mesh is not None:
        return surface.mesh.bounds
    size = plain(surface.size)[0].cpu().numpy()
    half = size[[0, 0, 2]] if surface.kind == CYLINDER else size
    return np.stack((-half, half))


def _deepest(law: ContactLaw) -> torch.Tensor:
    """Return the depth of an impact in units of its speed [s]."""
    time, ratio = plain(law.contact_time_s), plain(law.damping_ratio).clamp_min(1e-9)
    gap = 1 - ratio.square()
    root = gap.abs().clamp_min(1e-12).sqrt()
    angle = torch.where(gap > 0, torch.atan2(root, ratio), torch.atanh((root / ratio).clamp_max(1 - 1e-12)))
    return time * torch.exp(-ratio / root * angle)


def _half_thickness(surface: FixedSurface, radius: float) -> float:
    """Return how deep the centre of a sphere may be for the way out to be the way that it came [m]."""
    size = plain(surface.size)
    if surface.kind == BOX:
        return float(size.min())
    if surface.kind == CYLINDER:
        return float(size[:, 1:].min())
    mesh = surface.mesh
    if mesh is None or not mesh.solid:
        return 0.0
    return min(0.5 * _thickness(mesh), max(radius, mesh.cell_m))  # deeper spheres are not found


@lru_cache(_KEPT)
def _thickness(mesh: SurfaceMesh) -> float:
    """Return the least thickness [m] of a solid behind the middles of its triangles; infinite without a far side."""
    a, b, c = mesh.topology.corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    inward = -normal / np.linalg.norm(normal, axis=1, keepdims=True)
    rays = np.linspace(0, len(a) - 1, max(1, min(len(a), _PAIRS // len(a)))).astype(int)
    least = np.inf
    for ray in rays:
        start, way = (a[ray] + b[ray] + c[ray]) / 3, inward[ray]
        least = min(least, _way_through(start, way, (a, b, c), float(np.linalg.norm(b[ray] - a[ray]))))
    return float(least)


def _way_through(start: np.ndarray, way: np.ndarray, corners: tuple[np.ndarray, ...], side_m: float) -> float:
    """Return the way [m] along a ray to the first triangle that it meets from inside (Moeller and Trumbore, 1997)."""
    a, b, c = corners
    across = np.cross(way, c - a)
    volume = ((b - a) * across).sum(1)
    safe = np.where(volume == 0, 1.0, volume)
    arm = start - a
    u = (arm * across).sum(1) / safe
    other = np.cross(arm, b - a)
    v, far = (other @ way) / safe, (other * (c - a)).sum(1) / safe
    meets = (volume < 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (far > 1e-9 * side_m)
    return float(far[meets].min(initial=np.inf))

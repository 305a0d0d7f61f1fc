"""Worlds for the tests of physics: a box of eight corner spheres, the same with patches, a ball."""

from dataclasses import replace

import torch
from cgwm.pipeline.physics import Body, ContactLaw, State, World
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.patch import Patch
from cgwm.pipeline.physics.smooth_distance import plane_contacts

F64 = torch.float64


def batch(value: object) -> torch.Tensor:
    return torch.as_tensor(value, dtype=F64)[None]


def law(friction: float = 0.3, contact_time_s: float = 0.004, damping_ratio: float = 0.3) -> ContactLaw:
    return ContactLaw(batch(friction), batch(contact_time_s), batch(damping_ratio))


def box_body(half: tuple[float, float, float] = (0.05, 0.04, 0.03), mass: float = 0.4, radius: float = 0.001) -> Body:
    extent = torch.tensor(half, dtype=F64)
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=F64)] * 3)
    squares = extent.square()
    inertia = torch.diag(mass / 3 * (squares.sum() - squares))
    return Body(
        name="box",
        motion="free",
        mass=batch(mass),
        inertia=inertia[None],
        com=torch.zeros(1, 3, dtype=F64),
        centers=(signs * (extent - radius))[None],
        radii=torch.full((1, 8), radius, dtype=F64),
    )


def plate_body(
    half: tuple[float, float, float],
    mass: float = 0.4,
    points: int = 12,
    radius: float = 5e-4,
    exponent: float = 0.0,
) -> Body:
    """Return a box with points spread over its faces, at least `points` each."""
    body = box_body(half, mass, radius)
    centers, radii = body.centers[0], body.radii[0]
    supports = plane_contacts(centers, radii)
    hull = Hull.of(centers, radii, supports)
    assert hull is not None
    return replace(body, on_plane=supports, hull=hull, patch=Patch.of(hull, centers, radii, points, exponent))


def ball_body(radius: float = 0.04, mass: float = 0.2, name: str = "ball", copies: int = 1) -> Body:
    inertia = 0.4 * mass * radius**2 * torch.eye(3, dtype=F64)
    centers, radii = torch.zeros(1, copies, 3, dtype=F64), torch.full((1, copies), radius, dtype=F64)
    return Body(
        name=name,
        motion="free",
        mass=batch(mass),
        inertia=inertia[None],
        com=torch.zeros(1, 3, dtype=F64),
        centers=centers,
        radii=radii,
    )


def world_of(
    *bodies: Body, contact: ContactLaw | None = None, ground: bool = True, gravity: float = 9.81, step_s: float = 0.001
) -> World:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    return World(
        bodies=bodies,
        gravity=batch([0.0, 0.0, -gravity]),
        ground_normal=up if ground else None,
        ground_offset=batch(0.0) if ground else None,
        contact=contact or law(),
        step_s=step_s,
    )


def state_of(*rows: tuple, count: int = 1) -> State:
    """Rows of (position, quat_wxyz, velocity, omega_body), one a body."""
    columns = [torch.tensor([row[k] for row in rows], dtype=F64)[None].repeat(count, 1, 1) for k in range(4)]
    columns[1] = columns[1] / columns[1].norm(dim=-1, keepdim=True)
    return State(*columns)


def times(duration_s: float, rate_hz: float = 100.0) -> torch.Tensor:
    return torch.arange(round(duration_s * rate_hz) + 1, dtype=F64) / rate_hz

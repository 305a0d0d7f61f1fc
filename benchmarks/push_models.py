"""Two models of a triangle that a finger pushes over a plane: cgwm's engine, and the ellipsoid as its limit surface.

Both return end poses for settings, so that one fit serves both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from cgwm.pipeline.physics import Body, ContactLaw, State, World
from cgwm.pipeline.physics.contact_record import ContactRecord
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.kinematic import Drive
from cgwm.pipeline.physics.patch import Patch
from cgwm.pipeline.physics.rollout import Rollout
from cgwm.pipeline.physics.smooth_distance import plane_contacts
from numpy.typing import NDArray

Array = NDArray[Any]
F64 = torch.float64

LEG_M, MASS_KG, CENTER = 0.15, 1.518, np.array([0.05, 0.05])
GRAVITY_M_S2, GROUND_FRICTION = 9.81, 0.3
"""The path of a slow push does not depend on the ground's friction, but for the moment of the finger's height."""
TIP_M, CORNER_M, THICK_M = 0.0001, 0.0005, 0.05
FACE_POINTS, STEP_S, SAMPLES = 40, 0.002, 120
FASTER = 4.0
"""By how much pushes are faster in the fits than in truth: they still stop within 0.02 mm."""


@dataclass(frozen=True)
class Pushes:
    """Pushes of one file; angles [rad], lengths [m]."""

    name: str
    """Folder of the file."""
    start: Array
    """x, y and angle of the object's frame before each push, shape (n, 3)."""
    end: Array
    """The same after it, shape (n, 3)."""
    finger: Array
    """Places of the finger at equal times, shape (n, S, 2)."""
    duration_s: float
    """Duration of a push [s]."""
    force: Array
    """Force on the object at these times [N], shape (n, S, 2)."""

    def at(self, rows: Any) -> Pushes:
        """Return some of the pushes."""
        return replace(self, **{name: getattr(self, name)[rows] for name in ("start", "end", "finger", "force")})

    @property
    def patch(self) -> bool:
        """Whether the whole triangle lies on the ground."""
        return self.name.endswith("patch")

    @property
    def supports(self) -> Array:
        """Places of the three supports from the corner [m], shape (3, 2); for a patch the triangle's corners."""
        if self.patch:
            return LEG_M * np.array([[0, 0], [1, 0], [0, 1]])
        return np.array(self.name.removeprefix("wood_").split("_"), float).reshape(2, 3).T / 1000


@dataclass(frozen=True)
class Setting:
    """A number that is fitted: its mean and standard deviation before the fit, and its bounds."""

    name: str
    mean: float
    std: float
    low: float
    high: float


FRICTION = Setting("friction of the finger", 0.4, 0.2, 0.02, 1.5)
HEIGHT = Setting("height of the finger [m]", 0.012, 0.006, 0.001, 0.04)
EXPONENT = Setting("face_exponent", 1.0, 1.5, 0.0, 10.0)
SCALE = Setting("scale of the ellipsoid's radius", 1.0, 0.3, 0.3, 2.5)


@dataclass(frozen=True)
class Model:
    """A model of pushes."""

    name: str
    settings: Callable[[Pushes], tuple[Setting, ...]]
    """What is fitted for a file; K numbers."""
    ends: Callable[..., Array]
    """End poses (C, n, 3) of pushes for settings (C, K)."""


def cgwm_ends(pushes: Pushes, settings: Array, faster: float = FASTER) -> Array:
    """Return the end poses (C, n, 3) of the engine for settings (C, 2 or 3): friction, height, exponent."""
    found = np.zeros((len(settings), len(pushes.start), 3))
    exponents = settings[:, 2] if pushes.patch else np.zeros(len(settings))
    for exponent in np.unique(exponents):
        rows = exponents == exponent
        world = world_of(pushes, settings[rows, 0], float(exponent))
        out = _rolled(world, pushes, settings[rows, 1], faster)
        found[rows] = _planar(out).reshape(int(rows.sum()), len(pushes.start), 3)
    return found


def cgwm_forces(pushes: Pushes, setting: Array) -> Array:
    """Return the mean forces of the finger (n, S - 1, 2) [N] between the samples, for one setting (2 or 3,)."""
    world = world_of(pushes, setting[:1], float(setting[2]) if pushes.patch else 0.0)
    out = _rolled(world, pushes, setting[1:2], FASTER, SAMPLES)
    contacts = out.contacts
    assert isinstance(contacts, ContactRecord)
    impulse = contacts.impulse_n_s[:, 1:, contacts.body_b == 1].sum(2).numpy()
    return impulse[..., :2] / (pushes.duration_s / FASTER / (SAMPLES - 1))


def world_of(pushes: Pushes, friction: Array, exponent: float) -> World:
    """Return the triangle on its supports, or on its face, and the finger; for each friction (C,) and push."""
    each = torch.as_tensor(np.repeat(friction, len(pushes.start)))
    foot = np.concatenate([pushes.supports - CENTER, np.full((3, 1), CORNER_M)], 1)
    base = [[x, y, z] for x, y in ((0, 0), (LEG_M, 0), (0, LEG_M)) for z in (0.002, THICK_M)]
    if pushes.patch:
        base = [corner for corner in base if corner[2] == THICK_M]
    centers = torch.as_tensor(np.concatenate([foot, np.array(base) - [*CENTER, 0.0]]))
    radii = torch.full((len(centers),), CORNER_M, dtype=F64)
    block = torch.arange(0 if pushes.patch else 3, len(centers))
    hull = Hull.of(centers, radii, block)
    assert hull is not None
    second = LEG_M**2 / 18
    one, zero = torch.ones(1, dtype=F64), torch.zeros(1, 3, dtype=F64)
    thing = Body(
        name="object",
        motion="free",
        mass=MASS_KG * one,
        inertia=MASS_KG * torch.diag(torch.tensor([second, second, 2 * second], dtype=F64))[None],
        com=zero + torch.tensor([0, 0, 0.5 * THICK_M]),
        centers=centers[None],
        radii=radii[None],
        on_plane=plane_contacts(centers, radii) if pushes.patch else torch.arange(3),
        hull=hull,
        patch=Patch.of(hull, centers, radii, FACE_POINTS, exponent) if pushes.patch else None,
        material="aluminium",
    )
    finger = Body(
        name="finger",
        motion="driven",
        mass=one,
        inertia=torch.eye(3, dtype=F64)[None],
        com=zero,
        centers=zero[None],
        radii=torch.full((1, 1), TIP_M, dtype=F64),
        material="finger",
    )
    law = ContactLaw(GROUND_FRICTION * one, 0.006 * one, 0.7 * one)
    return World(
        bodies=(thing, finger),
        gravity=torch.tensor([[0, 0, -GRAVITY_M_S2]], dtype=F64),
        ground_normal=torch.tensor([0, 0, 1.0], dtype=F64),
        ground_offset=0 * one,
        contact=law,
        step_s=STEP_S,
        pair_laws={("aluminium", "finger"): ContactLaw(each, law.contact_time_s, law.damping_ratio)},
    )


def _rolled(world: World, pushes: Pushes, height: Array, faster: float, frames: int = 2) -> Rollout:
    count, n = len(height), len(pushes.start)
    start = torch.as_tensor(np.tile(pushes.start, (count, 1)))
    c, s = start[:, 2].cos(), start[:, 2].sin()
    x = start[:, 0] + c * CENTER[0] - s * CENTER[1]
    y = start[:, 1] + s * CENTER[0] + c * CENTER[1]
    times = torch.linspace(0, pushes.duration_s / faster, SAMPLES, dtype=F64)
    track = torch.as_tensor(np.tile(pushes.finger, (count, 1, 1)))
    z = torch.as_tensor(np.repeat(height, n))[:, None, None].expand(-1, SAMPLES, 1)
    track = torch.cat((track, z), -1)
    zero, unit = torch.zeros(count * n, 3, dtype=F64), torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(count * n, 4)
    speed = track.diff(dim=1) / times.diff()[:, None]
    drive = Drive.from_velocities(times.expand(count * n, -1), track[:, 0], unit, speed, torch.zeros_like(speed))
    half = 0.5 * start[:, 2]
    state = State(
        torch.stack((torch.stack((x, y, 0 * x), -1), track[:, 0]), 1),
        torch.stack((torch.stack((half.cos(), 0 * x, 0 * x, half.sin()), -1), unit), 1),
        torch.stack((zero, zero), 1),
        torch.stack((zero, zero), 1),
    )
    return rollout(world, state, times[[0, -1]] if frames == 2 else times, {"finger": drive}, frames > 2)


def _planar(out: Rollout) -> Array:
    """Return the last pose (N, 3) of the object's frame, whose origin is the right-angled corner."""
    p, q = out.position_m[:, -1, 0].numpy(), out.quat_wxyz[:, -1, 0].numpy()
    angle = 2 * np.arctan2(q[:, 3], q[:, 0])
    c, s = np.cos(angle), np.sin(angle)
    corner = p[:, :2] - np.stack([c * CENTER[0] - s * CENTER[1], s * CENTER[0] + c * CENTER[1]], -1)
    return np.concatenate([corner, angle[:, None]], 1)


def ellipsoid_ends(pushes: Pushes, settings: Array, faster: float = FASTER) -> Array:
    """Return the end poses (C, n, 3) of a quasi-static limit surface for settings (C, 2): friction, scale.

    The twist is proportional to (f, tau / c^2), c the mean distance of the supports (of the points of a patch) from the
    centre times the scale; the finger sticks where its force lies in the friction cone, and slides at the edge of the
    cone elsewhere (Lynch et al., "Manipulation and active sensing by pushing using tactile feedback", 1992).
    """
    count, n = len(settings), len(pushes.start)
    each = np.repeat(settings, n, 0)
    radius = each[:, 1] * np.linalg.norm(_loaded(pushes) - CENTER, axis=1).mean()
    pose, path = np.tile(pushes.start, (count, 1)), np.tile(pushes.finger, (count, 1, 1))
    steps = 4
    for k in range(SAMPLES - 1):
        move = (path[:, k + 1] - path[:, k]) / steps
        for j in range(1, steps + 1):
            pose = _pushed(pose, path[:, k] + j * move, move, each[:, 0], radius)
    return pose.reshape(count, n, 3)


def _loaded(pushes: Pushes) -> Array:
    """Return where the ground carries the triangle: the supports, or the middles of 64 equal parts of the patch."""
    if not pushes.patch:
        return pushes.supports
    rows = 8
    cells = [(i, j, k) for i in range(rows) for j in range(rows - i) for k in (1, 2) if k == 1 or i + j < rows - 1]
    return np.array([[i + k / 3, j + k / 3] for i, j, k in cells]) * LEG_M / rows


def _pushed(pose: Array, tip: Array, move: Array, friction: Array, radius: Array) -> Array:
    """Move objects (n, 3) by one small step of the finger, so that it ends outside of them."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    local = _rotated(tip - pose[:, :2], c, -s)
    depth, point, normal = _nearest_edge(local)
    arm = point - CENTER
    u = _rotated(move, c, -s)
    # the finger leaves the object by the whole depth: that also corrects what earlier steps left
    u = u + (depth - (u * normal).sum(1))[:, None] * normal
    force = _solved(arm, radius, u)
    tangent = np.stack([-normal[:, 1], normal[:, 0]], 1)
    along, across = (force * normal).sum(1), (force * tangent).sum(1)
    slides = (along <= 0) | (np.abs(across) > friction * along)
    edge = normal + (friction * np.sign(across))[:, None] * tangent
    gained = (_velocity(arm, radius, edge) * normal).sum(1)
    force = np.where(slides[:, None], edge * (depth / np.maximum(gained, 1e-12))[:, None], force)
    turn = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]) / radius**2
    moved = np.concatenate(
        [_rotated(force - turn[:, None] * np.array([-CENTER[1], CENTER[0]]), c, s), turn[:, None]], 1
    )
    return np.where((depth > 0)[:, None], pose + moved, pose)


def _rotated(v: Array, c: Array, s: Array) -> Array:
    return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1]], 1)


def _velocity(arm: Array, radius: Array, force: Array) -> Array:
    turn = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]) / radius**2
    return force + turn[:, None] * np.stack([-arm[:, 1], arm[:, 0]], 1)


def _solved(arm: Array, radius: Array, velocity: Array) -> Array:
    """Return the forces (n, 2) that give the contact points the velocities (n, 2)."""
    x, y = (arm / radius[:, None]).T
    a, b, d = 1 + y * y, -x * y, 1 + x * x
    u, v = velocity.T
    return np.stack([d * u - b * v, a * v - b * u], 1) / (a * d - b * b)[:, None]


def _nearest_edge(tip: Array) -> tuple[Array, Array, Array]:
    """Return depth of the finger, its contact point and the inward normal, in the object's frame; positive inside."""
    corners = LEG_M * np.array([[0, 0], [1, 0], [0, 1]])
    found = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        length = np.linalg.norm(corners[second] - corners[first])
        edge = (corners[second] - corners[first]) / length
        inward = np.array([-edge[1], edge[0]])
        point = corners[first] + np.clip((tip - corners[first]) @ edge, 0, length)[:, None] * edge
        height = (tip - corners[first]) @ inward
        away = np.linalg.norm(tip - point, axis=1)
        beyond = np.abs(away - np.abs(height)) > 1e-9
        found.append((np.where(beyond, -away, height) + TIP_M, point, np.broadcast_to(inward, point.shape)))
    nearest = np.abs(np.stack([depth for depth, _, _ in found]) - TIP_M).argmin(0)
    rows = np.arange(len(tip))
    depth, point, normal = (np.stack(each)[nearest, rows] for each in zip(*found, strict=True))
    return depth, point, normal


CGWM = Model("cgwm", lambda pushes: (FRICTION, HEIGHT, *([EXPONENT] if pushes.patch else [])), cgwm_ends)
ELLIPSOID = Model("ellipsoid", lambda pushes: (FRICTION, SCALE), ellipsoid_ends)

"""Standard motions that show contact and can be made by hand: slides, pushes, rolls, spins on the spot, and drops."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...geometry.hull_faces import hull_faces
from ...geometry.rotation import quat_to_matrix
from ...physics.body import Body
from ...physics.impulse_solver import tangent_axes
from ...physics.state import State
from ...physics.world import World
from ...segments.contact_phases import is_round
from ...segments.impact_law import contact_law

Array = NDArray[np.float64]
Manner = Literal["slide", "turn", "push", "roll", "spin", "drop"]

MOST_AHEAD_M = 0.4
"""Maximum distance from the middle of the recorded area at which a motion along the ground begins."""
SAME_FACE = 1 - 1e-6
"""Cosine of the angle between the normals of parts of a hull that are one face."""
INSIDE = 1e-6
"""Distance from a face's edge, in sizes of the body, up to which a point counts as over the face."""
FLAT_DEG = 3
"""How flat a body has to fall on its face for the impact to tell its rebound: between rails, or from a plate that is
pulled away."""
_HEADINGS_DEG, _ASIDE_M = tuple(range(0, 360, 45)), (-0.25, 0.25)
_COMPASS = ("+x", "between +x and +y", "+y", "between +y and -x", "-x", "between -x and -y", "-y", "between -y and +x")


@dataclass(frozen=True, kw_only=True)
class HandMotion:
    """One motion with its first speeds; it begins on the ground unless it is a drop."""

    manner: Manner
    """slide: on a face, without turning; turn: the same, turning about the vertical; push: a ball that slips; roll: a
    ball; spin: on the spot, about the vertical; drop."""
    speed_m_s: float = 0.0
    """Speed along the ground [m/s]."""
    heading_deg: float = 0.0
    """Its direction [deg], from the ground's x towards y."""
    spin_rad_s: float = 0.0
    """Spin about the vertical; of a push and a drop backwards, about the horizontal across the heading [rad/s]."""
    height_m: float = 0.0
    """Height of the lowest point [m]."""
    aside_m: float = 0.0
    """How far to the left of the middle of the recorded area the path passes [m]."""
    duration_s: float = 0.8
    """Duration of the recording [s]."""

    def what(self, face: str) -> str:
        """Return the motion in words; face: name of the face that is down, empty for a ball."""
        on = f" on its face {face}" if face else ""
        towards = f"at {self.speed_m_s:.1f} m/s towards {_direction(self.heading_deg)}{self._aside}"
        flat = f" flat on its face {face}, within {FLAT_DEG} deg," if face else ""
        spin = f"{abs(self.spin_rad_s):.0f} rad/s ({abs(self.spin_rad_s) / math.tau:.1f} turns a second)"
        return {
            "slide": f"slide it{on} {towards}",
            "turn": f"slide it{on} {towards}, turning at {spin}",
            "push": f"throw it flat along the ground {towards}, with backspin of {spin}",
            "roll": f"roll it {towards}",
            "spin": f"spin it on the spot{on} at {spin}",
            "drop": f"drop it{flat} from {100 * self.height_m:.0f} cm"
            + (f", spinning about the horizontal at {spin}" if self.spin_rad_s else ""),
        }[self.manner]

    @property
    def _aside(self) -> str:
        """Where the path passes, in words; empty for the middle."""
        if not self.aside_m:
            return ""
        return f", {100 * abs(self.aside_m):.0f} cm to the {'left' if self.aside_m > 0 else 'right'} of the middle"


def hand_motions(round_body: bool) -> list[HandMotion]:
    """Return the motions to choose from, for a ball or for another body."""
    return _of_a_ball() if round_body else _of_a_box()


def _of_a_ball() -> list[HandMotion]:
    """Return rolls, spins, pushes with backspin, which slip for long, and drops without and with spin."""
    rolls = [HandMotion(manner="roll", speed_m_s=v, heading_deg=h, duration_s=1.0) for v in (0.3, 0.8) for h in (0, 90)]
    spins = [HandMotion(manner="spin", spin_rad_s=w, duration_s=1.0) for w in (15.0, 30.0)]
    pushes = [
        HandMotion(manner="push", speed_m_s=v, spin_rad_s=w, heading_deg=h)
        for v, w in ((1.5, 20.0), (2.5, 30.0))
        for h in _HEADINGS_DEG
    ]
    pushes += [
        HandMotion(manner="push", speed_m_s=2.5, spin_rad_s=30.0, heading_deg=h, aside_m=a)
        for a in _ASIDE_M
        for h in (0, 90)
    ]
    spinning = [
        HandMotion(manner="drop", height_m=h, spin_rad_s=w, duration_s=1.0) for h in (0.15, 0.6) for w in (15.0, 40.0)
    ]
    return [*rolls, *spins, *pushes, *_drops(), *spinning]


def _of_a_box() -> list[HandMotion]:
    """Return slides from several speeds, in several directions and places, turning slides, spins, and drops."""
    slides = [HandMotion(manner="slide", speed_m_s=v, heading_deg=h) for v in (0.6, 1.2, 2.0) for h in _HEADINGS_DEG]
    slides += [HandMotion(manner="slide", speed_m_s=2.0, heading_deg=h, aside_m=a) for a in _ASIDE_M for h in (0, 90)]
    turning = [HandMotion(manner="turn", speed_m_s=1.2, heading_deg=h, spin_rad_s=6.0) for h in (0, 90)]
    spins = [HandMotion(manner="spin", spin_rad_s=w) for w in (8.0, 15.0)]
    return [*slides, *turning, *spins, *_drops()]


def _drops() -> list[HandMotion]:
    return [HandMotion(manner="drop", height_m=h, duration_s=1.0) for h in (0.05, 0.15, 0.4, 0.8, 1.5)]


def start_states(world: World, body: int, motions: Sequence[HandMotion], middle_m: Tensor, like: State) -> State:
    """Return the first states (B) of motions.

    Args:
        world: World with a ground and a contact law.
        body: Index of the body.
        motions: The motions (B).
        middle_m: Point about which the recorded motions lie [m], shape (3,), world frame.
        like: State (1, nb) of the other bodies.
    """
    normal, offset = world.ground
    own, (turn, _) = world.bodies[body], face_down(world, body)
    x, y = tangent_axes(normal[None])[0, 1:]
    friction, gravity = float(contact_law(world).friction[0]), float(world.gravity[0].norm())
    matrix = quat_to_matrix(turn)
    lowest = ((own.centers[0] @ matrix.T) @ normal - own.radii[0]).min()
    rows = []
    for motion in motions:
        heading = math.radians(motion.heading_deg)
        along = math.cos(heading) * x + math.sin(heading) * y
        across = math.cos(heading) * y - math.sin(heading) * x
        reach = motion.speed_m_s * motion.duration_s
        if motion.manner != "roll":
            reach = min(reach, motion.speed_m_s**2 / max(2 * friction * gravity, 1e-9))
        place = middle_m - min(0.5 * reach, MOST_AHEAD_M) * along + motion.aside_m * across
        place = place + (offset[0] + motion.height_m - lowest - place @ normal) * normal
        spin = motion.spin_rad_s * normal
        if motion.manner in ("push", "drop"):
            spin = -motion.spin_rad_s * across
        elif motion.manner == "roll":
            spin = motion.speed_m_s / float(own.radii[0, 0]) * across
        rows.append(torch.stack((place, motion.speed_m_s * along, matrix.T @ spin)))
    position, velocity, omega = torch.stack(rows).unbind(1)
    fields = [getattr(like, key)[:1].repeat(len(motions), 1, 1) for key in State.__dataclass_fields__]
    for field, values in zip(fields, (position, turn.expand(len(motions), 4), velocity, omega), strict=True):
        field[:, body] = values
    return State(*fields)


def face_down(world: World, body: int) -> tuple[Tensor, str]:
    """Return quat_wxyz (4,) of a body that lies on its largest stable face, and the face's name.

    The faces are those of the convex hull of the spheres' centres; one is stable if the centre of mass lies over it.
    The name is the body axis that points down. A ball, and a body without such a face, stays unrotated and has no name.
    """
    own, normal = world.bodies[body], world.ground[0]
    unturned = torch.tensor([1.0, 0.0, 0.0, 0.0]).to(normal)
    out = None if is_round(own) else _largest_face(own, normal.numpy())
    if out is None:
        return unturned, ""
    down, axis = torch.as_tensor(out).to(normal), int(np.abs(out).argmax())
    name = f"{'+' if out[axis] > 0 else '-'}{'xyz'[axis]}"
    # the shortest turn that takes the face's normal to the ground's, reversed
    real = 1 - down @ normal
    if float(real) < 1e-9:
        half = torch.linalg.cross(down, torch.eye(3).to(down)[int(np.abs(out).argmin())])
        return torch.cat([torch.zeros(1).to(down), half / half.norm()]), name
    turn = torch.cat([real[None], torch.linalg.cross(down, -normal)])
    return turn / turn.norm(), name


def _largest_face(body: Body, normal: Array) -> Array | None:
    """Return the outward normal (3,) of the largest stable face of a body, body frame; None without one.

    Of faces that are equally large, the one that is turned least from the ground, whose normal (3,) is given.
    """
    points, com = body.centers[0].numpy(), body.com[0].numpy()
    hull = hull_faces(points if body.on_plane is None else points[body.on_plane])
    if not hull:
        return None
    size = float(np.ptp(points, axis=0).max())
    normals, offsets = np.array([face.normal for face in hull]), np.array([face.offset for face in hull])
    areas = np.array([face.area for face in hull])
    faces = []
    for face in hull:
        below = com - (com @ face.normal + face.offset) * face.normal
        if bool((normals @ below + offsets < INSIDE * size).all()):
            same = normals @ face.normal > SAME_FACE
            share = round(float(areas[same].sum() / areas.sum()), 2)
            faces.append((share, -float(face.normal @ normal), face.normal))
    return max(faces, key=lambda face: face[:2])[2] if faces else None


def _direction(heading_deg: float) -> str:
    """Return a direction on the ground in words."""
    eighth = heading_deg / 45.0
    return _COMPASS[round(eighth) % 8] if abs(eighth - round(eighth)) < 1e-6 else f"{heading_deg:.0f} deg from +x"

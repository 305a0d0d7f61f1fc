"""Newton's laws for the labels: changes of momentum and angular momentum against contacts, gravity and effects.

Impulses of contacts and gravity are labels. The loads of effects (drag, ...) are computed here from their formulas at
the labelled states, and integrated from frame to frame by the trapezoidal rule.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from ...datasets.models.model import Model
from ...schemas import EffectModel
from ..geometry.viewpoint import rotation_matrix
from ..physics.effects import load_effect
from ..physics.effects.registry import BUILT_IN
from ..physics.model_world import world_of_model
from ..physics.net_contact_wrench import contact_torque_n_m
from ..physics.rollout import Engine
from ..physics.state import State
from .faults import Fault
from .rollout import Rollout

IMPULSE_TOLERANCE = 1e-6
"""Largest difference between a change of momentum and the impulses, as a fraction of the largest change; it allows for
rounding of float64 sums."""
JOINTED_TOLERANCE = 0.1
"""The same for all links of a jointed body together, whose joint coordinates are advanced in steps: tosses of an elbow
differ by 0.004 in steps of 1 ms, those of lighter rods by 0.024 in steps of 2 ms."""
LEVER_SHARE = 0.25
"""Largest median, over the frames with contact, of the difference between the change of angular momentum and the
moments of the contacts, as a fraction of the sum of impulses times their levers. Contact positions in a wrong frame
give about 1, those of the demo 0.0005."""
_NEAR = 2
"""Number of frames before and after an interval in which the loads bound those within it."""
ENOUGH_FRAMES = 5
"""Minimum number of frames with contact for a median."""


@dataclass
class MotionFindings:
    """Results of the checks of motion over all rollouts."""

    impulse_excess_n_s: float = 0.0
    """Largest difference between a change of momentum and the impulses [N s]."""
    angular_excess_share: list[float] = field(default_factory=list)
    """For each body and frame in contact, the difference between the change of angular momentum and the moments of
    the contacts, as a fraction of the sum of impulses times their levers."""
    jointed_excess_share: float | None = None
    """Largest such difference of a jointed body as a whole, as a fraction of its largest change; None without any."""
    unchecked_effects: set[str] = field(default_factory=set)
    """Effects that are not built in, which are not run: the motion of rollouts with them is not checked."""


@dataclass(frozen=True, kw_only=True)
class _Body:
    """A free body over a rollout of T frames; vectors in the world frame."""

    name: str
    """Name of the body."""
    mass: float
    """Mass [kg]."""
    com: np.ndarray
    """Centre of mass [m], shape (T, 3)."""
    velocity: np.ndarray
    """Velocity of the centre of mass [m/s], shape (T, 3)."""
    spin: np.ndarray
    """Angular momentum about the centre of mass [N m s], shape (T, 3)."""
    omega: np.ndarray
    """Angular speed [rad/s], shape (T,)."""
    pull: np.ndarray
    """Acceleration by effects [m/s2], shape (T, 3)."""
    torque: np.ndarray
    """Torque by effects [N m], shape (T, 3)."""


def check_motion(rollout: Rollout, findings: MotionFindings) -> Iterator[Fault]:
    """Compare the changes of momentum and of angular momentum of every free body with its contacts.

    Args:
        rollout: The rollout, with contacts at existing frames and bodies. The formulas of its effects are those of its
            dataset's model; without it, rollouts with effects are skipped.
        findings: The results so far, which are extended.
    """
    model, effects = rollout.dataset.model, rollout.attributes.effects
    custom = {name for name in effects if name.partition("@")[0] not in BUILT_IN}
    if custom or (effects and model is None):
        findings.unchecked_effects |= custom
        return
    read, contacts, time = rollout.part("bodies"), rollout.part("contacts"), rollout.values["time"]
    frame = np.repeat(np.arange(len(time)), np.diff(contacts["offsets"]))
    turned = any(load_effect(name).has("contact") for name in effects)
    yield from _check_forces(contacts, read, time, frame)
    for index, motion in enumerate(read["motions"]):
        if motion == b"free":
            body = _body(read, index, model, effects)
            yield from _check_momentum(
                body, read["gravity"], time, _impulses(contacts, frame, index, len(time)), findings
            )
            yield from _check_spin(body, read["gravity"], time, _levers(contacts, frame, index), turned, findings)
    for one in () if model is None or effects else model.file.articulations:
        if one.base == "free" and set(one.links) <= set(rollout.bodies):
            rows = [rollout.bodies.index(link) for link in one.links]
            impulse = sum(_impulses(contacts, frame, row, len(time)) for row in rows)
            yield from _check_jointed(
                one.name,
                [_body(read, row, None, {}) for row in rows],
                read["gravity"],
                time,
                np.asarray(impulse),
                findings,
            )


def _body(read: dict[str, np.ndarray], index: int, model: Model | None, effects: dict[str, dict[str, float]]) -> _Body:
    rotation = rotation_matrix(read["quat_wxyz"][:, index])
    com, omega = read["com"][index], read["omega_body"][:, index]
    xx, yy, zz, xy, xz, yz = read["inertia"][index]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    count = len(rotation)
    pull, torque = np.zeros((count, 3)), np.zeros((count, 3))
    if effects and model is not None:
        pull, torque = _loads(read, index, model, effects)
    return _Body(
        name=read["names"][index].decode(),
        mass=float(read["mass"][index]),
        com=read["pos"][:, index] + rotation @ com,
        velocity=read["vel"][:, index] + np.einsum("tij,tj->ti", rotation, np.cross(omega, com)),
        spin=np.einsum("tij,jk,tk->ti", rotation, inertia, omega),
        omega=np.linalg.norm(omega, axis=1),
        pull=pull,
        torque=torque,
    )


def _loads(
    read: dict[str, np.ndarray], index: int, model: Model, effects: dict[str, dict[str, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return acceleration [m/s2] and torque [N m] of a body by effects at each frame, world frame, each (T, 3)."""
    bodies = [
        # the command of a driven body does not matter here
        body.model_copy(update={"motion": "fixed" if body.motion == "driven" else body.motion})
        for body in model.file.bodies
    ]
    active = tuple(EffectModel(name=name, parameters=values) for name, values in effects.items())
    file = model.file.model_copy(update={"bodies": tuple(bodies), "effects": active})
    keys = ("pos", "quat_wxyz", "vel", "omega_body")
    state = State(*(torch.as_tensor(read[key], dtype=torch.float64) for key in keys))
    times = torch.tensor([[0.0, 1.0]], dtype=torch.float64).expand(len(read["pos"]), -1)
    engine = Engine(world_of_model(replace(model, file=file)), state, times, {})
    with torch.no_grad():
        pull, torque = engine.loads(engine.begin(state))[index]
    return pull.numpy(), torque.numpy()


def _impulses(contacts: dict[str, np.ndarray], frame: np.ndarray, index: int, count: int) -> np.ndarray:
    """Return the sum of the impulses on a body since the previous frame [N s], world frame, shape (T, 3)."""
    total = np.zeros((count, 3))
    for sign, side in ((1.0, "body_a"), (-1.0, "body_b")):
        rows = contacts[side] == index
        np.add.at(total, frame[rows], sign * contacts["impulse_world"][rows])
    return total


def _levers(
    contacts: dict[str, np.ndarray], frame: np.ndarray, index: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frames (n,), positions (n, 3) [m] and impulses (n, 3) [N s] on a body of its contacts."""
    sides = [(1.0, contacts["body_a"] == index), (-1.0, contacts["body_b"] == index)]
    frames = np.concatenate([frame[rows] for _, rows in sides])
    places = np.concatenate([contacts["pos_world"][rows] for _, rows in sides])
    impulses = np.concatenate([sign * contacts["impulse_world"][rows] for sign, rows in sides])
    return frames, places, impulses


def _check_forces(
    contacts: dict[str, np.ndarray], read: dict[str, np.ndarray], time: np.ndarray, frame: np.ndarray
) -> Iterator[Fault]:
    """Check labelled forces and torques against impulses and changes of angular momentum over the time step."""
    length = np.concatenate([[np.inf], np.diff(time)])
    total = [_impulses(contacts, frame, index, len(time)) for index in range(len(read["motions"]))]
    force = np.stack(total, axis=1) / length[:, None, None]
    row_force = contacts["impulse_world"] / length[frame][:, None]
    free = read["motions"] == b"free"
    torque = contact_torque_n_m(read["quat_wxyz"], read["omega_body"], read["inertia"], time, free)
    numbers = np.arange(len(time))
    impulses, turns = "the impulses over the time between frames", "the change of angular momentum over that time"
    for name, found, expected, frames, what, unit in (
        ("contacts/force_world", contacts["force_world"], row_force, frame, impulses, "N"),
        ("bodies/contact_force", read["contact_force"], force, numbers, impulses, "N"),
        ("bodies/contact_torque", read["contact_torque"], torque, numbers, turns, "N m"),
    ):
        if not len(frames):
            continue
        errors = np.abs(found - expected).reshape(len(frames), -1).max(1)
        limit = IMPULSE_TOLERANCE * max(float(np.abs(expected).max()), 1e-12)
        if not errors.max() <= limit:
            worst = int(frames[errors.argmax()])
            text = f"{name}: frame {worst}: differs from {what} by {errors.max():.3g} {unit}."
            yield Fault(check="forces", text=text, frame=worst, value=float(errors.max()), limit=limit)


def _check_momentum(
    body: _Body, gravity: np.ndarray, time: np.ndarray, impulse: np.ndarray, findings: MotionFindings
) -> Iterator[Fault]:
    step = np.diff(time)[:, None]
    effects = 0.5 * (body.pull[1:] + body.pull[:-1])
    change = body.mass * (np.diff(body.velocity, axis=0) - step * (gravity + effects))
    excess = np.linalg.norm(change - impulse[1:], axis=1)
    scale = max(
        float(np.linalg.norm(change, axis=1).max()), float(body.mass * np.linalg.norm(gravity) * step.max()), 1e-12
    )
    bent = _bent(body.pull, np.abs(impulse[1:]).max(1) > 0)
    allowed = IMPULSE_TOLERANCE * scale + body.mass * step[:, 0] * bent
    findings.impulse_excess_n_s = max(findings.impulse_excess_n_s, float(excess.max()))
    wrong = ~(excess <= allowed)
    yield from _worst(
        "momentum",
        "contacts/impulse_world",
        body,
        "N s more than impulses, gravity and effects say",
        excess,
        allowed,
        wrong,
    )


def _check_jointed(
    name: str, links: list[_Body], gravity: np.ndarray, time: np.ndarray, impulse: np.ndarray, findings: MotionFindings
) -> Iterator[Fault]:
    """Compare the change of momentum of all links together with the impulses on them; joints pass on momentum."""
    step = np.diff(time)[:, None]
    mass = sum(link.mass for link in links)
    momentum = np.sum([link.mass * link.velocity for link in links], axis=0)
    change = np.diff(momentum, axis=0) - step * mass * gravity
    excess = np.linalg.norm(change - impulse[1:], axis=1)
    scale = max(float(np.linalg.norm(change, axis=1).max()), float(mass * np.linalg.norm(gravity) * step.max()), 1e-12)
    findings.jointed_excess_share = max(findings.jointed_excess_share or 0.0, float(excess.max()) / scale)
    allowed = np.full(len(excess), JOINTED_TOLERANCE * scale)
    whole = replace(links[0], name=name)
    than = "N s more than impulses and gravity say"
    yield from _worst("momentum", "contacts/impulse_world", whole, than, excess, allowed, ~(excess <= allowed))


def _worst(
    what: str,
    array: str,
    body: _Body,
    than: str,
    excess: np.ndarray,
    allowed: np.ndarray,
    wrong: np.ndarray,
) -> Iterator[Fault]:
    """Yield a fault for the worst of the wrong intervals (T - 1,), if any.

    Args:
        what: The quantity that changes, which names the check.
        array: The array that the fault concerns.
        body: The body.
        than: Unit of the excess and what it exceeds, in words.
        excess: Difference between the change and its causes.
        allowed: Its limit.
        wrong: Which intervals exceed the limit.
    """
    if not wrong.any():
        return
    worst = int(np.where(wrong, excess / allowed, 0).argmax())
    yield Fault(
        check=what,
        text=f"{array}: body '{body.name}', frame {worst + 1}: {what} changed by {excess[worst]:.3g} {than}; "
        f"{allowed[worst]:.2g} is allowed. Frames with this fault: {int(wrong.sum())}.",
        frame=worst + 1,
        body=body.name,
        value=float(excess[worst]),
        limit=float(allowed[worst]),
    )


def _bent(values: np.ndarray, touching: np.ndarray) -> np.ndarray:
    """Return a bound on the error of the trapezoidal rule for values (T, 3), per second of each interval (T - 1,).

    The bound is the change of the values; in intervals with contact, where an impact may hide their change, twice
    their magnitude is added. Between two frames a body may fall and rebound, and be faster there than at both: what
    counts is the largest magnitude up to `_NEAR` frames before and after.
    """
    size = np.pad(np.linalg.norm(values, axis=1), _NEAR, mode="edge")
    near = np.lib.stride_tricks.sliding_window_view(size, 2 * _NEAR + 2).max(1)
    return np.linalg.norm(np.diff(values, axis=0), axis=1) + 2 * near * touching


def _check_spin(
    body: _Body,
    gravity: np.ndarray,
    time: np.ndarray,
    levers: tuple[np.ndarray, np.ndarray, np.ndarray],
    turned: bool,
    findings: MotionFindings,
) -> Iterator[Fault]:
    """Compare the change of angular momentum about the centre of mass with the moments of the contacts.

    The labels give only the mean position of an impulse within an interval; so each lever may be wrong by the distance
    that body and contact move within the interval.
    """
    frames, places, impulses = levers
    step = np.diff(time)
    middle = 0.5 * (body.com[1:] + body.com[:-1])
    moment, reach = np.zeros((len(time), 3)), np.zeros(len(time))
    later = frames > 0
    frames, places, impulses = frames[later], places[later], impulses[later]
    arms = places - middle[frames - 1]
    np.add.at(moment, frames, np.cross(arms, impulses))
    size = np.linalg.norm(impulses, axis=1)
    np.add.at(reach, frames, size * np.linalg.norm(arms, axis=1))
    pushed = np.zeros(len(time))
    np.add.at(pushed, frames, size)
    effects = 0.5 * (body.torque[1:] + body.torque[:-1]) * step[:, None]
    excess = np.linalg.norm(np.diff(body.spin, axis=0) - effects - moment[1:], axis=1)
    speed, lever = np.linalg.norm(body.velocity, axis=1), float(np.linalg.norm(arms, axis=1).max(initial=0.0))
    fastest = np.maximum(speed[1:], speed[:-1]) + step * np.linalg.norm(gravity)
    fastest += lever * np.maximum(body.omega[1:], body.omega[:-1])
    bent = step * _bent(body.torque, pushed[1:] > 0)
    scale = max(float(np.linalg.norm(body.spin, axis=1).max()), 1e-12)
    allowed = IMPULSE_TOLERANCE * scale + bent + pushed[1:] * 2 * fastest * step
    touching = pushed[1:] > 0
    wrong = ~(excess <= allowed) & ~(touching & turned)
    yield from _worst(
        "angular momentum", "bodies/omega_body", body, "N m s more than the contacts turn it", excess, allowed, wrong
    )
    shares = excess[touching] / np.maximum(reach[1:][touching], 1e-30)
    if turned or not len(shares):
        return
    findings.angular_excess_share += shares.tolist()
    if len(shares) >= ENOUGH_FRAMES and not np.median(shares) <= LEVER_SHARE:
        yield Fault(
            check="angular momentum",
            text=f"contacts/pos_world: body '{body.name}': in half of the {len(shares)} frames with contact, the "
            f"change of angular momentum differs from the moments of the contacts by {100 * np.median(shares):.0f} % "
            f"or more of the impulses times their levers; {100 * LEVER_SHARE:.0f} % is allowed.",
            body=body.name,
            value=float(np.median(shares)),
            limit=LEVER_SHARE,
        )


def motion_facts(findings: MotionFindings) -> dict[str, Any]:
    """Return the results of the checks of motion for the report."""
    facts: dict[str, Any] = {"impulse_excess_n_s": findings.impulse_excess_n_s}
    if findings.jointed_excess_share is not None:
        facts["jointed_impulse_excess_share"] = findings.jointed_excess_share
    if findings.unchecked_effects:
        facts["motion_not_checked_with_effects"] = sorted(findings.unchecked_effects)
    if findings.angular_excess_share:
        facts["angular_excess_share_median"] = float(np.median(findings.angular_excess_share))
    return facts

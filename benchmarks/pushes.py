"""Real pushes of a triangle on hardboard and plywood (MLab_EXP): half of each file is fitted, the other half predicted.

The end pose of each push is predicted from its measured start and the finger's track. cgwm's engine and a quasi-static
limit surface (an ellipsoid) choose their settings on the same halves: the friction of the finger, its radius, and how
far the supports, or the pressure of the patch, lie from the centre. Errors are medians over the other halves.

    python benchmarks/pushes.py FOLDER [--json]

FOLDER holds one folder for each file, named by the three supports as x1_x2_x3_y1_y2_y3 [mm] or `patch`, those on
plywood with `wood_` before it.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cgwm.datasets.importers.pushes import Push, read_pushes
from cgwm.pipeline.physics import Body, ContactLaw, State, World
from cgwm.pipeline.physics.engine import rollout
from cgwm.pipeline.physics.hull import Hull
from cgwm.pipeline.physics.kinematic import Drive
from numpy.typing import NDArray
from scipy.stats import wilcoxon

Array = NDArray[Any]
F64 = torch.float64

LEG_M, MASS_KG, CENTER = 0.15, 1.518, np.array([0.05, 0.05])
GRAVITY_M_S2 = 9.81
FRICTIONS = {"hardboard": 0.282, "plywood": 0.336}
"""Friction of the ground in the code of the authors, who measured the force of steady sliding."""
FINGER_FRICTION = (0.1, 0.2, 0.3, 0.5, 0.8)
FINGER_RADIUS_M = (0.0003,)
SCALE = (0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5, 1.7)
_HEIGHT_M, _CORNER_M, _FOOT_M = 0.02, 0.0005, 0.0005
_STEP_S, _SAMPLES = 0.002, 120


@dataclass(frozen=True)
class Pushes:
    """Pushes of one file; angles [rad], lengths [m]."""

    name: str
    """Folder of the file."""
    start: Array
    """x, y and angle before each push, shape (n, 3)."""
    end: Array
    """The same after it, shape (n, 3)."""
    finger: Array
    """Places of the finger at equal times, shape (n, S, 2)."""
    duration_s: float
    """Duration of a push [s]."""
    force: Array
    """Mean force on the object in the last quarter of the stroke [N], shape (n, 2)."""

    def half(self, odd: bool) -> Pushes:
        """Return the pushes with odd numbers, counted from 0, or the others."""
        rows = slice(int(odd), None, 2)
        return Pushes(self.name, self.start[rows], self.end[rows], self.finger[rows], self.duration_s, self.force[rows])

    @property
    def supports(self) -> Array:
        """Places of the supports from the corner [m], shape (k, 2); for a patch 16 of equal areas."""
        name = self.name.removeprefix("wood_")
        if name != "patch":
            return np.array(name.split("_"), float).reshape(2, 3).T / 1000
        rows = 4
        cells = [(i, j, k) for i in range(rows) for j in range(rows - i) for k in (1, 2) if k == 1 or i + j < rows - 1]
        return np.array([[i + k / 3, j + k / 3] for i, j, k in cells]) * LEG_M / rows


def read(folder: Path) -> list[Pushes]:
    """Read the pushes of all files."""
    return [_pushes(path.parent.name, read_pushes(path)) for path in sorted(folder.glob("*/*.txt"))]


def _pushes(name: str, pushes: list[Push]) -> Pushes:
    poses = np.stack([_planar(push.object_track) for push in pushes])
    duration = float(np.median([push.finger_track.time_s[-1] - push.finger_track.time_s[0] for push in pushes]))
    finger, force = [], []
    for push in pushes:
        track = push.finger_track
        share = (track.time_s - track.time_s[0]) / (track.time_s[-1] - track.time_s[0])
        grid = np.linspace(0, 1, _SAMPLES)
        finger.append(np.stack([np.interp(grid, share, track.position_m[:, k]) for k in (0, 1)], -1))
        assert track.force_n is not None
        force.append(track.force_n[(share > 0.7) & (share < 0.95), :2].mean(0))
    return Pushes(name, poses[:, 0], poses[:, -1], np.stack(finger), duration, np.stack(force))


def _planar(track: Any) -> Array:
    q = track.quat_wxyz
    return np.stack([*track.position_m[:, :2].T, 2 * np.arctan2(q[:, 3], q[:, 0])], -1)


def errors(found: Array, pushes: Pushes) -> Array:
    """Return the errors of the centre [mm] and of the rotation [deg] of end poses (..., n, 3), shape (..., n, 2)."""

    def center(pose: Array) -> Array:
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        return pose[..., :2] + np.stack([c * CENTER[0] - s * CENTER[1], s * CENTER[0] + c * CENTER[1]], -1)

    away = np.linalg.norm(center(found) - center(pushes.end), axis=-1)
    turn = np.abs((found[..., 2] - pushes.end[..., 2] + np.pi) % (2 * np.pi) - np.pi)
    return np.stack([1e3 * away, np.degrees(turn)], -1)


def cgwm_ends(pushes: Pushes, settings: Array) -> Array:
    """Return the end poses (C, n, 3) of cgwm's engine for settings (C, 3): friction, radius, scale of the supports."""
    count, n = len(settings), len(pushes.start)
    each = torch.as_tensor(np.repeat(settings, n, 0))
    supports = torch.as_tensor(pushes.supports - CENTER)
    feet = torch.cat((each[:, 2, None, None] * supports, torch.full((len(each), len(supports), 1), _FOOT_M)), -1)
    corners = torch.tensor(
        [[x, y, z] for x, y in ((0, 0), (LEG_M, 0), (0, LEG_M)) for z in (0.001, _HEIGHT_M)], dtype=F64
    ) - torch.tensor([*CENTER, 0.0])
    hull = Hull.of(corners, torch.full((6,), _CORNER_M, dtype=F64), torch.arange(6))
    second = LEG_M**2 / 18
    inertia = MASS_KG * torch.diag(torch.tensor([second, second, 2 * second], dtype=F64))
    radii = torch.cat((torch.full((6,), _CORNER_M, dtype=F64), torch.full((len(supports),), _FOOT_M, dtype=F64)))
    one = torch.ones(1, dtype=F64)
    zero = torch.zeros(1, 3, dtype=F64)
    thing = Body(
        name="object", motion="free", mass=MASS_KG * one, inertia=inertia[None], com=zero + torch.tensor([0, 0, 0.001]),
        centers=torch.cat((corners.expand(len(each), -1, -1), feet), 1), radii=radii[None],
        on_plane=torch.arange(6, len(radii)), hull=hull, material="aluminium",
    )  # fmt: skip
    finger = Body(
        name="finger", motion="driven", mass=one, inertia=torch.eye(3, dtype=F64)[None], com=zero,
        centers=zero[None], radii=each[:, 1:2], material="finger",
    )  # fmt: skip
    law = ContactLaw(0.3 * one, 0.006 * one, 0.7 * one)
    world = World(
        bodies=(thing, finger), gravity=torch.tensor([[0, 0, -GRAVITY_M_S2]], dtype=F64),
        ground_normal=torch.tensor([0, 0, 1.0], dtype=F64), ground_offset=0 * one, contact=law, step_s=_STEP_S,
        pair_laws={("aluminium", "finger"): ContactLaw(each[:, 0], law.contact_time_s, law.damping_ratio)},
    )  # fmt: skip
    return _ends_of(world, pushes, count)


def _ends_of(world: World, pushes: Pushes, count: int) -> Array:
    n = len(pushes.start)
    start = torch.as_tensor(np.tile(pushes.start, (count, 1)))
    c, s = start[:, 2].cos(), start[:, 2].sin()
    x = start[:, 0] + c * CENTER[0] - s * CENTER[1]
    y = start[:, 1] + s * CENTER[0] + c * CENTER[1]
    times = torch.linspace(0, pushes.duration_s, _SAMPLES, dtype=F64)
    track = torch.as_tensor(np.tile(pushes.finger, (count, 1, 1)))
    track = torch.cat((track, torch.full((*track.shape[:2], 1), 0.5 * _HEIGHT_M)), -1)
    zero, unit = torch.zeros(count * n, 3, dtype=F64), torch.tensor([1.0, 0, 0, 0], dtype=F64)
    speed = track.diff(dim=1) / times.diff()[:, None]
    drive = Drive.from_velocities(
        times.expand(count * n, -1), track[:, 0], unit.expand(count * n, 4), speed, torch.zeros_like(speed)
    )
    half = 0.5 * start[:, 2]
    state = State(
        torch.stack((torch.stack((x, y, 0 * x), -1), track[:, 0]), 1),
        torch.stack((torch.stack((half.cos(), 0 * x, 0 * x, half.sin()), -1), unit.expand(count * n, 4)), 1),
        torch.stack((zero, zero), 1),
        torch.stack((zero, zero), 1),
    )
    out = rollout(world, state, times[[0, -1]], {"finger": drive})
    p, q = out.position_m[:, -1, 0].numpy(), out.quat_wxyz[:, -1, 0].numpy()
    angle = 2 * np.arctan2(q[:, 3], q[:, 0])
    c, s = np.cos(angle), np.sin(angle)
    corner = p[:, :2] - np.stack([c * CENTER[0] - s * CENTER[1], s * CENTER[0] + c * CENTER[1]], -1)
    return np.concatenate([corner, angle[:, None]], 1).reshape(count, n, 3)


def ellipsoid_ends(pushes: Pushes, settings: Array) -> Array:
    """Return the end poses (C, n, 3) of a quasi-static limit surface for settings (C, 3), as `cgwm_ends`.

    The twist is proportional to (f, tau / c^2), c the mean distance of the supports from the centre times the scale;
    the finger sticks where its force lies in the friction cone, and slides at the edge of the cone elsewhere (Lynch et
    al., "Manipulation and active sensing by pushing using tactile feedback", 1992).
    """
    count, n = len(settings), len(pushes.start)
    each = np.repeat(settings, n, 0)
    radius = each[:, 2] * np.linalg.norm(pushes.supports - CENTER, axis=1).mean()
    pose, path = np.tile(pushes.start, (count, 1)), np.tile(pushes.finger, (count, 1, 1))
    steps = 4
    for k in range(_SAMPLES - 1):
        move = (path[:, k + 1] - path[:, k]) / steps
        for j in range(1, steps + 1):
            pose = _pushed(pose, path[:, k] + j * move, move, each[:, 0], each[:, 1], radius)
    return pose.reshape(count, n, 3)


def _pushed(pose: Array, tip: Array, move: Array, friction: Array, tip_m: Array, radius: Array) -> Array:
    """Move objects (n, 3) by one small step of the finger, so that it ends outside of them."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    local = _rotated(tip - pose[:, :2], c, -s)
    depth, point, normal = _nearest_edge(local, tip_m)
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
    determinant = a * d - b * b
    return (
        np.stack([d * velocity[:, 0] - b * velocity[:, 1], a * velocity[:, 1] - b * velocity[:, 0]], 1)
        / (determinant[:, None])
    )


def _nearest_edge(tip: Array, tip_m: Array) -> tuple[Array, Array, Array]:
    """Return depth of the finger, its contact point and the inward normal, in the object's frame; positive inside."""
    corners = np.array([[0, 0], [LEG_M, 0], [0, LEG_M]])
    found = []
    for first, second in ((0, 1), (1, 2), (2, 0)):
        edge = (corners[second] - corners[first]) / np.linalg.norm(corners[second] - corners[first])
        inward = np.array([-edge[1], edge[0]])
        place = np.clip((tip - corners[first]) @ edge, 0, np.linalg.norm(corners[second] - corners[first]))
        point = corners[first] + place[:, None] * edge
        height = (tip - corners[first]) @ inward
        away = np.linalg.norm(tip - point, axis=1)
        beyond = np.abs(away - np.abs(height)) > 1e-9
        found.append((np.where(beyond, -away, height) + tip_m, point, np.broadcast_to(inward, point.shape)))
    depths = np.stack([depth for depth, _, _ in found])
    nearest = np.abs(depths - tip_m).argmin(0)
    rows = np.arange(len(tip))
    return (
        depths[nearest, rows],
        np.stack([p for _, p, _ in found])[nearest, rows],
        np.stack([n for _, _, n in found])[nearest, rows],
    )


def chosen(model: Any, pushes: Pushes) -> Array:
    """Return the settings (3,) with the least mean error, centre [mm] and rotation [deg] alike, on given pushes."""
    settings = np.array(list(product(FINGER_FRICTION, FINGER_RADIUS_M, SCALE)))
    found = errors(model(pushes, settings), pushes)
    return settings[np.median(found, 1).sum(1).argmin()]


def ground_friction(pushes: Pushes) -> tuple[float, float, float]:
    """Return friction of the ground by the measured forces: 95th percentile over m g of pushes, and its interval.

    Sliding without rotation needs the whole friction, turning less: in a patch the largest forces are those of nearly
    pure translation.
    """
    size = np.linalg.norm(pushes.force, axis=1) / (MASS_KG * GRAVITY_M_S2)
    rng = np.random.default_rng(0)
    draws = [np.percentile(rng.choice(size, len(size)), 95) for _ in range(500)]
    return float(np.percentile(size, 95)), *(float(x) for x in np.percentile(draws, [2.5, 97.5]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows, pooled = [], {"frozen": [], "ellipsoid": [], "cgwm": []}
    for pushes in read(arguments.folder):
        train, test = pushes.half(False), pushes.half(True)
        row: dict[str, Any] = {"file": pushes.name}
        found = {"frozen": errors(test.start, test)}
        for name, model in (("ellipsoid", ellipsoid_ends), ("cgwm", cgwm_ends)):
            settings = chosen(model, train)
            row[f"{name}_settings"] = settings.tolist()
            found[name] = errors(model(test, settings[None])[0], test)
        for name, values in found.items():
            pooled[name].append(values)
            row[name] = np.median(values, 0).round(3).tolist()
        row["force_friction"] = [round(x, 3) for x in ground_friction(train)]
        rows.append(row)
        print(json.dumps(row), flush=True)
    joined = {name: np.concatenate(values) for name, values in pooled.items()}
    last: dict[str, Any] = {name: np.median(values, 0).round(3).tolist() for name, values in joined.items()}
    for k, name in enumerate(("centre", "rotation")):
        test = wilcoxon(joined["cgwm"][:, k], joined["ellipsoid"][:, k])
        last[f"p_{name}"] = float(test.pvalue)
    print(json.dumps({"pooled": last}))


if __name__ == "__main__":
    main()

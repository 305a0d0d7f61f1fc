"""Initial states of a rollout, and the paths of driven bodies, drawn from a sampling plan.

Fixed values consume no random number, so a rollout keeps its draws when a plan gets another entry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ...datasets.capture.tracks import Track
from ...datasets.models.model import Model
from ...schemas import BodyModel, Distribution, NotConvergedError, SamplingPlan
from ...schemas.articulations import JointModel
from ..geometry.viewpoint import rotation_matrix
from .distributions import draw
from .plan import Extent, StartRanges, extent, horizontal_direction, up_direction
from .pusher_paths import commanded_velocity, push_track
from .supports import Supports
from .wholes import JointedStart, put_links, with_wholes

MAX_PLACEMENTS, MAX_RESTARTS = 1000, 20
"""Maximum number of draws of a body's start without overlap, and after how many parts of them all begin anew."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """Initial state of a rollout with nb bodies."""

    position_m: np.ndarray
    """Positions of the origins of the body frames [m], world frame, shape (nb, 3)."""
    quat_wxyz: np.ndarray
    """Orientations (body to world), shape (nb, 4)."""
    velocity_m_s: np.ndarray
    """Velocities of the origins of the body frames [m/s], world frame, shape (nb, 3)."""
    omega_body_rad_s: np.ndarray
    """Angular velocities [rad/s], body frame, shape (nb, 3)."""
    driven: dict[str, Track]
    """Commanded motion of each driven body, by name."""


def draw_start(model: Model, plan: SamplingPlan, duration_s: float, rng: np.random.Generator) -> Start:
    """Draw the initial state of all bodies and the motion of the driven ones.

    Free bodies, jointed ones as wholes with drawn joints, are thrown (with a drawn orientation, height, velocity and
    spin), rest as in the photos but turned about the vertical, or slide from there. Each driven body moves towards a
    randomly chosen free body.

    Args:
        model: The model with this rollout's parameters.
        plan: A resolved plan.
        duration_s: Length of the rollout [s].
        rng: Source of randomness.
    """
    if not model.file.articulations:
        return _drawn(model, plan, duration_s, rng)
    joints = _joints(model, plan, rng)
    start = _drawn(with_wholes(model, joints), plan, duration_s, rng)
    arrays = (start.position_m, start.quat_wxyz, start.velocity_m_s, start.omega_body_rad_s)
    put_links(arrays, [body.name for body in model.file.bodies], joints)
    return start


def _joints(model: Model, plan: SamplingPlan, rng: np.random.Generator) -> list[JointedStart]:
    """Draw values between the limits, or of hinges without limits any, and rates up to the plan's spin if thrown."""
    spin, found = StartRanges.of(plan).spin_rad_s, []
    for entry in model.file.articulations:
        one = JointedStart.of(entry, lambda joint: _joint_value(joint, rng))
        if plan.start == "throw":
            hinges = np.array([joint.kind == "hinge" for joint in entry.joints if joint.kind != "fixed"])
            sizes = np.array([draw(spin, rng) for _ in hinges])
            one = replace(one, speeds=np.where(hinges, sizes * rng.choice([-1.0, 1.0], len(hinges)), 0.0))
        found.append(one)
    return found


def _joint_value(joint: JointModel, rng: np.random.Generator) -> float:
    low = -math.pi if joint.lower is None else joint.lower
    high = math.pi if joint.upper is None else joint.upper
    return float(rng.uniform(low, high))


def _drawn(model: Model, plan: SamplingPlan, duration_s: float, rng: np.random.Generator) -> Start:
    """Draw the start of a model in which jointed bodies are wholes."""
    bodies = model.file.bodies
    count = len(bodies)
    start = Start(
        position_m=np.zeros((count, 3)),
        quat_wxyz=np.zeros((count, 4)),
        velocity_m_s=np.zeros((count, 3)),
        omega_body_rad_s=np.zeros((count, 3)),
        driven={},
    )
    extents = [extent(model, body) for body in bodies]
    for index, body in enumerate(bodies):
        start.position_m[index], start.quat_wxyz[index] = body.photo_pose.position_m, body.photo_pose.quat_wxyz
    free = [index for index, body in enumerate(bodies) if body.motion == "free"]
    driven = [index for index, body in enumerate(bodies) if body.motion == "driven"]
    if plan.start == "rest" and plan.offset_m == 0:
        for index in free:
            _rest(start, index, model, plan, rng)
    else:
        _place_apart(start, free, model, plan, extents, rng)
    targets = free or [index for index, body in enumerate(bodies) if body.motion == "fixed"]
    for index in driven:
        target = targets[int(rng.integers(len(targets)))]
        _push(start, index, target, model, plan, extents, duration_s, rng)
    return start


def _place_apart(
    start: Start, free: list[int], model: Model, plan: SamplingPlan, extents: list[Extent], rng: np.random.Generator
) -> None:
    """Place the free bodies one after the other; draw each again until its bounding sphere overlaps nothing.

    A thrown one keeps clear of surfaces, too. Where one finds no place among those before it, all begin anew.
    """
    supports = Supports.of(model)
    # driven bodies are placed afterwards, relative to the free ones
    still = [index for index, body in enumerate(model.file.bodies) if body.motion not in ("free", "driven", "link")]

    def placed(index: int, others: list[int]) -> bool:
        for _ in range(MAX_PLACEMENTS // MAX_RESTARTS):
            _place_one(start, index, model, plan, extents[index], rng)
            center = _center(start, index, extents[index])
            apart = all(
                np.linalg.norm(center - _center(start, other, extents[other]))
                > extents[index].radius_m + extents[other].radius_m
                for other in others
            )
            if apart and not (plan.start == "throw" and _in_surfaces(supports, center, extents[index])):
                return True
        return False

    for _ in range(MAX_RESTARTS):
        if all(placed(index, still + free[:number]) for number, index in enumerate(free)):
            return
    raise NotConvergedError(
        f"{plan.source}: no start without overlap in {MAX_PLACEMENTS} draws for {len(free)} free bodies.",
        todo="raise offset_m and height_m in the sampling plan.",
    )


def _place_one(
    start: Start, index: int, model: Model, plan: SamplingPlan, size: Extent, rng: np.random.Generator
) -> None:
    if plan.start == "throw":
        _throw(start, index, model, plan, size, rng)
    else:
        _rest(start, index, model, plan, rng)
    if plan.start == "slide":
        _slide(start, index, model, plan, size, rng)


def _in_surfaces(supports: Supports, center: np.ndarray, size: Extent) -> bool:
    """Return whether the bounding sphere of a body overlaps a surface."""
    if not supports.surfaces:
        return False
    return bool(supports.overlaps(center[None], np.zeros((1, 3)), np.array([size.radius_m])).any())


def _throw(start: Start, index: int, model: Model, plan: SamplingPlan, size: Extent, rng: np.random.Generator) -> None:
    ranges, up = StartRanges.of(plan), up_direction(model.file)
    if plan.orientation == "any":
        quat = rng.normal(size=4)
        start.quat_wxyz[index] = quat / np.linalg.norm(quat)
    else:
        start.quat_wxyz[index] = _upright(model, index, plan, rng)
    place = _place(model, index, ranges.offset_m, rng)
    gap = draw(ranges.height_m, rng)
    middle = Supports.of(model).rest_height(place, np.zeros((1, 3)), np.array([size.radius_m]))
    center = place + up * ((float(place @ up) if middle is None else middle) + gap - place @ up)
    start.position_m[index] = center - rotation_matrix(start.quat_wxyz[index]) @ size.center_m
    heading = _heading(plan.heading_deg, up, rng)
    speed, rise = draw(ranges.horizontal_speed_m_s, rng), draw(ranges.vertical_speed_m_s, rng)
    axis = rng.normal(size=3)
    start.omega_body_rad_s[index] = axis / np.linalg.norm(axis) * draw(ranges.spin_rad_s, rng)
    _launch(start, index, heading * speed + up * rise, center)


def _slide(start: Start, index: int, model: Model, plan: SamplingPlan, size: Extent, rng: np.random.Generator) -> None:
    """Draw a horizontal velocity of a resting body, and a spin about the vertical of random sign."""
    ranges, up = StartRanges.of(plan), up_direction(model.file)
    heading, speed = _heading(plan.heading_deg, up, rng), draw(ranges.horizontal_speed_m_s, rng)
    spin = draw(ranges.spin_rad_s, rng) * (1.0 if rng.random() < 0.5 else -1.0)
    start.omega_body_rad_s[index] = rotation_matrix(start.quat_wxyz[index]).T @ (up * spin)
    _launch(start, index, heading * speed, _center(start, index, size))


def _launch(start: Start, index: int, velocity: np.ndarray, center: np.ndarray) -> None:
    # The plan's velocity is that of the bounding centre, so a spin about it does not add to the throw.
    omega_world = rotation_matrix(start.quat_wxyz[index]) @ start.omega_body_rad_s[index]
    start.velocity_m_s[index] = velocity + np.cross(omega_world, start.position_m[index] - center)


def _rest(start: Start, index: int, model: Model, plan: SamplingPlan, rng: np.random.Generator) -> None:
    """Turn a body about the vertical, and lower it until a collision sphere touches the ground or a surface."""
    body, up = model.file.bodies[index], up_direction(model.file)
    start.quat_wxyz[index] = _upright(model, index, plan, rng)
    start.position_m[index] = _place(model, index, StartRanges.of(plan).offset_m, rng)
    spheres, position = model.collision[body.name], start.position_m[index]
    arms = np.asarray(spheres.means, float) @ rotation_matrix(start.quat_wxyz[index]).T
    radii = np.asarray(spheres.scales, float) * body.radius_factor
    height = Supports.of(model).rest_height(position, arms, radii)
    if height is not None:
        start.position_m[index] = position + up * (height - position @ up)


def _upright(model: Model, index: int, plan: SamplingPlan, rng: np.random.Generator) -> np.ndarray:
    """Return the orientation in the photos, turned about the vertical unless the plan keeps it."""
    photo = np.asarray(model.file.bodies[index].photo_pose.quat_wxyz, float)
    if plan.orientation == "photo":
        return photo
    turn = Rotation.from_rotvec(rng.uniform(0, 2 * math.pi) * up_direction(model.file))
    return (turn * Rotation.from_quat(photo, scalar_first=True)).as_quat(scalar_first=True)


def _place(model: Model, index: int, offset_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return a position on a horizontal disc around that in the photos [m], world frame."""
    place = np.asarray(model.file.bodies[index].photo_pose.position_m, float)
    if offset_m == 0:
        return place
    across = horizontal_direction(up_direction(model.file), rng.uniform(0, 2 * math.pi))
    return place + across * offset_m * math.sqrt(rng.random())


def _heading(angle_deg: Distribution | None, up: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a horizontal unit vector, in a uniformly random direction if the plan has no angle."""
    angle = rng.uniform(0, 2 * math.pi) if angle_deg is None else math.radians(draw(angle_deg, rng))
    return horizontal_direction(up, angle)


def _push(
    start: Start,
    index: int,
    target: int,
    model: Model,
    plan: SamplingPlan,
    extents: list[Extent],
    duration_s: float,
    rng: np.random.Generator,
) -> None:
    """Move a driven body past the target: horizontally, at constant speed, with a random miss of its centre."""
    file, up = model.file, up_direction(model.file)
    body, size, goal = file.bodies[index], extents[index], extents[target]
    heading = _heading(plan.push_heading_deg, up, rng)
    miss = rng.uniform(-1, 1) * plan.push_miss * goal.radius_m
    gap, speed = draw(plan.push_gap_m, rng), draw(plan.push_speed_m_s, rng)
    curvature = draw(plan.push_curve_1_m, rng)
    length = None if plan.push_length_m is None else draw(plan.push_length_m, rng)
    run_up = goal.radius_m + size.radius_m + gap
    aim = _center(start, target, goal) + np.cross(up, heading) * miss
    # The height in the photos, limited to above the ground and below the top of the object.
    low, _ = _heights(model, body, start.quat_wxyz[index], up)
    _, top = _heights(model, file.bodies[target], start.quat_wxyz[target], up)
    height = float(start.position_m[index] @ up)
    height = min(height, float(start.position_m[target] @ up) + 0.7 * top)
    if file.ground is not None:
        height = max(height, file.ground.offset_m - low + 1e-3)
    rotation = rotation_matrix(start.quat_wxyz[index])
    aim = aim - rotation @ size.center_m
    aim = aim + up * (height - aim @ up)
    track = push_track(
        aim, start.quat_wxyz[index], heading, np.cross(up, heading), run_up, speed, curvature, length, duration_s
    )
    start.position_m[index], start.velocity_m_s[index] = track.position_m[0], commanded_velocity(track)[0]
    start.driven[body.name] = track


def _heights(model: Model, body: BodyModel, quat_wxyz: np.ndarray, up: np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest extent of a body's collision spheres along `up`, from its origin [m]."""
    spheres = model.collision[body.name]
    along = np.asarray(spheres.means, float) @ (rotation_matrix(quat_wxyz).T @ up)
    radii = np.asarray(spheres.scales, float) * body.radius_factor
    return float((along - radii).min()), float((along + radii).max())


def _center(start: Start, index: int, size: Extent) -> np.ndarray:
    return start.position_m[index] + rotation_matrix(start.quat_wxyz[index]) @ size.center_m

"""What a rollout starts from: initial states, pushes and viewpoints, drawn from a sampling plan.

What is fixed in a plan takes no random number, so that a rollout keeps its draws when a plan gets another entry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..datasets.cameras import Camera
from ..datasets.models import Model
from ..datasets.tracks import Track
from ..schemas import (
    BodyModel,
    Distribution,
    InputDataError,
    ModelFile,
    NotConvergedError,
    SamplingPlan,
    SynthesizeConfig,
)
from .distributions import draw
from .pushes import push_track

GRAVITY_M_S2 = 9.81
"""For the default speeds only, where the model has no gravity."""
MAX_PLACEMENTS = 200


@dataclass(frozen=True)
class Start:
    """Where a rollout begins. nb bodies.

    Attributes:
        position_m: Body frame origins [m], world, shape (nb, 3).
        quat_wxyz: T_world_body, shape (nb, 4).
        velocity_m_s: Of the body frame origins [m/s], world, shape (nb, 3).
        omega_body_rad_s: Body frame [rad/s], shape (nb, 3).
        driven: The commanded motion of each driven body.
    """

    position_m: np.ndarray
    quat_wxyz: np.ndarray
    velocity_m_s: np.ndarray
    omega_body_rad_s: np.ndarray
    driven: dict[str, Track]


@dataclass(frozen=True)
class Extent:
    """The size of a body: all of it lies within `radius_m` of `center_m` (body frame)."""

    center_m: np.ndarray
    radius_m: float


def extent(model: Model, body: BodyModel) -> Extent:
    """Return the bounding sphere of a body: about the middle of its colliding spheres."""
    spheres = model.collision[body.name]
    means = np.asarray(spheres.means, float)
    radii = np.asarray(spheres.scales, float) * body.radius_factor
    center = 0.5 * ((means - radii[:, None]).min(0) + (means + radii[:, None]).max(0))
    return Extent(center, float((np.linalg.norm(means - center, axis=1) + radii).max()))


def up_direction(file: ModelFile) -> np.ndarray:
    """Return the unit vector that points away from the ground; against gravity where there is none."""
    if file.ground is not None:
        return np.asarray(file.ground.normal, float)
    gravity = np.asarray(file.gravity_m_s2, float)
    norm = np.linalg.norm(gravity)
    return -gravity / norm if norm > 0 else np.array([0.0, 0.0, 1.0])


def resolve_plan(model: Model, plan: SamplingPlan) -> SamplingPlan:
    """Fill in what the plan leaves out from the size of the free bodies."""
    file = model.file
    radii = [extent(model, body).radius_m for body in file.bodies if body.motion == "free"]
    if not radii:
        raise InputDataError("the model has no free body, so there is nothing to simulate.")
    radius = max(radii)
    gravity = float(np.linalg.norm(file.gravity_m_s2)) or GRAVITY_M_S2
    speed = math.sqrt(2 * gravity * 3 * radius)
    start = plan.start
    if start == "auto":
        start = "rest" if any(body.motion == "driven" for body in file.bodies) else "throw"
    if start == "slide" and file.ground is None:
        raise InputDataError(
            'the plan\'s start is "slide", and the model has no ground.', '"throw", "rest".', "choose another start."
        )
    defaults: dict[str, object] = {
        "height_m": (0.5 * radius, 3.0 * radius),
        "offset_m": 0.0 if start == "rest" else 0.5 * radius,
        "horizontal_speed_m_s": (0.0, 0.5 * speed),
        "vertical_speed_m_s": (-0.5 * speed, 0.5 * speed),
        "spin_rad_s": (0.0, 0.5 * speed / radius),
    }
    left_out = {name: value for name, value in defaults.items() if getattr(plan, name) is None}
    return SamplingPlan(**{**plan.model_dump(), **left_out, "start": start})


def draw_start(model: Model, plan: SamplingPlan, duration_s: float, rng: np.random.Generator) -> Start:
    """Draw the initial state of all bodies, and the motion of the driven ones.

    Free bodies are thrown (some orientation, height, velocity and spin), rest as in the photos, turned about the
    vertical, or slide from there; driven bodies come at one of them.

    Args:
        model: The model with this rollout's parameters.
        plan: A resolved plan.
        duration_s: Length of the rollout [s].
        rng: Source of randomness.
    """
    bodies = model.file.bodies
    count = len(bodies)
    start = Start(np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, 3)), np.zeros((count, 3)), {})
    extents = [extent(model, body) for body in bodies]
    for index, body in enumerate(bodies):
        start.position_m[index], start.quat_wxyz[index] = body.photo_pose.position_m, body.photo_pose.quat_wxyz
    free = [index for index, body in enumerate(bodies) if body.motion == "free"]
    driven = [index for index, body in enumerate(bodies) if body.motion == "driven"]
    assert plan.start != "auto" and plan.offset_m is not None  # a resolved plan
    if plan.start == "rest" and plan.offset_m == 0:
        for index in free:
            _rest(start, index, model, plan, rng)
    else:
        _place_apart(start, free, model, plan, extents, rng)
    for index in driven:
        target = free[int(rng.integers(len(free)))]
        _push(start, index, target, model, plan, extents, duration_s, rng)
    return start


def _place_apart(
    start: Start, free: list[int], model: Model, plan: SamplingPlan, extents: list[Extent], rng: np.random.Generator
) -> None:
    """Place the free bodies, drawn anew until no two bounding spheres overlap."""
    for _ in range(MAX_PLACEMENTS):
        for index in free:
            if plan.start == "throw":
                _throw(start, index, model, plan, extents[index], rng)
            else:
                _rest(start, index, model, plan, rng)
            if plan.start == "slide":
                _slide(start, index, model, plan, extents[index], rng)
        centers = [_center(start, index, extents[index]) for index in range(len(extents))]
        # a driven body is placed afterwards, by where the free ones are
        others = [index for index, body in enumerate(model.file.bodies) if body.motion != "driven"]
        pairs = [(a, b) for a in free for b in others if a != b]
        if all(np.linalg.norm(centers[a] - centers[b]) > extents[a].radius_m + extents[b].radius_m for a, b in pairs):
            return
    raise NotConvergedError(
        f"no start without overlap in {MAX_PLACEMENTS} draws for {len(free)} free bodies.",
        todo="raise offset_m and height_m in the sampling plan.",
    )


def _throw(start: Start, index: int, model: Model, plan: SamplingPlan, size: Extent, rng: np.random.Generator) -> None:
    assert plan.height_m and plan.offset_m is not None and plan.horizontal_speed_m_s  # a resolved plan
    assert plan.vertical_speed_m_s and plan.spin_rad_s
    file, up = model.file, up_direction(model.file)
    if plan.orientation == "any":
        quat = rng.normal(size=4)
        start.quat_wxyz[index] = quat / np.linalg.norm(quat)
    else:
        start.quat_wxyz[index] = _upright(model, index, plan, rng)
    place = _place(model, index, plan.offset_m, rng)
    gap = draw(plan.height_m, rng)
    floor = file.ground.offset_m if file.ground else float(place @ up) - size.radius_m
    center = place + up * (floor + size.radius_m + gap - place @ up)
    start.position_m[index] = center - rotation_matrix(start.quat_wxyz[index]) @ size.center_m
    heading = _heading(plan.heading_deg, up, rng)
    speed, rise = draw(plan.horizontal_speed_m_s, rng), draw(plan.vertical_speed_m_s, rng)
    axis = rng.normal(size=3)
    start.omega_body_rad_s[index] = axis / np.linalg.norm(axis) * draw(plan.spin_rad_s, rng)
    _launch(start, index, heading * speed + up * rise, center)


def _slide(start: Start, index: int, model: Model, plan: SamplingPlan, size: Extent, rng: np.random.Generator) -> None:
    """Give a resting body a level velocity, and a spin about the vertical to either side."""
    assert plan.horizontal_speed_m_s and plan.spin_rad_s  # a resolved plan
    up = up_direction(model.file)
    heading, speed = _heading(plan.heading_deg, up, rng), draw(plan.horizontal_speed_m_s, rng)
    spin = draw(plan.spin_rad_s, rng) * (1.0 if rng.random() < 0.5 else -1.0)
    start.omega_body_rad_s[index] = rotation_matrix(start.quat_wxyz[index]).T @ (up * spin)
    _launch(start, index, heading * speed, _center(start, index, size))


def _launch(start: Start, index: int, velocity: np.ndarray, center: np.ndarray) -> None:
    # The plan's velocity is the bounding centre's, so that a spin about it does not add to the throw.
    omega_world = rotation_matrix(start.quat_wxyz[index]) @ start.omega_body_rad_s[index]
    start.velocity_m_s[index] = velocity + np.cross(omega_world, start.position_m[index] - center)


def _rest(start: Start, index: int, model: Model, plan: SamplingPlan, rng: np.random.Generator) -> None:
    """Turn a body about the vertical, and set its lowest colliding sphere on the ground."""
    assert plan.offset_m is not None  # a resolved plan
    file, body, up = model.file, model.file.bodies[index], up_direction(model.file)
    start.quat_wxyz[index] = _upright(model, index, plan, rng)
    start.position_m[index] = _place(model, index, plan.offset_m, rng)
    if file.ground is None:
        return
    low, _ = _heights(model, body, start.quat_wxyz[index], up)
    position = start.position_m[index]
    start.position_m[index] = position + up * (file.ground.offset_m - low - position @ up)


def _upright(model: Model, index: int, plan: SamplingPlan, rng: np.random.Generator) -> np.ndarray:
    """Return the orientation of the photos, turned about the vertical unless the plan wants it as it was."""
    photo = np.asarray(model.file.bodies[index].photo_pose.quat_wxyz, float)
    if plan.orientation == "photo":
        return photo
    half = 0.5 * rng.uniform(0, 2 * math.pi)
    return quat_product(np.concatenate([[math.cos(half)], math.sin(half) * up_direction(model.file)]), photo)


def _place(model: Model, index: int, offset_m: float, rng: np.random.Generator) -> np.ndarray:
    """Return a place on a level disc about that of the photos [m], world."""
    place = np.asarray(model.file.bodies[index].photo_pose.position_m, float)
    if offset_m == 0:
        return place
    across = _horizontal(up_direction(model.file), rng.uniform(0, 2 * math.pi))
    return place + across * offset_m * math.sqrt(rng.random())


def _heading(angle_deg: Distribution | None, up: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a level unit vector; any where the plan names no angle."""
    angle = rng.uniform(0, 2 * math.pi) if angle_deg is None else math.radians(draw(angle_deg, rng))
    return _horizontal(up, angle)


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
    """Send a driven body at the target: level, at constant speed, past its centre by a random miss."""
    file, up = model.file, up_direction(model.file)
    body, size, goal = file.bodies[index], extents[index], extents[target]
    heading = _heading(plan.push_heading_deg, up, rng)
    miss = rng.uniform(-1, 1) * plan.push_miss * goal.radius_m
    gap, speed = draw(plan.push_gap_m, rng), draw(plan.push_speed_m_s, rng)
    curvature = draw(plan.push_curve_1_m, rng)
    length = None if plan.push_length_m is None else draw(plan.push_length_m, rng)
    run_up = goal.radius_m + size.radius_m + gap
    aim = _center(start, target, goal) + np.cross(up, heading) * miss
    # Where the photos show the pusher, but neither in the ground nor above the object.
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
    assert track.velocity_m_s is not None  # a push has it
    start.position_m[index], start.velocity_m_s[index] = track.position_m[0], track.velocity_m_s[0]
    start.driven[body.name] = track


def _heights(model: Model, body: BodyModel, quat_wxyz: np.ndarray, up: np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest point of a body's colliding spheres along `up`, from its origin [m]."""
    spheres = model.collision[body.name]
    along = np.asarray(spheres.means, float) @ (rotation_matrix(quat_wxyz).T @ up)
    radii = np.asarray(spheres.scales, float) * body.radius_factor
    return float((along - radii).min()), float((along + radii).max())


def _center(start: Start, index: int, size: Extent) -> np.ndarray:
    return start.position_m[index] + rotation_matrix(start.quat_wxyz[index]) @ size.center_m


def look_at_cameras(
    model: Model, plan: SamplingPlan, config: SynthesizeConfig, rng: np.random.Generator | None = None
) -> dict[str, Camera]:
    """Return the plan's cameras: they look at where the free bodies move, from evenly spread directions.

    The default distance lets the highest start and its surroundings fill most of the image's height.

    Args:
        model: The model.
        plan: A resolved plan.
        config: The size of the images.
        rng: Source of randomness for what varies.
    """
    assert plan.height_m and plan.offset_m is not None  # a resolved plan
    rng = rng or np.random.default_rng(0)
    file, up = model.file, up_direction(model.file)
    free = [body for body in file.bodies if body.motion == "free"]
    radius = max(extent(model, body).radius_m for body in free)
    middle = np.mean([body.photo_pose.position_m for body in free], axis=0)
    thrown = plan.start == "throw"
    top = plan.height_m.support[1] + 2 * radius if thrown else 3 * radius
    floor = file.ground.offset_m if file.ground else float(middle @ up) - radius
    middle = middle + up * (floor + 0.5 * top - middle @ up)
    offset = plan.offset_m if thrown else max(plan.offset_m, 0.5 * radius)
    reach = max(0.5 * top, offset + 2 * radius) * 1.15
    cameras = {}
    for number, direction in enumerate(np.radians(np.linspace(*plan.view_azimuth_deg, plan.views))):
        azimuth = direction + math.radians(draw(plan.view_shift_deg, rng))
        elevation, roll = (math.radians(draw(angle, rng)) for angle in (plan.view_elevation_deg, plan.view_roll_deg))
        half_angle = math.radians(draw(plan.view_angle_deg, rng)) / 2
        distance = reach / math.sin(half_angle) if plan.view_distance_m is None else draw(plan.view_distance_m, rng)
        target = middle if plan.view_aim_m == 0 else middle + _in_ball(plan.view_aim_m, rng)
        focal = 0.5 * config.height / math.tan(half_angle)
        K = np.array([[focal, 0, config.width / 2], [0, focal, config.height / 2], [0, 0, 1]])
        side = _horizontal(up, azimuth - math.pi / 2)
        eye = target + distance * (math.cos(elevation) * side + math.sin(elevation) * up)
        pose = look_at(eye, target, up)
        if roll:
            pose[:3, :2] = pose[:3, :2] @ [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
        cameras[f"view{number}"] = Camera(config.width, config.height, K, np.zeros(0), pose)
    return cameras


def _in_ball(radius: float, rng: np.random.Generator) -> np.ndarray:
    """Return a point of a ball about the origin, all places alike."""
    way = rng.normal(size=3)
    return way / np.linalg.norm(way) * radius * rng.random() ** (1 / 3)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return T_world_cam (4, 4) of a camera at `eye` that looks at `target`; OpenCV axes."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def _horizontal(up: np.ndarray, angle: float) -> np.ndarray:
    """Return the unit vector at `angle` [rad] in the plane normal to `up`; for up = z, 0 is x and pi/2 is y."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    first = np.cross(helper, up)
    first /= np.linalg.norm(first)
    return math.cos(angle) * first + math.sin(angle) * np.cross(up, first)


def rotation_matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quat_wxyz, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quat_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Hamilton product of two quaternions (4,), w x y z."""
    w, v = first[0], first[1:]
    W, V = second[0], second[1:]
    return np.concatenate([[w * W - v @ V], w * V + W * v + np.cross(v, V)])

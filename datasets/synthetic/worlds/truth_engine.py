"""The true motion of a world, by MuJoCo, and pictures of it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, combinations, product

import numpy as np
from numpy.typing import NDArray

from ....schemas import Surface
from ...capture.cameras import Camera
from ..coulomb_step import ask_for_no_slip, coulomb_step
from ..dynamics import BODY_GROUP, GROUND_GROUP, MjModel, mujoco
from ..raycast import Lamp, Plain, Raycaster
from ..rig import look_at
from .scene import GRAVITY_M_S2, Array, Thing, WorldEpisode, WorldPlan

STEPS_PER_S = 3600
"""Steps of the simulation in a second: a multiple of the rate of the tracks."""
IMPEDANCE = 0.97
"""MuJoCo's constraint impedance at every depth [1]."""
_GROUND_HALF_M = 1.2
"""Half the side of the part of the ground that pictures show; what is simulated has no edge."""
_SURFACE_COLORS = ((0.80, 0.76, 0.68), (0.62, 0.56, 0.48))
_GROUND_COLOR = (0.52, 0.55, 0.57)


def build_model(plan: WorldPlan) -> MjModel:
    """Build the MuJoCo model: the ground, the surfaces, and the bodies with free joints in their order."""
    parts = {thing.name: _geoms(thing) for thing in plan.things}
    assets = "".join(asset for geoms in parts.values() for _, asset, _ in geoms)
    bodies = "".join(_body(thing, [form for _, _, form in parts[thing.name]]) for thing in plan.things)
    pairs = _pairs(plan, [[name for name, _, _ in geoms] for geoms in parts.values()])
    surfaces = "".join(_surface(surface) for surface in plan.surfaces)
    ground = f'<geom name="ground" type="plane" size="{_GROUND_HALF_M} {_GROUND_HALF_M} 0.1" {_flags(GROUND_GROUP)}/>'
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option timestep="{1 / STEPS_PER_S!r}" gravity="0 0 {-GRAVITY_M_S2}" cone="elliptic" impratio="1"
        tolerance="1e-10" iterations="50" integrator="implicitfast"/>
      <compiler angle="radian"/>
      <asset>{assets}</asset>
      <worldbody>{ground if plan.ground is not None else ""}{surfaces}{bodies}</worldbody>
      <contact>{"".join(pairs)}</contact>
    </mujoco>""")


def _pairs(plan: WorldPlan, geoms: Sequence[Sequence[str]]) -> list[str]:
    """Return the pairs of the geoms of each body with what is fixed, and with those of the others."""
    fixed = {"ground": plan.ground.material or ""} if plan.ground is not None else {}
    fixed |= {surface.name: surface.material or "" for surface in plan.surfaces}
    on_fixed = product(chain.from_iterable(geoms), fixed.items())
    found = [_pair(plan, geom, other, (material, plan.material)) for geom, (other, material) in on_fixed]
    between = chain.from_iterable(product(some, others) for some, others in combinations(geoms, 2))
    return found + [_pair(plan, geom, other, (plan.material, plan.material)) for geom, other in between]


def simulate(plan: WorldPlan, model: MjModel, episode: WorldEpisode, rate_hz: int) -> Array:
    """Return the poses of all bodies, position [m] and quat_wxyz, shape (frames, bodies, 7), at a rate."""
    ask_for_no_slip(model)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = episode.qpos.ravel(), episode.qvel.ravel()
    frames = [data.qpos.copy()]
    for step in range(round(episode.length_s * STEPS_PER_S)):
        coulomb_step(model, data)
        if (step + 1) % (STEPS_PER_S // rate_hz) == 0:
            frames.append(data.qpos.copy())
    return np.asarray(frames).reshape(-1, len(plan.things), 7)


def picture(plan: WorldPlan, poses: Array, size: tuple[int, int] = (480, 360)) -> NDArray[np.uint8]:
    """Return a picture (height, width, 3) of a world with its bodies at poses (bodies, 7)."""
    model = build_model(plan)
    names = [model.geom(k).name for k in range(model.ngeom)]
    colors = {"ground": _GROUND_COLOR}
    colors |= {surface.name: _SURFACE_COLORS[k > 0] for k, surface in enumerate(plan.surfaces)}
    colors |= {name: t.color for t in plan.things for name in names if name.split("/")[0] == t.name}
    materials = {k: Plain(colors[name]) for k, name in enumerate(names)}
    lamp = Lamp(20 * np.array([-0.35, -0.45, 0.82]))
    caster = Raycaster(model, materials, {}, lamp=lamp, backdrop=(0.93, 0.94, 0.95))
    caster.place(poses.ravel())
    width, height = size
    K = np.array([[1.15 * width, 0, width / 2], [0, 1.15 * width, height / 2], [0, 0, 1]])
    T_world_cam = look_at(np.asarray(plan.look_from_m), np.asarray(plan.look_at_m))
    camera = Camera(width=width, height=height, K=K, distortion=np.zeros(0), T_world_cam=T_world_cam)
    return (255 * caster.render(camera).color.clip(0, 1)).round().astype(np.uint8)


def _geoms(thing: Thing) -> list[tuple[str, str, str]]:
    """Return name, asset and form of each convex part of a body."""
    if thing.half_extents_m is not None:
        return [(thing.name, "", f'name="{thing.name}" type="box" size="{_text(thing.half_extents_m)}"')]
    if thing.solid is None:
        return [(thing.name, "", f'name="{thing.name}" type="sphere" size="{thing.radius_m}"')]
    found = []
    for k, part in enumerate(thing.solid.parts):
        name = f"{thing.name}/{k}"
        asset = f'<mesh name="{name}" vertex="{_text(part.ravel())}"/>'
        found.append((name, asset, f'name="{name}" type="mesh" mesh="{name}"'))
    return found


def _body(thing: Thing, forms: list[str]) -> str:
    solid = thing.solid
    if solid is None:
        mass = f'mass="{thing.mass_kg}" '
        inertial = ""
    else:
        mass, moments = "", solid.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        inertial = f'<inertial pos="{_text(solid.com)}" mass="{thing.mass_kg}" fullinertia="{_text(moments)}"/>'
    geoms = "".join(f"<geom {form} {mass}{_flags(BODY_GROUP)}/>" for form in forms)
    return f'<body name="{thing.name}"><freejoint/>{inertial}{geoms}</body>'


def _surface(surface: Surface) -> str:
    assert surface.box is not None  # the worlds have boxes alone
    place, turn, half = surface.pose.position_m, surface.pose.quat_wxyz, surface.box.half_extents_m
    form = f'type="box" pos="{_text(place)}" quat="{_text(turn)}" size="{_text(half)}"'
    return f'<geom name="{surface.name}" {form} {_flags(GROUND_GROUP)}/>'


def _pair(plan: WorldPlan, geom: str, other: str, materials: tuple[str, str]) -> str:
    contact = plan.contact
    first, second = sorted(materials)
    friction = contact.friction[first, second]
    time, ratio = contact.natural_time_s / contact.damping_ratio, contact.damping_ratio
    return (
        f'<pair geom1="{geom}" geom2="{other}" condim="3" friction="{friction!r} {friction!r} 0 0 0" '
        f'solref="{time!r} {ratio!r}" solimp="{IMPEDANCE} {IMPEDANCE} 0.001"/>'
    )


def _flags(group: int) -> str:
    return f'group="{group}" contype="0" conaffinity="0"'


def _text(values: object) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())

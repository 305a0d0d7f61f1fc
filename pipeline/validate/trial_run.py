"""A trial run of a model: its world is built and simulated for a second from just above the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ...datasets.models.effect_files import packed_name
from ...datasets.models.model import Model
from ...schemas import CgwmError, InputDataError, ModelFile
from ..geometry.rotation import quat_to_matrix
from ..physics.chains.joint_command import JointCommand
from ..physics.chains.state import joints_of, with_joints
from ..physics.checks import require_apart
from ..physics.effects.registry import BUILT_IN
from ..physics.engine import rollout
from ..physics.fused.host import lacking
from ..physics.model_world import world_of_model
from ..physics.rollout import Rollout, simulate
from ..physics.state import State
from ..physics.surfaces.thin_walls import thin_wall_warnings
from ..physics.world import World

LENGTH_S = 1.0
"""Length of the trial run [s]; shorter where the steps or sweeps are many."""
FRAMES = 21
MOST_SWEEPS, MOST_SWEEPS_TORCH = 200_000, 2_000
"""Most sweeps over the contacts, of all steps together: in the fused kernel, and in the torch engine."""
ABSURD_GAIN = 10.0
"""Largest gain of energy, in units of a fall by the largest body's diameter; contact and friction only take energy."""
STRAY_SPEED_M_S, EFFECT_SPEED_M_S = 10.0, 300.0
"""Speeds that a body may gain beyond that: where bodies touch at the start, and by effects (a storm, a magnet)."""


def run_faults(model: Model) -> tuple[list[str], dict[str, str]]:
    """Simulate a model, and return what goes wrong, as sentences, and the facts of the run.

    Free bodies fall from where they were in the photos, or from a body's diameter above the ground where that is
    higher, jointed ones with their joints in the middle of their limits; driven bodies stand still. Effects that are
    not built in are left out, so that nothing of the model is executed.
    """
    file = _still(model.file)
    if file.contact is None or not file.tracked:
        return [], {}
    facts = {}
    if len(file.effects) < len(model.file.effects):
        left_out = [packed_name(effect.name) for effect in model.file.effects if effect not in file.effects]
        facts["simulated_without_effects"] = ", ".join(left_out)
    try:
        with torch.no_grad():
            world = world_of_model(replace(model, file=file))
            state = _start(world, file)
            thin = thin_wall_warnings(world)
            _require_own_values(model, file, world)
            result = _simulated(world, state)
    except CgwmError as error:
        found = error.found.removeprefix(f"{model.place}: ")
        return [f"model.json: it cannot be simulated: {found}"], facts
    if result.times_s[-1] < LENGTH_S:
        facts["simulated_s"] = f"{float(result.times_s[-1]):.3g}"
    if thin:
        facts["thin_walls"] = " ".join(thin)
    fault = _fault(world, state, result)
    return ([] if fault is None else [f"model.json: {fault}"]), facts


def _still(file: ModelFile) -> ModelFile:
    """Return the model without commands of driven bodies, and without effects that are not built in."""
    bodies = tuple(
        body.model_copy(update={"motion": "fixed"}) if body.motion == "driven" else body for body in file.bodies
    )
    effects = tuple(effect for effect in file.effects if effect.name.partition("@")[0] in BUILT_IN)
    still = tuple(
        one.model_copy(update={"base": "fixed"}) if one.base == "driven" else one for one in file.articulations
    )
    return file.model_copy(update={"bodies": bodies, "effects": effects, "articulations": still})


def _require_own_values(model: Model, file: ModelFile, world: World) -> None:
    """Refuse values of single groups or episodes that an effect does not admit."""
    for place, effect in enumerate(file.effects):
        for values in effect.own.values():
            effects = list(file.effects)
            effects[place] = effect.model_copy(update={"parameters": effect.parameters | values})
            own = replace(model, file=file.model_copy(update={"effects": tuple(effects)}))
            world_of_model(own, geometry=world)


def _start(world: World, file: ModelFile) -> State:
    """Return the bodies at rest, the free ones high enough above the ground."""
    poses = [body.photo_pose for body in file.bodies]
    places = torch.tensor([[*pose.position_m, *pose.quat_wxyz] for pose in poses], dtype=torch.float64)
    position, quat = places[None, :, :3].clone(), places[None, :, 3:].clone()
    state = _jointed(world, State(position, quat, torch.zeros_like(position), torch.zeros_like(position)))
    if world.ground_normal is not None:
        groups = [[index] for index in world.free]
        groups += [[world.body_names.index(k) for k in chain.links] for chain in world.chains if chain.base == "free"]
        for group in groups:
            state.position_m[0, group] += world.ground[0] * _lift(world, state, group)
    return state


def _jointed(world: World, state: State) -> State:
    """Return the state with the joints in the middle of their limits, or at 0 where they have none."""
    middles = {}
    for joint in (joint for chain in world.chains for joint in chain.moving):
        middle = 0.5 * (joint.lower + joint.upper)
        middles[joint.name] = torch.where(torch.isfinite(middle), middle, torch.zeros_like(middle))
    return with_joints(world, state, middles) if middles else state


def _lift(world: World, state: State, group: list[int]) -> Tensor:
    """Return by how much bodies have to be raised together to be their diameter above the ground [m]."""
    normal, offset = world.ground
    lowest, diameter = [], []
    for index in group:
        body = world.bodies[index]
        if not body.radii.shape[-1]:
            continue
        centers = (quat_to_matrix(state.quat_wxyz[:, index]) @ body.centers[0].T)[0].T + state.position_m[0, index]
        lowest.append((centers @ normal - body.radii[0]).min() - offset[0])
        diameter.append(_diameter(world, index))
    if not lowest:
        return torch.zeros(())
    return (torch.stack(diameter).max() - torch.stack(lowest).min()).clamp_min(0.0)


def _diameter(world: World, index: int) -> Tensor:
    """Return the longest side of the box around a body's spheres [m]."""
    body = world.bodies[index]
    radii = body.radii[0][:, None]
    return ((body.centers[0] + radii).amax(0) - (body.centers[0] - radii).amin(0)).max()


def _simulated(world: World, state: State) -> Rollout:
    fused = lacking(world) is None
    steps = max((MOST_SWEEPS if fused else MOST_SWEEPS_TORCH) // world.iterations, FRAMES)
    times = torch.linspace(0.0, min(LENGTH_S, steps * world.step_s), FRAMES, dtype=torch.float64)
    chains = [chain for chain in world.chains if chain.has_servos]
    held = {chain.name: JointCommand.hold_still(joints_of(world, state, chain)[0]) for chain in chains}
    return (rollout if fused else simulate)(world, state, times, held)


def _fault(world: World, state: State, result: Rollout) -> str | None:
    """Return what is wrong with a run, in words."""
    parts = (result.position_m, result.quat_wxyz, result.velocity_m_s, result.omega_body_rad_s)
    finite = torch.isfinite(torch.cat(parts, -1)).flatten(2).all(-1)[0]
    if not bool(finite.all()):
        when = float(result.times_s[int((~finite).nonzero()[0])])
        return f"left to fall, it diverges within {when:.3g} s: its state is not finite."
    try:
        require_apart(world, state)
    except InputDataError:
        return None  # bodies that begin deep inside each other are thrown apart
    energy = torch.stack([_energy(world, index, result) for index in world.tracked]).sum(0)
    gain = float((energy - energy[0]).max())
    speed = EFFECT_SPEED_M_S if world.effects else STRAY_SPEED_M_S
    limit = 0.0
    for index in world.tracked:
        fall = float(world.gravity[0].norm() * _diameter(world, index))
        limit += float(world.bodies[index].mass[0]) * (ABSURD_GAIN * fall + 0.5 * speed**2)
    if not (math.isfinite(gain) and gain <= limit):
        return f"left to fall, it gains {gain:.3g} J within {float(result.times_s[-1]):.3g} s; at most {limit:.3g} J."
    return None


def _energy(world: World, index: int, result: Rollout) -> Tensor:
    """Return kinetic and potential energy of a body at each frame [J], shape (T,)."""
    body = world.bodies[index]
    rotation = quat_to_matrix(result.quat_wxyz[0, :, index])
    omega = result.omega_body_rad_s[0, :, index]
    com = body.com[0].expand_as(omega)
    velocity = result.velocity_m_s[0, :, index] + _turned(rotation, torch.linalg.cross(omega, com))
    height = (result.position_m[0, :, index] + _turned(rotation, com)) @ world.gravity[0]
    spin = 0.5 * (omega * (omega @ body.inertia[0])).sum(-1)
    return body.mass[0] * (0.5 * velocity.square().sum(-1) - height) + spin


def _turned(rotation: Tensor, vectors: Tensor) -> Tensor:
    return (rotation @ vectors[..., None]).squeeze(-1)

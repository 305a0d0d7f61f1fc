"""Build the world of a fitted model: its bodies, surfaces, chains, laws of contact and effects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from ...schemas.materials import pair_of
from .body import Body
from .chains.chain import chain_of_model
from .contact_law import ContactLaw
from .effects.effect import ActiveEffect
from .effects.registry import effect_of
from .hull import Hull
from .inertia import symmetric
from .paper_law import PaperLaw
from .patch import Patch
from .smooth_distance import plane_contacts
from .surfaces.fixed_surface import FixedSurface, shape_of, surface_mesh
from .world import World

if TYPE_CHECKING:
    from ...datasets.models.model import Model
    from ...schemas import BodyModel, ContactParameters, EffectModel


def world_of_model(
    model: Model,
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
    geometry: World | None = None,
    joins_others: bool = False,
) -> World:
    """Build the world of a fitted model.

    A body that is alone on the ground has no hull: a plane touches spheres, and hulls are for what touches bodies
    and surfaces.

    Args:
        model: The model.
        dtype: Type of all tensors.
        device: Device of all tensors.
        geometry: A world of the same model with other parameters, whose collision spheres are used again.
        joins_others: Whether the bodies are to touch others than those of the model: they get their hulls.

    Raises:
        InputDataError: If the model has no fitted physics yet.
    """
    file = model.file
    if file.contact is None:
        raise InputDataError(
            f"{model.place}: the model has no fitted physics, only the scene.",
            todo="run 'cgwm fit CAPTURE --stage phys-geo --from MODEL --out NEW' first.",
        )

    def tensor(value: object) -> Tensor:
        return torch.as_tensor(np.asarray(value), dtype=dtype, device=device)[None]

    hulls = joins_others or len(file.bodies) > 1 or bool(file.surfaces)
    bodies = [
        _body(model, index, tensor, None if geometry is None else geometry.bodies[index], hulls)
        for index in range(len(file.bodies))
    ]

    def law_of(numbers: ContactParameters) -> ContactLaw | PaperLaw:
        friction, time, ratio = (tensor(v) for v in (numbers.friction, numbers.contact_time_s, numbers.damping_ratio))
        if file.solver.contact_model == "closed_form":
            return ContactLaw(friction, time, ratio)
        mass = min(body.mass_kg for body in file.bodies if body.motion == "free")
        return PaperLaw.of_body(friction, time, ratio, mass, mass * float(np.linalg.norm(file.gravity_m_s2)))

    ground = file.ground
    world = World(
        surfaces=fixed_surfaces(model, tensor),
        chains=tuple(chain_of_model(entry, tensor(0.0)) for entry in file.articulations),
        bodies=tuple(bodies),
        gravity=tensor(file.gravity_m_s2),
        ground_normal=tensor(ground.normal)[0] if ground else None,
        ground_offset=tensor(ground.offset_m) if ground else None,
        contact=law_of(file.contact),
        pair_laws={pair_of(*pair.materials): law_of(pair) for pair in file.pairs},  # pyright: ignore[reportArgumentType]
        ground_material=ground.material if ground else None,
        step_s=file.solver.step_s,
        iterations=file.solver.sweeps,
        effects=tuple(
            _active(effect, f"{model.place}: effect '{effect.name}'", tensor(0.0)) for effect in file.effects
        ),
        source="" if model.root is None else model.place,
    )
    return _with_only_law(world) if file.pairs else world


def _with_only_law(world: World) -> World:
    """Return the world; where all contacts are of one pair of materials, with the law of that pair as `contact`."""
    used = {world.materials_of(a, b) for a, b in world.pairs}
    only = next(iter(used)) if len(used) == 1 else None
    return world if only is None else replace(world, contact=world.pair_laws[only], pair_laws={})


def _body(
    model: Model, index: int, tensor: Callable[[object], Tensor], geometry: Body | None, touches_others: bool
) -> Body:
    """Return a body of a model, with the spheres and the place of `geometry` if it is given.

    Args:
        model: The model.
        index: Index of the body in the model.
        tensor: Function that returns a value as a tensor with a batch dimension of 1.
        geometry: The same body with other parameters.
        touches_others: Whether it may touch more than the ground.
    """
    entry = model.file.bodies[index]
    if geometry is None:
        spheres = model.collision[entry.name]
        centers, radii = tensor(spheres.means), tensor(spheres.scales * entry.radius_factor)
        place = tensor((*entry.photo_pose.position_m, *entry.photo_pose.quat_wxyz))
        on_plane = hull = patch = None
        if model.file.solver.contact_model == "closed_form":  # as published, every sphere is a contact of its own
            on_plane = plane_contacts(centers[0], radii[0])
            if entry.convex and (touches_others or entry.face_points):
                hull = Hull.of(centers[0], radii[0], on_plane)
            patch = _patch(entry, hull, centers[0], radii[0])
    else:
        centers, radii, place, on_plane = geometry.centers, geometry.radii, geometry.place, geometry.on_plane
        hull, patch = geometry.hull, geometry.patch
    return Body(
        name=entry.name,
        motion=entry.motion,
        mass=tensor(entry.mass_kg),
        inertia=tensor(symmetric(entry.inertia_kg_m2)),
        com=tensor(entry.com_m),
        centers=centers,
        radii=radii,
        place=place,
        on_plane=on_plane,
        material=entry.material,
        hull=hull,
        patch=patch,
    )


def _patch(entry: BodyModel, hull: Hull | None, centers: Tensor, radii: Tensor) -> Patch | None:
    """Return the points of the flat faces of a body of a model, where it asks for them.

    Raises:
        InputDataError: If it asks for points and has no flat face.
    """
    if entry.face_points == 0:
        return None
    found = None if hull is None else Patch.of(hull, centers, radii, entry.face_points, entry.face_exponent)
    if found is None:
        reason = "no flat face" if entry.convex else "a shape that does not fill its convex hull"
        raise InputDataError(
            f"body '{entry.name}' has face_points = {entry.face_points} and {reason}.",
            "face_points of convex bodies with flat faces.",
            "leave face_points out, or give the body a shape with flat faces.",
        )
    return found


def fixed_surfaces(model: Model, tensor: Callable[[object], Tensor]) -> tuple[FixedSurface, ...]:
    """Return the fixed surfaces of a model.

    Args:
        model: The model.
        tensor: Function that makes a tensor, with a batch dimension of 1, of numbers.
    """
    found = []
    for entry in model.file.surfaces:
        kind, size = shape_of(entry)
        found.append(
            FixedSurface(
                name=entry.name,
                kind=kind,
                position=tensor(entry.pose.position_m),
                quat_wxyz=tensor(entry.pose.quat_wxyz),
                size=tensor(size),
                material=entry.material,
                mesh=None if entry.mesh is None else surface_mesh(model.surface_meshes[entry.name], entry),
            )
        )
    return tuple(found)


def _active(entry: EffectModel, where: str, like: Tensor) -> ActiveEffect:
    try:
        effect = effect_of(entry)
        active = ActiveEffect.of(effect, entry.parameters, like)
    except UsageError as error:
        raise InputDataError(f"{where}: {error.found}", error.allowed, error.todo) from error
    except KeyError as error:
        raise InputDataError(f"{where}: {error.args[0]}.", todo="fit the model again with this effect.") from error
    for number in effect.parameters:
        value = float(active.values[number.name])
        low = 0.0 if number.nonnegative else -number.limit
        if not low <= value <= number.limit:
            raise InputDataError(
                f"{where}: {effect.name}.{number.name} is {value:g} {number.unit}.",
                f"{low:g} to {number.limit:g}.",
                "correct the value in model.json, or fit the model again.",
            )
    return active

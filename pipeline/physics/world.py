"""World model of the engine: bodies made of spheres, the ground, gravity, the contact law and the effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from ...schemas.materials import pair_of
from .chains.chain import Chain, chain_of_model
from .contact_law import ContactLaw
from .effects.effect import ActiveEffect
from .effects.registry import effect_of
from .hull import Hull
from .paper_law import PaperLaw
from .patch import Patch
from .smooth_distance import plane_contacts
from .surfaces.fixed_surface import FixedSurface, shape_of, surface_mesh

if TYPE_CHECKING:
    from ...datasets.models.model import Model
    from ...schemas import BodyModel, ContactParameters, EffectModel

T = TypeVar("T")

MOST_STEPS = 2_000_000_000
"""Maximum number of steps of a rollout: some hours; the kernels count them in 32 bits."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body made of spheres; every tensor has a batch dimension of 1 or B."""

    name: str
    """Name of the body, unique in the world."""
    motion: str
    """How the body moves: "free", "driven", "fixed", or "link" of a chain."""
    mass: Tensor
    """Mass [kg], shape (B,)."""
    inertia: Tensor
    """Inertia about the centre of mass, body axes [kg m2], shape (B, 3, 3)."""
    com: Tensor
    """Centre of mass in the body frame [m], shape (B, 3)."""
    centers: Tensor
    """Centres of the spheres in the body frame [m], shape (B, N, 3)."""
    radii: Tensor
    """Radii of the spheres [m], shape (B, N)."""
    place: Tensor | None = None
    """Position [m] and quat_wxyz of a fixed body, world frame, shape (1, 7)."""
    on_plane: Tensor | None = None
    """Indices of the spheres that the ground can touch, shape (K,); None for all."""
    material: str | None = None
    """Material, by which its pairs with others have their laws; None where it does not matter."""
    hull: Hull | None = None
    """Hull of the spheres, by which other bodies touch this one; None where they touch its spheres."""
    patch: Patch | None = None
    """Points of the hull's flat faces, by which the ground carries them as plates; None where its supports carry."""

    @property
    def plane_spheres(self) -> tuple[Tensor, Tensor]:
        """Centres (B, K, 3) and radii (B, K) [m] of what the ground can touch: spheres, then points of the patches."""
        centers, radii = self.centers, self.radii
        if self.on_plane is not None:
            centers, radii = centers[:, self.on_plane], radii[:, self.on_plane]
        if self.patch is None:
            return centers, radii
        points, sizes = self.patch.centers(self.centers), self.patch.radii(self.radii)
        return torch.cat((centers, points), 1), torch.cat((radii, sizes), 1)

    @property
    def plane_areas(self) -> Tensor | None:
        """Areas (K,) of what the ground can touch, in the order of `plane_spheres`; None where all count alike."""
        if self.patch is None:
            return None
        return self.patch.weights(self.radii.shape[-1] if self.on_plane is None else len(self.on_plane))

    @property
    def free(self) -> bool:
        """Whether the body moves by physics, on its own."""
        return self.motion == "free"


@dataclass(frozen=True, kw_only=True)
class World:
    """The bodies of a scene, the ground, gravity, the contact law and the effects."""

    bodies: tuple[Body, ...]
    """The bodies, in the order of the state."""
    gravity: Tensor
    """Gravitational acceleration, world frame [m/s2], shape (B, 3)."""
    ground_normal: Tensor | None
    """Unit normal of the ground, world frame, shape (3,); None without a ground."""
    ground_offset: Tensor | None
    """Offset of the ground along its normal [m], shape (B,); None without a ground."""
    contact: ContactLaw | PaperLaw
    """The contact law and its coefficients, for all pairs that `pair_laws` does not have."""
    pair_laws: Mapping[tuple[str, str], ContactLaw] = field(default_factory=dict)
    """The laws of pairs of materials, by `pair_of` of their names."""
    ground_material: str | None = None
    """Material of the ground; None where it does not matter."""
    surfaces: tuple[FixedSurface, ...] = ()
    """Fixed surfaces besides the ground."""
    step_s: float = 0.001
    """Largest time step [s]."""
    iterations: int = 10
    """Projected Jacobi iterations over all contacts of a step; 1 is the closed form alone."""
    effects: tuple[ActiveEffect, ...] = ()
    """Effects in addition to gravity and contact."""
    touching: bool = True
    """Whether bodies can touch at all; without contact every motion is free flight, at a tenth of the cost."""
    rolls_on: str | None = None
    """Device on which `engine.rollout` computes before it returns results to the device of the tensors; None for that
    of the tensors.
    """
    own_values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Group- or episode-specific values of effects' parameters: by episode, then by `effect.parameter`."""
    chains: tuple[Chain, ...] = ()
    """Jointed bodies, whose links are bodies with motion "link"."""
    source: str = ""
    """File of the model that it was built from, for messages; empty where there is none."""

    def called(self, what: str) -> str:
        """Return what messages call a part of the world: with the file that it comes from."""
        return f"{self.source}: {what}" if self.source else what

    def once(self, make: Callable[[World], T]) -> T:
        """Return `make(self)`, made at the first call and kept with the world; for what depends on nothing else."""
        kept: dict[object, object] = self.__dict__.setdefault("_kept", {})
        if make not in kept:
            kept[make] = make(self)
        return cast(T, kept[make])

    def latest(self, make: Callable[..., T], *inputs: State | Tensor) -> T:
        """Return `make(self, *inputs)`, kept with the world until it is asked for with other objects.

        For callers that simulate one start, or the same times, under several commands. Tensors that were changed in
        place are others.
        """
        kept: dict[object, object] = self.__dict__.setdefault("_kept", {})
        parts = [x.tensors if isinstance(x, State) else (x,) for x in inputs]
        versions = [tensor._version for tensors in parts for tensor in tensors]
        found = cast("tuple[tuple[State | Tensor, ...], list[int], T] | None", kept.get((World.latest, make)))
        if found is None or any(a is not b for a, b in zip(found[0], inputs, strict=True)) or found[1] != versions:
            found = inputs, versions, make(self, *inputs)
            kept[World.latest, make] = found
        return found[2]

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the state."""
        return [body.name for body in self.bodies]

    @property
    def free(self) -> list[int]:
        """Indices of the free bodies."""
        return [index for index, body in enumerate(self.bodies) if body.free]

    @property
    def tracked(self) -> list[int]:
        """Indices of the bodies that physics moves: free ones, and links that joints or a free root move."""
        return [index for index in range(len(self.bodies)) if self.moves(index)]

    @property
    def driven(self) -> list[str]:
        """Names of the bodies whose tracks are commands: driven ones, and roots of driven chains."""
        roots = {chain.root for chain in self.chains if chain.base == "driven"}
        return [body.name for body in self.bodies if body.motion == "driven" or body.name in roots]

    def chain_of(self, index: int) -> int:
        """Return the number of the chain of which a body is a link, -1 for none."""
        name = self.bodies[index].name
        return next((k for k, chain in enumerate(self.chains) if name in chain.links), -1)

    def moves(self, index: int) -> bool:
        """Return whether contact moves a body: a free one, or a link that a joint or a free root moves."""
        chain = self.chain_of(index) if self.chains else -1
        return self.bodies[index].free or (chain >= 0 and self.chains[chain].moves(self.bodies[index].name))

    @property
    def ground(self) -> tuple[Tensor, Tensor]:
        """Normal (3,) of the ground and its offset (1 or B,) [m] along the normal.

        Raises:
            UsageError: If the world has no ground.
        """
        if self.ground_normal is None or self.ground_offset is None:
            raise UsageError("this world has no ground.", todo="give the ground in capture.toml, under [world].")
        return self.ground_normal, self.ground_offset

    def surface(self, index: int) -> FixedSurface | None:
        """Return the fixed surface of the second index of a pair, -2 for the first one; None for others."""
        return self.surfaces[-2 - index] if index < -1 else None

    def named(self, index: int) -> str:
        """Return what messages call the second of a pair: the ground, a surface or a body."""
        surface = self.surface(index)
        if surface is not None:
            return f"surface '{surface.name}'"
        return "the ground" if index < 0 else f"body '{self.bodies[index].name}'"

    def substeps(self, times_s: Tensor) -> list[int]:
        """Return the number of steps in each interval of times (B, T) [s], none of them longer than `step_s`.

        Raises:
            InputDataError: If these are more than `MOST_STEPS`.
        """
        longest = times_s.detach().diff(dim=1).amax(0).tolist()
        steps = sum(longest) / self.step_s
        if steps > MOST_STEPS:
            raise InputDataError(
                f"{sum(longest):.4g} s of motion in steps of {self.step_s:g} s are {steps:.3g} steps.",
                f"up to {MOST_STEPS:.3g} steps.",
                "check the times (seconds?) and the step_s of the model.",
            )
        return [max(1, math.ceil(length / self.step_s - 1e-6)) for length in longest]

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """The pairs that can touch: each free body with the ground (-1), fixed surfaces (-2, ...) and other bodies.

        Links of chains are as free bodies; but of one chain only those touch each other that it lists, and a link that
        no joint moves only touches what moves.
        """
        if not self.touching:
            return []
        solid = [k for k, body in enumerate(self.bodies) if body.radii.shape[-1] > 0]
        moving = [k for k in solid if self.moves(k)]
        within = {name for chain in self.chains for name in chain.within}
        inner = {k for k in solid if self.bodies[k].name in within}
        outer = [k for k in moving if k not in inner]
        on_ground = [] if self.ground_normal is None else [(i, -1) for i in outer]
        on_surfaces = [(i, -2 - s) for i in outer for s in range(len(self.surfaces))]
        return on_ground + on_surfaces + self._between(solid, moving, inner)

    def _between(self, solid: Sequence[int], moving: Sequence[int], inner: set[int]) -> list[tuple[int, int]]:
        """Return the pairs of solid bodies that can touch each other, of which one at least moves: that one first.

        Those that are `inner` touch nothing but links of their chain.
        """
        chain = {k: self.chain_of(k) if self.chains else -1 for k in solid}
        own = {frozenset(pair) for one in self.chains for pair in one.touching}
        names = self.body_names
        apart = [
            (i, j)
            for i, j in combinations(solid, 2)
            if (frozenset((names[i], names[j])) in own if 0 <= chain[i] == chain[j] else not inner & {i, j})
        ]
        ordered = [(i, j) if i in moving else (j, i) for i, j in apart]
        return [pair for pair in ordered if pair[0] in moving]

    @property
    def laws(self) -> tuple[ContactLaw | PaperLaw, ...]:
        """All contact laws: that of pairs without a law of their own, then those of `pair_laws`."""
        return (self.contact, *self.pair_laws.values())

    def material_of(self, index: int) -> str | None:
        """Return the material of a body, of the ground for -1, of a surface below."""
        surface = self.surface(index)
        if surface is not None:
            return surface.material
        return self.ground_material if index < 0 else self.bodies[index].material

    def materials_of(self, a: int, b: int) -> tuple[str, str] | None:
        """Return the materials of a pair, by index, where they have a law of their own; else None."""
        return self.pair_between(self.material_of(a), self.material_of(b))

    def law_of(self, a: int, b: int) -> ContactLaw | PaperLaw:
        """Return the contact law of two bodies, by index; -1 is the ground, surfaces follow."""
        return self.law_between(self.material_of(a), self.material_of(b))

    def law_between(self, first: str | None, second: str | None) -> ContactLaw | PaperLaw:
        """Return the contact law of two materials in either order: `contact` where the pair has none of its own."""
        pair = self.pair_between(first, second)
        return self.contact if pair is None else self.pair_laws[pair]

    def pair_between(self, first: str | None, second: str | None) -> tuple[str, str] | None:
        """Return the pair of two materials where it has a law of its own, else None."""
        pair = None if first is None or second is None else pair_of(first, second)
        return pair if pair in self.pair_laws else None

    @property
    def up(self) -> Tensor:
        """Unit vector (1 or B, 3) against gravity; without gravity the ground's normal, or the world's z."""
        size = self.gravity.square().sum(-1, keepdim=True)
        other = torch.eye(3).to(self.gravity)[2] if self.ground_normal is None else self.ground_normal
        safe = torch.where(size > 0, size, torch.ones_like(size))
        return torch.where(size > 0, -self.gravity / safe.sqrt(), other)

    @staticmethod
    def from_model(
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
            friction, time, ratio = (
                tensor(v) for v in (numbers.friction, numbers.contact_time_s, numbers.damping_ratio)
            )
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
        return world._with_only_law() if file.pairs else world

    def _with_only_law(self) -> World:
        """Return the world; where all contacts are of one pair of materials, with the law of that pair as `contact`."""
        used = {self.materials_of(a, b) for a, b in self.pairs}
        only = next(iter(used)) if len(used) == 1 else None
        return self if only is None else replace(self, contact=self.pair_laws[only], pair_laws={})

    def with_body(self, index: int, **changes: Tensor) -> World:
        """Return a copy in which some tensors of one body are replaced; other spheres have no hull."""
        bodies = list(self.bodies)
        other = {"hull": None} if {"centers", "radii"} & set(changes) else {}
        bodies[index] = replace(bodies[index], **changes, **other)
        return replace(self, bodies=tuple(bodies))


@dataclass(frozen=True)
class State:
    """Poses and velocities of all bodies at one time, in the order of the world's bodies."""

    position_m: Tensor
    """Origins of the body frames, world frame [m], shape (B, nb, 3)."""
    quat_wxyz: Tensor
    """Orientations, body to world, shape (B, nb, 4)."""
    velocity_m_s: Tensor
    """Velocities of the body frames' origins, world frame [m/s], shape (B, nb, 3)."""
    omega_body_rad_s: Tensor
    """Angular velocities, body frame [rad/s], shape (B, nb, 3)."""

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The fields in their order, from which `State(*tensors)` is made again."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def at(self, rows: Tensor | Sequence[int] | slice) -> State:
        """Return the state at some rows of the batch."""
        return State(*(getattr(self, field.name)[rows] for field in fields(self)))

    def repeat(self, times: int) -> State:
        """Return the state with its batch repeated, as `Tensor.repeat` does."""
        return State(*(getattr(self, field.name).repeat(times, 1, 1) for field in fields(self)))

    @staticmethod
    def joined(*states: State) -> State:
        """Concatenate the batches of several states."""
        return State(*(torch.cat([getattr(state, field.name) for state in states]) for field in fields(State)))


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


def stretched_inertia(inertia: Tensor, stretch: Tensor) -> Tensor:
    """Return the inertia (n, 3, 3) of a mass stretched by symmetric matrices S (n, 3, 3).

    With C = tr(I)/2 - I the second moments (Wensing et al., "Linear matrix inequalities for physically consistent
    inertial parameter identification", 2018): C' = S C S, I' = tr(C') - C'.
    """
    eye = torch.eye(3, dtype=inertia.dtype, device=inertia.device)
    moment = 0.5 * _trace(inertia) * eye - inertia
    # the change is added, so that no stretch changes nothing bit for bit
    change = stretch @ moment @ stretch - moment
    change = 0.5 * (change + change.transpose(-1, -2))
    return inertia + _trace(change) * eye - change


def _trace(matrix: Tensor) -> Tensor:
    return matrix.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]


def symmetric(six: tuple[float, ...]) -> np.ndarray:
    """Return the symmetric matrix (3, 3) of (xx, yy, zz) or (xx, yy, zz, xy, xz, yz)."""
    xx, yy, zz, xy, xz, yz = (*six, 0.0, 0.0, 0.0)[:6]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def inertia_elements(matrix: np.ndarray) -> tuple[float, float, float, float, float, float]:
    """Return the elements (xx, yy, zz, xy, xz, yz) of a symmetric matrix (3, 3)."""
    xx, yy, zz, xy, xz, yz = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    return xx, yy, zz, xy, xz, yz

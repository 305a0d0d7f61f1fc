"""What the engine simulates: bodies of spheres, the ground, gravity and the contact law."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...schemas import InputDataError, UsageError
from .contact import ContactLaw
from .distance import plane_contacts
from .effects.effect import ActiveEffect
from .effects.registry import load_effect
from .published import PublishedLaw

if TYPE_CHECKING:
    from ...datasets.models import Model
    from ...schemas import EffectModel


@dataclass(frozen=True)
class Body:
    """A rigid body made of spheres. Every tensor has a batch dimension of 1 or B.

    mass (B,) [kg]; inertia (B, 3, 3) [kg m2] about the centre of mass, body axes; com (B, 3) [m] in the body frame;
    centers (B, N, 3) [m] in the body frame; radii (B, N) [m]; place (1, 7): position [m] and quat_wxyz of a fixed body;
    on_plane (K,): which spheres the ground can touch, all where None.
    """

    name: str
    motion: str
    mass: Tensor
    inertia: Tensor
    com: Tensor
    centers: Tensor
    radii: Tensor
    place: Tensor | None = None
    on_plane: Tensor | None = None

    @property
    def free(self) -> bool:
        """Whether the body moves by physics."""
        return self.motion == "free"


@dataclass(frozen=True)
class World:
    """The bodies and what surrounds them.

    gravity (B, 3) [m/s2]; ground normal (3,) and offset (B,) [m]; contact: the contact law; step_s: largest step;
    sweeps: of the closed form over all contacts; effects: what acts beyond gravity and contact; touching: whether
    bodies touch at all (without, every motion is free flight, and costs a tenth); rolls_on: the device that
    `dispatch.rollout` takes rollouts to and their results back from, None for where the tensors lie; own: by episode,
    its own values of effects' parameters, `effect.parameter` by name.
    """

    bodies: tuple[Body, ...]
    gravity: Tensor
    ground_normal: Tensor | None
    ground_offset: Tensor | None
    contact: ContactLaw | PublishedLaw
    step_s: float = 0.001
    sweeps: int = 10
    effects: tuple[ActiveEffect, ...] = ()
    touching: bool = True
    rolls_on: str | None = None
    own: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, in the order of the state."""
        return [body.name for body in self.bodies]

    @property
    def free(self) -> list[int]:
        """Indices of the free bodies."""
        return [index for index, body in enumerate(self.bodies) if body.free]

    def substeps(self, times_s: Tensor) -> list[int]:
        """Return the number of steps in each interval of times (B, T) [s], none of them longer than `step_s`."""
        longest = times_s.detach().diff(dim=1).amax(0).tolist()
        return [max(1, math.ceil(length / self.step_s - 1e-6)) for length in longest]

    @property
    def up(self) -> Tensor:
        """Unit vector (1 or B, 3) against gravity; without gravity the ground's normal, or the world's z."""
        size = self.gravity.square().sum(-1, keepdim=True)
        other = torch.eye(3).to(self.gravity)[2] if self.ground_normal is None else self.ground_normal
        safe = torch.where(size > 0, size, torch.ones_like(size))
        return torch.where(size > 0, -self.gravity / safe.sqrt(), other)

    @staticmethod
    def from_model(
        model: Model, dtype: torch.dtype = torch.float64, device: str = "cpu", geometry: World | None = None
    ) -> World:
        """Build the world of a fitted model.

        Args:
            model: The model.
            dtype: Of all tensors.
            device: Of all tensors.
            geometry: A world of the same model with other numbers, to share the colliding spheres with.

        Raises:
            InputDataError: If the model has no fitted physics yet.
        """
        file = model.file
        if file.contact is None:
            raise InputDataError(
                f"{model.root}: the model has no fitted physics, only the scene.",
                todo="run 'cgwm fit CAPTURE --stage phys-geo --from MODEL --out NEW' first.",
            )

        def tensor(value: object) -> Tensor:
            return torch.as_tensor(np.asarray(value), dtype=dtype, device=device)[None]

        bodies = []
        for index, body in enumerate(file.bodies):
            if geometry is None:
                spheres = model.collision[body.name]
                centers, radii = tensor(spheres.means), tensor(spheres.scales * body.radius_factor)
                place = tensor((*body.photo_pose.position_m, *body.photo_pose.quat_wxyz))
                on_plane = plane_contacts(centers[0], radii[0])
            else:
                known = geometry.bodies[index]
                centers, radii, place, on_plane = known.centers, known.radii, known.place, known.on_plane
            bodies.append(
                Body(
                    body.name,
                    body.motion,
                    tensor(body.mass_kg),
                    tensor(symmetric(body.inertia_kg_m2)),
                    tensor(body.com_m),
                    centers,
                    radii,
                    place,
                    on_plane,
                )
            )
        law = ContactLaw(
            *(tensor(v) for v in (file.contact.friction, file.contact.contact_time_s, file.contact.damping_ratio))
        )
        ground = file.ground
        return World(
            tuple(bodies),
            tensor(file.gravity_m_s2),
            tensor(ground.normal)[0] if ground else None,
            tensor(ground.offset_m) if ground else None,
            law,
            file.solver.step_s,
            file.solver.sweeps,
            tuple(_active(effect, str(model.root), tensor(0.0)) for effect in file.effects),
        )

    def with_body(self, index: int, **changes: Tensor) -> World:
        """Return a copy in which some tensors of one body are replaced."""
        bodies = list(self.bodies)
        bodies[index] = replace(bodies[index], **changes)
        return replace(self, bodies=tuple(bodies))


@dataclass(frozen=True)
class State:
    """Poses and velocities of all bodies at one time, in the order of the world's bodies.

    position_m (B, nb, 3): body frame origin, world; quat_wxyz (B, nb, 4); velocity_m_s (B, nb, 3): of the body frame
    origin, world; omega_body_rad_s (B, nb, 3): body frame.
    """

    position_m: Tensor
    quat_wxyz: Tensor
    velocity_m_s: Tensor
    omega_body_rad_s: Tensor

    def at(self, rows: Tensor | Sequence[int] | slice) -> State:
        """Return some rows of the batch."""
        return State(*(getattr(self, field.name)[rows] for field in fields(self)))

    def repeat(self, times: int) -> State:
        """Return the batch repeated, as `Tensor.repeat` does."""
        return State(*(getattr(self, field.name).repeat(times, 1, 1) for field in fields(self)))

    @staticmethod
    def joined(*states: State) -> State:
        """Return the batches one after the other."""
        return State(*(torch.cat([getattr(state, field.name) for state in states]) for field in fields(State)))


def _active(entry: EffectModel, where: str, like: Tensor) -> ActiveEffect:
    try:
        effect = load_effect(entry.name)
        active = ActiveEffect.of(effect, entry.parameters, like)
    except UsageError as error:
        raise InputDataError(f"{where}: its effect: {error.found}", error.allowed, error.todo) from error
    except KeyError as error:
        raise InputDataError(f"{where}: {error.args[0]}.", todo="fit the model again with this effect.") from error
    for number in effect.parameters:
        value = float(active.values[number.name])
        low = 0.0 if number.nonnegative else -number.limit
        if not low <= value <= number.limit:
            raise InputDataError(
                f"{where}: {effect.name}.{number.name} is {value:g} {number.unit}.", f"{low:g} to {number.limit:g}."
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

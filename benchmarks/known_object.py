"""What benchmarks of hands share: the model of a convex object whose numbers are known, and errors of the plant."""

from __future__ import annotations

import numpy as np
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.control.horizon import Array
from cgwm.schemas import BodyModel, ContactParameters, FittedParameter, ModelFile, Pose, Provenance


def known_object(
    balls: tuple[Array, Array], mass_kg: float, inertia_kg_m2: Array, com_m: Array, contact: ContactParameters,
    friction_spread: float = 0.0,
) -> Model:  # fmt: skip
    """Return the model of an object, whose body has the name `object`.

    Args:
        balls: Centres (n, 3) and radii (n,) of the balls whose hull is the object, in its frame [m].
        mass_kg: Mass [kg].
        inertia_kg_m2: Inertia about the centre of mass, in its frame, shape (3, 3) [kg m2].
        com_m: Centre of mass, shape (3,) [m].
        contact: Numbers of the contact.
        friction_spread: Relative standard error of the friction, under which draws of the model are made; 0 for none.
    """
    centers, radii = balls
    xx, yy, zz, xy, xz, yz = (float(inertia_kg_m2[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    x, y, z = map(float, com_m)
    body = BodyModel(
        name="object",
        motion="free",
        mass_kg=mass_kg,
        inertia_kg_m2=(xx, yy, zz, xy, xz, yz),
        com_m=(x, y, z),
        photo_pose=Pose(position_m=(0.0, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0)),
        convex=True,
    )
    friction = contact.friction
    unsure = FittedParameter(
        name="friction", unit="1", estimate=friction, std_error=friction_spread * friction,
        bounds=(0.1 * friction, 10 * friction),
    )  # fmt: skip
    parameters = (unsure,) if friction_spread else ()
    file = ModelFile(bodies=(body,), contact=contact, parameters=parameters, provenance=Provenance(capture="none"))
    spheres = Splats(centers, radii / 2, np.full(len(radii), 0.95), np.full((len(radii), 3), 0.5))
    return Model(root=None, file=file, collision={"object": spheres})


SPREAD = 0.7
"""Relative standard error of friction in draws: log-normal, so that half and twice the friction are one of it away."""


def sensing_of(words: str) -> dict[str, float]:
    """Return what a controller is told of the states of a plant whose errors `errors_of` reads."""
    return {name: value for name, value in errors_of(words).items() if name.startswith("noise")}


def errors_of(words: str) -> dict[str, float]:
    """Return the fields of a plant that words like `friction_factor=0.5,delay_s=0.03` set."""
    return {name: float(value) for name, _, value in (one.partition("=") for one in words.split(",") if one)}

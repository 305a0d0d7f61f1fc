"""What benchmarks of hands share: the model of a convex object whose numbers are known, and errors of the plant."""

from __future__ import annotations

import numpy as np
from cgwm.datasets.models.model import Model
from cgwm.datasets.shapes.ply import Splats
from cgwm.pipeline.control.horizon import Array
from cgwm.schemas import BodyModel, ContactParameters, ModelFile, Pose, Provenance


def known_object(
    balls: tuple[Array, Array], mass_kg: float, inertia_kg_m2: Array, com_m: Array, contact: ContactParameters
) -> Model:
    """Return the model of an object, whose body has the name `object`.

    Args:
        balls: Centres (n, 3) and radii (n,) of the balls whose hull is the object, in its frame [m].
        mass_kg: Mass [kg].
        inertia_kg_m2: Inertia about the centre of mass, in its frame, shape (3, 3) [kg m2].
        com_m: Centre of mass, shape (3,) [m].
        contact: Numbers of the contact.
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
    file = ModelFile(bodies=(body,), contact=contact, provenance=Provenance(capture="none"))
    spheres = Splats(centers, radii / 2, np.full(len(radii), 0.95), np.full((len(radii), 3), 0.5))
    return Model(root=None, file=file, collision={"object": spheres})


def errors_of(words: str) -> dict[str, float]:
    """Return the fields of a plant that words like `friction_factor=0.5,delay_s=0.03` set."""
    return {name: float(value) for name, _, value in (one.partition("=") for one in words.split(",") if one)}

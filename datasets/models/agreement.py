"""Agreement of the parts of a model with each other: its parameters, contact law, bodies, effects and spheres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ...schemas import BodyModel, Correlation, InputDataError, ModelFile
from ..shapes.ply import Splats

TOLERANCE = 1e-3
"""Largest relative difference of the same number in two places: some are rounded by hand."""
FARTHEST_COM = 2.0
"""Largest distance of the centre of mass from the middle of a body's spheres, in halves of their bounding box's
diagonal; of a solid body it is below 1, but spheres may lack a part."""


def require_agreement(file: ModelFile, colliding: Mapping[str, Splats], path: Path) -> None:
    """Refuse a model whose parts contradict each other.

    Args:
        file: The model.
        colliding: Colliding spheres by body, body frame [m].
        path: Its `model.json`, for messages.

    Raises:
        InputDataError: If a parameter differs from the contact law, body or effect that it is of; correlations are of
            no parameters, or cannot be; a body that can touch has no spheres; or its centre of mass is far from them.
    """
    for block in file.correlations:
        _require_possible(block, file, path)
    estimates = {parameter.name: parameter.estimate for parameter in file.parameters}
    for name, value, where in _values(file):
        estimate = estimates.get(name, value)
        if abs(estimate - value) > TOLERANCE * max(abs(estimate), abs(value)) + 1e-9:
            raise InputDataError(
                f"{path}: the parameter '{name}' is {estimate:g}, but {where} is {value:g}.",
                "the same number in both places.",
                "correct one of the two, or fit the model again.",
            )
    for body in file.bodies:
        _require_spheres(body, file, colliding.get(body.name), path)


def _values(file: ModelFile) -> Iterator[tuple[str, float, str]]:
    """Yield the names of parameters, their values in the model, and the places of those."""
    if file.contact is not None:
        for name in type(file.contact).model_fields:
            yield name, getattr(file.contact, name), f"contact.{name}"
    for body in file.bodies:
        yield f"{body.name}.mass_kg", body.mass_kg, f"mass_kg of body '{body.name}'"
        for axis, value in zip("xyz", body.com_m, strict=True):
            yield f"{body.name}.com_{axis}_m", value, f"com_m of body '{body.name}' along {axis}"
    for effect in file.effects:
        name = effect.name.partition("@")[0]
        if ":" in name:
            continue  # the name of a custom effect is known only to its source
        for key, value in effect.parameters.items():
            yield f"{name}.{key}", value, f"{key} of effect '{effect.name}'"


def _require_possible(block: Correlation, file: ModelFile, path: Path) -> None:
    known = {parameter.name for parameter in file.parameters}
    other = next((name for name in block.parameters if name not in known), None)
    if other is not None:
        raise InputDataError(
            f"{path}: correlations name '{other}', which is none of the model's parameters.",
            f"{', '.join(sorted(known)) or 'none'}.",
            "fit the model again.",
        )
    least = float(np.linalg.eigvalsh(np.asarray(block.matrix, float)).min()) if block.matrix else 0.0
    if least < -TOLERANCE:
        raise InputDataError(
            f"{path}: the correlations of {', '.join(block.parameters)} contradict each other: an eigenvalue of their "
            f"matrix is {least:.3g}.",
            "eigenvalues from 0 up.",
            "fit the model again.",
        )


def _require_spheres(body: BodyModel, file: ModelFile, spheres: Splats | None, path: Path) -> None:
    if spheres is None or not len(spheres):
        if file.contact is not None:
            raise InputDataError(
                f"{path}: body '{body.name}' has no collision spheres, but the model has contacts.",
                "splats or collision: the name of a .ply file of the model.",
                "get the model again from where it came, or fit it again.",
            )
        return
    means, radii = np.asarray(spheres.means, float), np.asarray(spheres.scales, float)[:, None] * body.radius_factor
    low, high = (means - radii).min(0), (means + radii).max(0)
    reach = FARTHEST_COM * 0.5 * float(np.linalg.norm(high - low))
    distance = float(np.linalg.norm(np.asarray(body.com_m) - 0.5 * (low + high)))
    if distance > reach:
        raise InputDataError(
            f"{path}: com_m of body '{body.name}' is {distance:.3g} m from the middle of its spheres.",
            f"at most {reach:.3g} m.",
            "correct com_m (body frame, metres).",
        )

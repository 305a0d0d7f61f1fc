"""Agreement of the parts of a model with each other: its parameters, contact law, bodies, effects and spheres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ...schemas import BodyModel, Correlation, InputDataError, ModelFile
from ...schemas.materials import of_pair
from ...schemas.model import ContactParameters
from ..capture.consistency import check_gravity
from ..shapes.ply import Splats

TOLERANCE = 1e-3
"""Largest relative difference of the same number in two places: some are rounded by hand."""
FARTHEST_COM = 2.0
"""Largest distance of the centre of mass from the middle of a body's spheres, in halves of their bounding box's
diagonal; of a solid body it is below 1, but spheres may lack a part."""

LARGEST_BODY_M = 1e4
"""Largest reach of a body's spheres from its origin [m]; rollouts start from heights of several such lengths."""
LARGEST = 2.0
"""Largest ratio of the reach of a body's spheres to that of its given shape, and of a moment of inertia to that of all
its mass at that reach."""


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
    if not file.provenance.config.get("accept_units", False):
        check_gravity(file.gravity_m_s2, file.ground, str(path))
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


def require_contact(file: ModelFile, path: Path) -> None:
    """Refuse a model with parameters of the contact law, but without that law.

    Raises:
        InputDataError: If it has; whatever needs the law says so by itself, so only `validate` asks.
    """
    _require_pairs(file, path)
    names = {parameter.name for parameter in file.parameters} & set(ContactParameters.model_fields)
    if file.contact is None and names:
        raise InputDataError(
            f"{path}: the parameter '{min(names)}' is of the contact law, but contact is null.",
            "contact with friction, contact_time_s and damping_ratio.",
            "fit the model again.",
        )


def _require_pairs(file: ModelFile, path: Path) -> None:
    """Refuse a contact parameter of a pair of materials that the model does not have."""
    known = {of_pair(name, entry.materials) for entry in file.pairs for name in ContactParameters.model_fields}
    for parameter in file.parameters:
        base, bracket, _ = parameter.name.partition("[")
        if bracket and base in ContactParameters.model_fields and parameter.name not in known:
            raise InputDataError(
                f"{path}: the parameter '{parameter.name}' is of a pair of materials that pairs does not have.",
                f"{', '.join(sorted(known)) or 'none: pairs is empty'}.",
                "correct the name, or fit the model again.",
            )


def _values(file: ModelFile) -> Iterator[tuple[str, float, str]]:
    """Yield the names of parameters, their values in the model, and the places of those."""
    yield from _contact_values(file)
    for body in file.bodies:
        yield f"{body.name}.mass_kg", body.mass_kg, f"mass_kg of body '{body.name}'"
        for axis, value in zip("xyz", body.com_m, strict=True):
            yield f"{body.name}.com_{axis}_m", value, f"com_m of body '{body.name}' along {axis}"
    yield from _effect_values(file)


def _contact_values(file: ModelFile) -> Iterator[tuple[str, float, str]]:
    """Yield those of the contact law, and of the laws of pairs of materials."""
    if file.contact is not None:
        for name in type(file.contact).model_fields:
            yield name, getattr(file.contact, name), f"contact.{name}"
    for entry in file.pairs:
        for name in ContactParameters.model_fields:
            place = f"{name} of the pair {' and '.join(entry.materials)}"
            yield of_pair(name, entry.materials), getattr(entry, name), place


def _effect_values(file: ModelFile) -> Iterator[tuple[str, float, str]]:
    """Yield those of the effects whose parameters the library names."""
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
    _require_size(body, spheres, path)
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


def _require_size(body: BodyModel, spheres: Splats, path: Path) -> None:
    """Refuse moments of inertia that no body within the spheres has, and spheres far larger than the given shape."""
    reach = spheres.reach_m(body.radius_factor)
    if reach > LARGEST_BODY_M:
        raise InputDataError(
            f"{path}: the spheres of body '{body.name}' reach {reach:.3g} m from its origin.",
            f"at most {LARGEST_BODY_M:g} m.",
            "get the model again from where it came, or fit it again.",
        )
    xx, yy, zz, xy, xz, yz = body.inertia_kg_m2
    greatest = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[-1])
    most = LARGEST * body.mass_kg * spheres.reach_m(body.radius_factor, body.com_m) ** 2
    if greatest > most:
        raise InputDataError(
            f"{path}: inertia_kg_m2 of body '{body.name}' has the moment {greatest:.3g} kg m2.",
            f"at most {most:.3g} kg m2 for {body.mass_kg:g} kg within its spheres.",
            "correct mass_kg and inertia_kg_m2, or fit the model again.",
        )
    size = _size(body)
    if size is not None and not size / LARGEST <= reach <= LARGEST * size:
        raise InputDataError(
            f"{path}: the spheres of body '{body.name}' reach {reach:.3g} m from its origin; its shape reaches "
            f"{size:.3g} m.",
            "spheres and shape of one size.",
            "fit the model again.",
        )


def _size(body: BodyModel) -> float | None:
    """Return the reach of a given box or ball from the body's origin [m]; None for other shapes."""
    if body.shape is None:
        return None
    if body.shape.sphere is not None:
        return body.shape.sphere.radius_m
    return None if body.shape.box is None else float(np.linalg.norm(body.shape.box.half_extents_m))

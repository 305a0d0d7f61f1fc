"""Physical parameters of a rollout, drawn from the posterior of the fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError
from scipy.special import ndtr, ndtri

from ...datasets.models.model import Model
from ...datasets.rollouts.rollouts import RolloutParameter
from ...schemas import (
    ArticulationModel,
    BodyModel,
    ContactParameters,
    Correlation,
    Distribution,
    EffectModel,
    FittedParameter,
    InputDataError,
    JointModel,
    ModelFile,
    did_you_mean,
    parse,
)
from ...schemas.materials import of_pair
from ..physics.contact_law import restitution
from ..physics.effects.registry import effect_of
from .distributions import draw

LOSSES = ("damping", "friction")
"""Numbers of a joint that a fit estimates."""
_UNITS = {"friction": "1", "contact_time_s": "s", "damping_ratio": "1", "ground_offset_m": "m", "mass_kg": "kg"}


def draw_parameters(
    file: ModelFile,
    spread: float,
    rng: np.random.Generator,
    replaced: Mapping[str, Distribution] | None = None,
    quantiles: Mapping[str, float] | None = None,
) -> tuple[ModelFile, tuple[RolloutParameter, ...]]:
    """Draw the physical parameters of a rollout from their joint posterior in the fit.

    Each is normal around its estimate with its standard error, truncated at its bounds; where the bounds are positive,
    the logarithm is normal, as in the fit. Parameters that were fitted together are drawn jointly by a Gaussian copula
    (Nelsen, An Introduction to Copulas, 2nd ed., 2.3): far from the bounds this is the joint normal posterior of the
    fit, and near a bound each marginal distribution is preserved.

    Args:
        file: The model.
        spread: Factor of the standard errors.
        rng: Source of randomness; one number is drawn for each parameter, varied or not, then for `replaced`.
        replaced: Distributions of parameters by name, in place of the fit's.
        quantiles: A quantile for each parameter, before those that were fitted together are correlated; None draws
            them.

    Returns:
        The model with these parameters, and the parameters; derived ones (restitution, ...) are consistent with them.
    """
    replaced = replaced or {}
    if quantiles is None:
        quantiles = {parameter.name: float(rng.random()) for parameter in file.parameters}
    quantiles = _joint_quantiles(file, quantiles)
    known = {parameter.name: parameter for parameter in file.parameters}
    values = {name: draw(replaced[name], rng) for name in sorted(replaced)}
    for name, parameter in known.items():
        if name not in values and can_vary(file, name):
            values[name] = _draw(parameter, spread, quantiles[name]) if spread > 0 else parameter.estimate
    names = [*known, *sorted(set(values) - set(known))]
    drawn = file
    for name in names:
        if name in values and not (name in known and values[name] == known[name].estimate):
            drawn = with_parameter(drawn, name, values[name])
    entries = []
    for name in names:
        old = known.get(name) or FittedParameter(name=name, unit=_unit(file, name), estimate=_present(file, name))
        value = values.get(name, _derived(drawn, name, old.estimate))
        entries.append(
            RolloutParameter(name=name, unit=old.unit, value=value, estimate=old.estimate, std_error=old.std_error)
        )
    return drawn, tuple(entries)


def _joint_quantiles(file: ModelFile, independent: Mapping[str, float]) -> dict[str, float]:
    """Return the quantile of each parameter within its own distribution, by the copula of those fitted together."""
    quantiles = {name: float(value) for name, value in independent.items()}
    for block in file.correlations:
        normal = _root(block) @ ndtri([quantiles[name] for name in block.parameters])
        quantiles |= dict(zip(block.parameters, map(float, ndtr(normal)), strict=True))
    return quantiles


def with_correlations(model: Model) -> ModelFile:
    """Return the file of a model with the correlations of its fit, including those stored in `fit.json` only."""
    found = model.fit.stages.get("phys-geo", {}).get("correlation")
    if model.file.correlations or not found:
        return model.file
    names = tuple(parameter.name for parameter in model.file.parameters[: len(found)])
    path = (model.root or Path("model")) / "fit.json"
    block = parse({"parameters": names, "matrix": found}, Correlation, path)
    return model.file.model_copy(update={"correlations": (block,)})


def require_admissible(file: ModelFile, replaced: Mapping[str, Distribution], source: str = "the plan") -> None:
    """Check that a plan's distributions are of existing parameters and stay within the admissible ranges.

    Args:
        file: The model.
        replaced: The distributions, by parameter.
        source: Where the plan comes from, for messages.

    Raises:
        InputDataError: If not, with the name, the admissible range and the given one.
    """
    legal = settable(file)
    for name, distribution in replaced.items():
        if name not in legal:
            raise InputDataError(
                f"{source}: [parameters] has '{name}', which is no parameter of this model.",
                f"{', '.join(legal)}.{did_you_mean(name, legal)}",
                "correct the name.",
            )
        low, high = distribution.support
        first, last = _bounds(file, name)
        if not (first <= low and high <= last):
            raise InputDataError(
                f"{source}: [parameters] {name} reaches from {low:g} to {high:g}.",
                f"{first:g} to {last:g} {_unit(file, name)}.",
                "narrow the distribution.",
            )
        for end in (low, high):
            try:
                ModelFile.model_validate(with_parameter(file, name, end).model_dump())
            except ValidationError as error:
                fault = error.errors()[0]["msg"]
                raise InputDataError(
                    f"{source}: [parameters] {name} reaches {end:g}: {fault}.", todo="narrow the distribution."
                ) from None


def settable(file: ModelFile) -> list[str]:
    """Return the names of all parameters that a rollout can set, fitted or not."""
    names = [parameter.name for parameter in file.parameters]
    names += [*ContactParameters.model_fields, "ground_offset_m"]
    names += [of_pair(name, entry.materials) for entry in file.pairs for name in ContactParameters.model_fields]
    names += [f"{body.name}.{key}" for body in file.bodies for key in ("mass_kg", "com_x_m", "com_y_m", "com_z_m")]
    names += [f"{joint.name}.{key}" for joint in _moving_joints(file) for key in LOSSES]
    names += [f"{_own_name(effect)}.{key}" for effect in file.effects for key in effect.parameters]
    return [name for name in dict.fromkeys(names) if can_vary(file, name)]


def _root(block: Correlation) -> np.ndarray:
    """Return the symmetric square root of a correlation matrix, which is unique and robust to rounding below 0."""
    values, vectors = np.linalg.eigh(np.asarray(block.matrix))
    return (vectors * np.sqrt(values.clip(0))) @ vectors.T


def _bounds(file: ModelFile, name: str) -> tuple[float, float]:
    """Return the admissible range of a parameter: from the fit or from an effect."""
    listed = next((parameter.bounds for parameter in file.parameters if parameter.name == name), None)
    if listed is not None:
        return listed
    owner, _, number = name.partition(".")
    for effect in file.effects:
        for entry in effect_of(effect).parameters if _own_name(effect) == owner else ():
            if entry.name == number:
                return (0.0 if entry.nonnegative else -entry.limit), entry.limit
    return -math.inf, math.inf


def _unit(file: ModelFile, name: str) -> str:
    owner, _, number = name.rpartition(".")
    joint = _joint_of(file, name)
    if joint is not None:
        turns = joint.kind == "hinge"
        return {"damping": "N m s/rad" if turns else "N s/m", "friction": "N m" if turns else "N"}[number]
    for effect in file.effects:
        loaded = effect_of(effect)
        for entry in (*loaded.parameters, *loaded.constants) if loaded.name == owner else ():
            if entry.name == number:
                return entry.unit
    base = name.partition("[")[0]
    return _UNITS.get(base if base in _UNITS else number, "m" if number.startswith("com_") else "1")


def _present(file: ModelFile, name: str) -> float:
    """Return the value of a parameter that is not in the model's list of fitted ones."""
    if name == "ground_offset_m" and file.ground is not None:
        return file.ground.offset_m
    if file.contact is not None and name in type(file.contact).model_fields:
        return getattr(file.contact, name)
    found = _of_pair(file, name)
    if found is not None:
        return getattr(file.pairs[found[0]], found[1])
    joint = _joint_of(file, name)
    if joint is not None:
        return getattr(joint, name.rpartition(".")[2])
    owner, _, number = name.partition(".")
    for effect in file.effects:
        if _own_name(effect) == owner:
            return effect.parameters[number]
    body = next(body for body in file.bodies if body.name == owner)
    return body.mass_kg if number == "mass_kg" else body.com_m["xyz".index(number.split("_")[1])]


def _derived(file: ModelFile, name: str, estimate: float) -> float:
    """Return a derived parameter from the drawn ones, else its estimate; formulas as in the stage phys-geo."""
    base = name.partition("[")[0]
    law = next((entry for entry in file.pairs if name == of_pair(base, entry.materials)), file.contact)
    mass = next((body.mass_kg for body in file.bodies if body.motion == "free"), None)
    if law is None or mass is None or base not in DERIVED:
        return estimate
    if base == "restitution":
        return float(restitution(torch.tensor(law.damping_ratio, dtype=torch.float64)))
    if base == "stiffness_n_m":
        return mass / law.contact_time_s**2
    return 2 * law.damping_ratio * mass / law.contact_time_s


DERIVED = ("restitution", "stiffness_n_m", "damping_n_s_m")
"""Parameters that are derived from the contact parameters and a mass."""


def _draw(parameter: FittedParameter, spread: float, quantile: float) -> float:
    """Return the quantile of the truncated normal (or log-normal) distribution of a parameter."""
    estimate, error = parameter.estimate, spread * (parameter.std_error or 0.0)
    low, high = parameter.bounds or (-math.inf, math.inf)
    if error == 0.0 or not low < estimate < high:
        return estimate
    logarithmic = low > 0.0
    if logarithmic:
        # To first order the standard error of a logarithm is the relative standard error.
        low, high, error, estimate = math.log(low), math.log(high), error / estimate, math.log(estimate)
    first, last = ndtr((low - estimate) / error), ndtr((high - estimate) / error)
    value = estimate + error * float(ndtri(first + quantile * (last - first)))
    value = min(max(value, low), high)
    return math.exp(value) if logarithmic else value


def can_vary(file: ModelFile, name: str) -> bool:
    """Return whether :func:`with_parameter` can set a parameter."""
    if name == "ground_offset_m":
        return file.ground is not None
    if (file.contact is not None and name in type(file.contact).model_fields) or _of_pair(file, name) is not None:
        return True
    owner, _, number = name.partition(".")
    if any(_own_name(effect) == owner and number in effect.parameters for effect in file.effects):
        return True
    if _joint_of(file, name) is not None or _factor_of(file, name) is not None:
        return True
    legal = ("mass_kg", *(f"com_{axis}_m" for axis in "xyz"))
    moments = tuple(f"moment_{axis}" for axis in "xyz") if any(p.name == name for p in file.parameters) else ()
    return number in (*legal, *moments) and any(body.name == owner for body in file.bodies)


def _of_pair(file: ModelFile, name: str) -> tuple[int, str] | None:
    """Return the index of the pair of materials that a parameter belongs to, and its name without it; else None."""
    for index, entry in enumerate(file.pairs):
        for number in ContactParameters.model_fields:
            if name == of_pair(number, entry.materials):
                return index, number
    return None


def _moving_joints(file: ModelFile) -> list[JointModel]:
    return [joint for one in file.articulations for joint in one.joints if joint.kind != "fixed"]


def _joint_of(file: ModelFile, name: str) -> JointModel | None:
    """Return the joint whose damping or dry friction a parameter is, else None."""
    owner, _, number = name.rpartition(".")
    return next((joint for joint in _moving_joints(file) if joint.name == owner and number in LOSSES), None)


def _factor_of(file: ModelFile, name: str) -> ArticulationModel | None:
    """Return the jointed body of a fitted share of mass, by its link, or factor of inertia, by its name; else None."""
    owner, _, number = name.rpartition(".")
    if not any(parameter.name == name for parameter in file.parameters):
        return None
    for one in file.articulations:
        if (number == "mass_factor" and owner in one.links) or (number == "inertia_factor" and owner == one.name):
            return one
    return None


def _with_loss(file: ModelFile, joint: JointModel, number: str, value: float) -> ModelFile:
    changed = joint.model_copy(update={number: value})
    articulations = tuple(
        one.model_copy(update={"joints": tuple(changed if each is joint else each for each in one.joints)})
        for one in file.articulations
    )
    return file.model_copy(update={"articulations": articulations})


def _with_factor(file: ModelFile, one: ArticulationModel, name: str, value: float) -> ModelFile:
    """Return the model with a share of mass, all masses together kept, or with a factor of all inertias.

    The model contains the estimate, so that the ratio to it counts.
    """
    owner, _, number = name.rpartition(".")
    ratio = value / next(parameter.estimate for parameter in file.parameters if parameter.name == name)
    links = [body for body in file.bodies if body.name in one.moving_links]
    if number == "inertia_factor":
        shares = {body.name: (1.0, ratio) for body in links}
    else:
        raw = {body.name: body.mass_kg * (ratio if body.name == owner else 1.0) for body in links}
        scale = sum(body.mass_kg for body in links) / sum(raw.values())
        shares = {body.name: (raw[body.name] * scale / body.mass_kg,) * 2 for body in links}
    bodies = tuple(_scaled(body, *shares.get(body.name, (1.0, 1.0))) for body in file.bodies)
    return file.model_copy(update={"bodies": bodies})


def _scaled(body: BodyModel, mass: float, inertia: float) -> BodyModel:
    moments = tuple(entry * inertia for entry in body.inertia_kg_m2)
    return body.model_copy(update={"mass_kg": body.mass_kg * mass, "inertia_kg_m2": moments})


def _own_name(effect: EffectModel) -> str:
    """Return the name of an effect as it occurs in the names of its parameters."""
    return effect_of(effect).name if ":" in effect.name or "@" in effect.name else effect.name


def with_parameter(file: ModelFile, name: str, value: float) -> ModelFile:
    """Return the model with one physical parameter set; the inertia scales with the mass.

    Raises:
        InputDataError: If the model has no such parameter.
    """
    if not can_vary(file, name):
        legal = settable(file)
        raise InputDataError(
            f"the model has no physical parameter '{name}'.",
            f"{', '.join(legal)}.{did_you_mean(name, legal)}",
            todo="correct the name in the plan.",
        )
    if name == "ground_offset_m" and file.ground is not None:
        return file.model_copy(update={"ground": file.ground.model_copy(update={"offset_m": value})})
    if file.contact is not None and name in type(file.contact).model_fields:
        return file.model_copy(update={"contact": file.contact.model_copy(update={name: value})})
    found = _of_pair(file, name)
    if found is not None:
        pairs = list(file.pairs)
        pairs[found[0]] = pairs[found[0]].model_copy(update={found[1]: value})
        return file.model_copy(update={"pairs": tuple(pairs)})
    joint, factor = _joint_of(file, name), _factor_of(file, name)
    if joint is not None:
        return _with_loss(file, joint, name.rpartition(".")[2], value)
    if factor is not None:
        return _with_factor(file, factor, name, value)
    owner, _, number = name.partition(".")
    effects = tuple(
        effect.model_copy(update={"parameters": {**effect.parameters, number: value}})
        if _own_name(effect) == owner
        else effect
        for effect in file.effects
    )
    if number.startswith(
        "moment_"
    ):  # a factor of the value before the fit; the inertia of the model contains the estimate
        value /= next(parameter.estimate for parameter in file.parameters if parameter.name == name)
    bodies = tuple(_with_number(body, number, value) if body.name == owner else body for body in file.bodies)
    return file.model_copy(update={"bodies": bodies, "effects": effects})


def _with_number(body: BodyModel, number: str, value: float) -> BodyModel:
    if number == "mass_kg":
        inertia = tuple(entry * value / body.mass_kg for entry in body.inertia_kg_m2)
        return body.model_copy(update={"mass_kg": value, "inertia_kg_m2": inertia})
    if number.startswith("moment_"):
        xx, yy, zz, xy, xz, yz = body.inertia_kg_m2
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        axis = "xyz".index(number[-1])
        moments[axis] *= math.sqrt(value)
        moments[:, axis] *= math.sqrt(value)
        new = np.trace(moments) * np.eye(3) - moments
        six = tuple(float(new[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
        return body.model_copy(update={"inertia_kg_m2": six})
    com = list(body.com_m)
    com["xyz".index(number.split("_")[1])] = value
    return body.model_copy(update={"com_m": tuple(com)})


def not_varied(file: ModelFile) -> list[str]:
    """Return the names of fitted parameters that rollouts keep at their estimate, because they cannot be set."""
    return [
        p.name
        for p in file.parameters
        if p.std_error and p.name.partition("[")[0] not in DERIVED and not can_vary(file, p.name)
    ]

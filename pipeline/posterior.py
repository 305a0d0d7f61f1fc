"""Physical parameters of a rollout, drawn from what the fit knows about them."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtr, ndtri

from ..datasets.rollouts import RolloutParameter
from ..schemas import BodyModel, EffectModel, InputDataError, ModelFile, Parameter
from .physics.effects.registry import load_effect


def draw_parameters(
    file: ModelFile, spread: float, rng: np.random.Generator
) -> tuple[ModelFile, tuple[RolloutParameter, ...]]:
    """Draw the physical parameters of a rollout from what the fit knows about them.

    Each is drawn independently (the fit's covariances are not stored): normal about its estimate with its standard
    error, cut off at its bounds; where the bounds are positive, the logarithm is normal, as in the fit.

    Args:
        file: The model.
        spread: Factor of the standard errors.
        rng: Source of randomness; one number is drawn for each parameter, varied or not.

    Returns:
        The model with these parameters, and the parameters.
    """
    drawn = []
    for parameter in file.parameters:
        quantile = float(rng.random())
        varied = can_vary(file, parameter.name) and spread > 0
        value = _draw(parameter, spread, quantile) if varied else parameter.estimate
        file = with_parameter(file, parameter.name, value) if varied else file
        entry = RolloutParameter(parameter.name, parameter.unit, value, parameter.estimate, parameter.std_error)
        drawn.append(entry)
    return file, tuple(drawn)


def _draw(parameter: Parameter, spread: float, quantile: float) -> float:
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
    """Whether a parameter's name is one that :func:`with_parameter` can set."""
    if name == "ground_offset_m":
        return file.ground is not None
    if file.contact is not None and name in type(file.contact).model_fields:
        return True
    owner, _, number = name.partition(".")
    if any(_own_name(effect) == owner and number in effect.parameters for effect in file.effects):
        return True
    legal = ("mass_kg", "com_x_m", "com_y_m", "com_z_m")
    return number in legal and any(body.name == owner for body in file.bodies)


def _own_name(effect: EffectModel) -> str:
    """Return the name that an effect gives itself, which its parameters carry."""
    return load_effect(effect.name).name if ":" in effect.name or "@" in effect.name else effect.name


def with_parameter(file: ModelFile, name: str, value: float) -> ModelFile:
    """Return the model with one physical parameter set; a mass takes the inertia along in proportion.

    Raises:
        InputDataError: If the model has no such parameter.
    """
    if not can_vary(file, name):
        raise InputDataError(f"the model has no physical parameter '{name}'.")
    if name == "ground_offset_m" and file.ground is not None:
        return file.model_copy(update={"ground": file.ground.model_copy(update={"offset_m": value})})
    if file.contact is not None and name in type(file.contact).model_fields:
        return file.model_copy(update={"contact": file.contact.model_copy(update={name: value})})
    owner, _, number = name.partition(".")
    effects = tuple(
        effect.model_copy(update={"parameters": {**effect.parameters, number: value}})
        if _own_name(effect) == owner
        else effect
        for effect in file.effects
    )
    bodies = tuple(_with_number(body, number, value) if body.name == owner else body for body in file.bodies)
    return file.model_copy(update={"bodies": bodies, "effects": effects})


def _with_number(body: BodyModel, number: str, value: float) -> BodyModel:
    if number == "mass_kg":
        inertia = tuple(entry * value / body.mass_kg for entry in body.inertia_kg_m2)
        return body.model_copy(update={"mass_kg": value, "inertia_kg_m2": inertia})
    com = list(body.com_m)
    com["xyz".index(number.split("_")[1])] = value
    return body.model_copy(update={"com_m": tuple(com)})


def not_varied(file: ModelFile) -> list[str]:
    """Return the names of fitted parameters that rollouts keep at their estimate, because nothing here sets them."""
    return [p.name for p in file.parameters if p.std_error and not can_vary(file, p.name)]

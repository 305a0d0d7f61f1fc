"""Registry of effects: built-in ones, ones in users' files, and ones of installed packages."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math
import sys
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, cast, get_args

from ....datasets.models.effect_files import effect_file, source_content
from ....schemas import EffectModel, UsageError, did_you_mean
from .effect import HOOKS, Effect, EffectConstant, EffectParameter, Need, Phase
from .recording import recording_itself
from .trust import require_trust

GROUP = "cgwm.effects"
"""Group of the entry points that declare effects of installed packages: a name, and `module:ClassName`."""
BUILT_IN = (
    "linear_drag",
    "quadratic_drag",
    "magnus_lift",
    "spin_lift",
    "spin_damping",
    "wind",
    "constant_force",
    "gravity_tilt",
    "gravity_scale",
    "buoyancy",
    "ground_magnet",
    "rolling_resistance",
    "torsional_friction",
    "viscous_friction",
    "stribeck_friction",
    "anisotropic_friction",
    "friction_patch",
    "velocity_restitution",
    "adhesion",
    "com_offset",
    "inertia_shape",
    "length_scale",
    "frame_tilt",
    "clock_scale",
    "time_offset",
    "marker_offset",
)
"""Built-in effects; each is in the file of its name, as the class of that name in CamelCase."""
FLIGHT_ALIASES: tuple[dict[str, str], ...] = (
    {
        "gravity_scale": "",
        "buoyancy": "",
        "length_scale": "",
        "clock_scale": "",
        "constant_force": "along gravity",
    },
    {"gravity_tilt": "", "frame_tilt": "", "constant_force": "horizontal", "wind": "at a fixed drag"},
    {"com_offset": "", "marker_offset": ""},
)
"""Groups of effects that are equivalent in free flight, each with the condition for it."""
CONTACT_ALIASES: tuple[frozenset[str], ...] = (
    frozenset({"gravity_scale", "buoyancy", "clock_scale", "constant_force"}),
)
"""Groups that are equivalent in rigid contact too, since weight and friction scale alike."""
Units = Literal["group", "episode"]
"""Scope of specific parameter values: a group of episodes, or one episode."""


def effect_names() -> list[str]:
    """Return the names of the built-in effects, then those of installed packages."""
    return [*BUILT_IN, *(name for name in sorted(entry_points(group=GROUP).names) if name not in BUILT_IN)]


def load_effect(spec: str) -> Effect:
    """Load an effect that the user or the caller names, importing only its module; a Python file is run.

    Args:
        spec: Name of a built-in effect or of an entry point, or `path/to/file.py:ClassName`; the suffix `@group` or
            `@episode` gives each group, or each episode, specific values of the parameters.

    Raises:
        UsageError: If there is no such effect, its file or class is missing or fails, or it is badly declared.
    """
    return _loaded(spec)


def effect_of(entry: EffectModel) -> Effect:
    """Load an effect of a model; the Python file of a custom one is run only with the user's consent.

    Raises:
        UsageError: See :func:`load_effect`.
        InputDataError: If nobody has consented to run its file, see `trust`.
    """
    return _loaded(entry.name, entry)


def _loaded(spec: str, entry: EffectModel | None = None) -> Effect:
    """Load an effect; `entry` is that of the model that names it, None for one that the user names."""
    plain, units = split_units(spec)
    if units is not None:
        effect = _loaded(plain, entry)
        numbers = tuple(replace(number, shared=units) for number in effect.parameters)
        effect.parameters = numbers  # pyright: ignore[reportAttributeAccessIssue]
        return effect
    if spec in BUILT_IN:
        module = importlib.import_module(f".{spec}", __package__)
        found = getattr(module, "".join(word.capitalize() for word in spec.split("_")))
    elif effect_file(spec) is not None:
        found = _from_file(spec, entry)
    else:
        found = _from_package(spec)
    return _checked(found, spec)


def split_units(spec: str) -> tuple[str, Units | None]:
    """Split a specification into the effect to load, and what has specific parameter values.

    >>> split_units("quadratic_drag@group"), split_units("wind")
    (('quadratic_drag', 'group'), ('wind', None))
    """
    plain, _, units = spec.rpartition("@")
    if not plain or "/" in units:
        return spec, None
    if units in get_args(Units):
        return plain, cast(Units, units)
    raise UsageError(
        f"{spec}: '@{units}'.",
        f"{plain}@group or {plain}@episode, or {plain} alone.",
        "name the effect in one of these forms; 'cgwm effects list' lists all.",
    )


def aliases(name: str) -> list[str]:
    """Return the effects that are equivalent to an effect in free flight, in words."""
    found = []
    for group in FLIGHT_ALIASES:
        if name in group:
            own = f"{group[name]}: " if group[name] else ""
            found += [f"{own}{other}{f' ({when})' if when else ''}" for other, when in group.items() if other != name]
    return found


def _from_file(spec: str, entry: EffectModel | None) -> Any:
    file, _, name = spec.partition(":")
    path = Path(file)
    if not path.is_file():
        raise UsageError(f"{file}: no such file.", todo="write one with 'cgwm effects new FILE'.")
    data = source_content(path, None if entry is None else entry.sha256)  # once: what is run is what was compared
    if entry is not None:
        require_trust(path, data)
    module = _imported(path, data)
    classes = [
        key
        for key, value in vars(module).items()
        if inspect.isclass(value) and issubclass(value, Effect) and value.__module__ == module.__name__
    ]
    if name and hasattr(module, name):
        return getattr(module, name)
    legal = ", ".join(f"{file}:{key}" for key in classes)
    found = f"has no class '{name}'" if name else "names no class"
    if not classes:
        todo = "write a subclass of Effect, as 'cgwm effects new FILE' does."
        raise UsageError(f"{spec}: the file holds no effect.", todo=todo)
    raise UsageError(
        f"{spec}: {found}.", f"{legal}.{did_you_mean(name, classes)}", "name one of these classes after the colon."
    )


def _imported(path: Path, data: bytes) -> ModuleType:
    """Run the content of a file as a module; a compiled file next to it, whose content is not seen, is ignored."""
    name = f"cgwm_effect_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{path}: not a Python file.", "a file that ends with .py.", "end the name with .py.")
    module = importlib.util.module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module  # dataclasses and annotations look their module up there
    try:
        exec(compile(data, path, "exec"), module.__dict__)
    except Exception as error:  # a user's file may raise anything
        if before is None:
            del sys.modules[name]
        else:
            sys.modules[name] = before
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        raise UsageError(
            f"{path}{line}: cannot be imported: {type(error).__name__}: {error}.", todo="correct the file."
        ) from error
    return module


def _from_package(spec: str) -> Any:
    found = entry_points(group=GROUP, name=spec)
    if not found:
        names = effect_names()
        raise UsageError(
            f"there is no effect '{spec}'.",
            f"{', '.join(names)}, or a file of your own as path/to/file.py:ClassName.{did_you_mean(spec, names)}",
            "run 'cgwm effects list'.",
        )
    entry = next(iter(found))
    try:
        return entry.load()
    except Exception as error:  # an installed package may raise anything
        raise UsageError(
            f"effect '{spec}' ({entry.value}): cannot be imported: {type(error).__name__}: {error}.",
            todo="repair or remove the package that provides it.",
        ) from error


def _checked(found: Any, spec: str) -> Effect:
    if not (inspect.isclass(found) and issubclass(found, Effect) and found is not Effect):
        raise UsageError(
            f"{spec}: not an effect.",
            "a subclass of cgwm.pipeline.physics.effects.Effect.",
            "derive the class from Effect, as 'cgwm effects new FILE.py' does.",
        )
    fault = _fault(found)
    if fault:
        raise UsageError(f"{spec}: badly declared: {fault}.", todo="compare it with what 'cgwm effects new' writes.")
    try:
        return recording_itself(found)()
    except Exception as error:  # a user's class may raise anything
        raise UsageError(
            f"{spec}: cannot be made: {type(error).__name__}: {error}.",
            "a class that takes no arguments.",
            "give its constructor no arguments: numbers of an effect are its parameters and constants.",
        ) from error


def _fault(kind: type[Effect]) -> str:
    """Return the fault of a declaration, empty for none."""
    for field in ("name", "summary", "formula", "reveals", "source"):
        text = getattr(kind, field, None)
        if not isinstance(text, str) or not text.strip():
            return f"its {field} is {'missing' if text is None else repr(text)}; it is a text"
    fault = _word_fault(kind)
    if fault:
        return fault
    if all(getattr(kind, hook) is getattr(Effect, hook) for hook in HOOKS):
        return f"it has none of the methods {', '.join(HOOKS)}"
    return _number_fault(kind)


def _word_fault(kind: type[Effect]) -> str:
    if not kind.name.isidentifier():
        return f"its name is {kind.name!r}; it is one word of letters, digits and _"
    if getattr(kind, "phase", None) not in get_args(Phase):
        return f"its phase is {getattr(kind, 'phase', None)!r}; legal are {', '.join(get_args(Phase))}"
    if not isinstance(kind.needs, tuple):
        return f"its needs are {kind.needs!r}; they are a tuple of texts"
    unknown = [need for need in kind.needs if need not in get_args(Need)]
    return f"it needs {unknown[0]!r}; legal are {', '.join(get_args(Need))}" if unknown else ""


def _number_fault(kind: type[Effect]) -> str:
    parameters, constants = getattr(kind, "parameters", ()), kind.constants
    if not isinstance(parameters, tuple) or not parameters:
        return "its parameters are not a tuple of at least one EffectParameter"
    names = [getattr(number, "name", None) for number in (*parameters, *constants)]
    double = next((name for name in names if names.count(name) > 1), None)
    if double:
        return f"two of its numbers are called {double!r}"
    for number in (*parameters, *constants):
        if not isinstance(number, EffectParameter if number in parameters else EffectConstant):
            return f"{number!r} is neither an EffectParameter nor, among the constants, an EffectConstant"
        if not str(number.name).isidentifier():
            return f"{number.name!r} is no name of a number"
    return next((fault for number in (*parameters, *constants) if (fault := _range_fault(number))), "")


def _range_fault(number: EffectParameter | EffectConstant) -> str:
    if isinstance(number, EffectConstant):
        legal = number.grid and all(math.isfinite(value) for value in number.grid)
        return "" if legal else f"{number.name} has the grid {number.grid}; it takes at least one finite value"
    legal = 0 < number.scale <= number.limit < math.inf
    wanted = "it takes 0 < scale <= limit, both finite"
    return "" if legal else f"{number.name} has scale {number.scale} and limit {number.limit}; {wanted}"

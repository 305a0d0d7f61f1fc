"""Export of a residual law as the source file of a custom effect."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...datasets.io.atomic import new_file
from ...datasets.io.outputs import is_own_file, refuse_output, signed
from ...schemas import DiagnoseResult, InputDataError, LawTerm, ResidualLaw, UsageError
from ..physics.effects.registry import BUILT_IN

CLASS = "ResidualLaw"
"""Name of the class in the exported file."""
AXES = {"x": 0, "y": 1, "z": 2}
"""Axis of the terms that are a constant acceleration."""
DAMPING = {"-u": ("u", 1.0), "-|u| u": ("u", 2.0), "-omega": ("omega", 1.0), "-|omega| omega": ("omega", 2.0)}
"""Vector and exponent of the damping terms."""
SELECTED_TERMS = {
    "linear_drag": ("-u",),
    "quadratic_drag": ("-|u| u",),
    "magnus_lift": ("omega x u",),
    "spin_damping": ("-omega",),
    "constant_force": ("x", "y", "z"),
}
"""Terms that a selected effect already contains: a fit of both could not separate them."""
LIMIT = 100.0
"""Bound of an exported parameter, in multiples of its estimate."""

TEMPLATE = '''"""Law found by `cgwm diagnose` in the residual of a model: cgwm fit CAPTURE --effects {file}:{kind}."""

from __future__ import annotations

import torch

from cgwm.pipeline.physics.effects import BodyMotion, Effect, EffectParameter, Values, Wrench, length


class {kind}(Effect):
    """{formula}; u: velocity, omega: angular velocity, world frame."""

    name = "{name}"
    summary = "Residual acceleration of a model in flight, found by regression."
    formula = "{formula}"
    parameters = (
{parameters}
    )
    phase = "flight"
    needs = {needs}
    reveals = "free flights as different as possible; the main covariate of the residual was: {where}"
    source = "cgwm diagnose, sparse regression of the residual wrench"

    def wrench(self, values: Values, motion: BodyMotion) -> Wrench:
        """Return the wrench of an acceleration and an angular acceleration."""
        u, omega = motion.velocity, motion.omega
        a, alpha = torch.zeros_like(u), torch.zeros_like(omega)
{lines}
        torque = (motion.inertia @ alpha[..., None]).squeeze(-1)
        return Wrench(force=motion.mass[:, None] * a, torque=torque)
'''


def require_law_file(path: Path, overwrite: bool) -> None:
    """Raise an error for a file that could not be written, before the diagnosis runs.

    Raises:
        UsageError: If the name does not end with .py, or the file exists and `overwrite` is not set. A law that cgwm
            wrote and nobody has changed is compared with the new one first.
    """
    if path.suffix != ".py":
        raise UsageError(
            f"{path}: an effect is a Python file.",
            "a name that ends with .py.",
            "end the name with .py: --save-law FILE.py.",
        )
    if overwrite or not is_own_file(path, "effect"):
        refuse_output(path, "effect", overwrite)


def save_law(result: DiagnoseResult, path: Path, overwrite: bool = False, present: Sequence[str] = ()) -> str:
    """Write the residual law of a diagnosis as a custom effect, and return the argument for `fit --effects`.

    Terms of a selected effect, and of one that the model has, are left out, because the two are fitted together.

    Args:
        result: The diagnosis.
        path: The Python file.
        overwrite: Replace an existing file.
        present: Effects of the model.

    Raises:
        InputDataError: If no law was found, or no term of it is left to export.
        UsageError: See :func:`require_law_file`.
    """
    require_law_file(path, overwrite)
    law = result.residual_law
    terms = () if law is None else further_terms(law, (*result.selected, *present))
    if law is None or not terms:
        what = "has no residual law" if law is None else "leaves a residual that follows none of the known terms"
        raise InputDataError(
            f"{path}: nothing to save: the diagnosis {what}. It says: {result.sentence}",
            "--save-law where something unexplained remains in flight.",
            "leave --save-law out, and see the whole diagnosis.",
        )
    source = signed(law_source(law.model_copy(update={"terms": terms}), path))
    if not (is_own_file(path, "effect") and path.read_text(encoding="utf-8") == source):
        with new_file(path, "effect", overwrite) as partial:
            partial.write_text(source, encoding="utf-8")
    return f"{path}:{CLASS}"


def further_terms(law: ResidualLaw, effects: Sequence[str]) -> tuple[LawTerm, ...]:
    """Return the terms of a law that belong to none of the effects with these names."""
    known = {term for name in effects for term in SELECTED_TERMS.get(name, ())}
    return tuple(term for term in law.terms if term.term not in known)


def law_source(law: ResidualLaw, path: Path) -> str:
    """Return the source text of the effect."""
    parameters, lines, formulas = [], [], {"a": "", "alpha": ""}
    for number, term in enumerate(law.terms, 1):
        name = f"c{number}"
        target, formula, code, unit = _term(term, law, name)
        formulas[target] += formula if formulas[target] == "" else f" {formula}".replace(" -", " - ", 1)
        scale, limit = 0.5 * abs(term.coefficient), LIMIT * abs(term.coefficient)
        sign = ", nonnegative=True" if term.term in DAMPING and term.coefficient > 0 else ""
        parameters += [
            f"        # found: {term.coefficient:.3g} +- {term.std_error:.2g}",
            f'        EffectParameter(name="{name}", unit="{unit}", scale={scale:.3g}, limit={limit:.3g}{sign}),',
        ]
        lines.append(f'        {target} = {target} {code.replace("VALUE", f"""values["{name}"][:, None]""")}')
    stem = path.stem
    spins = any("omega" in term.term for term in law.terms)
    return TEMPLATE.format(
        file=path.name,
        kind=CLASS,
        name=stem if stem.isidentifier() and stem not in BUILT_IN else "residual_law",
        formula=", ".join(f"{target} = {text}" for target, text in formulas.items() if text),
        parameters="\n".join(parameters),
        needs='("spin",)' if spins else "()",
        where=law.where,
        lines="\n".join(lines),
    )


def _term(term: LawTerm, law: ResidualLaw, name: str) -> tuple[str, str, str, str]:
    """Return the target of a term, its formula, its code with VALUE for the parameter, and the parameter's unit."""
    if term.term in AXES:
        return "a", f"+{name} {term.term}", f"+ VALUE * torch.eye(3).to(u)[{AXES[term.term]}]", term.unit
    if term.term == "omega x u":
        return "a", f"+{name} omega x u", "+ VALUE * torch.linalg.cross(omega, u)", term.unit
    vector, own = DAMPING[term.term]
    best, low, high = law.exponent.get(term.term, (own, own, own))
    power = own if low <= own <= high else best
    target = "a" if vector == "u" else "alpha"
    if power == 1.0:
        return target, f"-{name} {vector}", f"- VALUE * {vector}", term.unit if own == power else "1/s"
    # below an exponent of 1 the force jumps where the motion ends: smoothed there
    size = f"length({vector})" if power > 1 else f"(length({vector}) + 1e-3)"
    unit = term.unit if own == power else _unit(vector, power)
    factor = size if power == 2.0 else f"{size} ** {power - 1:g}"
    shown = f"|{vector}|" if power == 2.0 else f"|{vector}|^{power - 1:g}"
    return target, f"-{name} {shown} {vector}", f"- VALUE * {factor} * {vector}", unit


def _unit(vector: str, power: float) -> str:
    """Return the unit of c in c |v|^(p - 1) v, an acceleration."""
    length = "m" if vector == "u" else "rad"
    return f"{length}^{1 - power:g} s^{power - 2:g}"

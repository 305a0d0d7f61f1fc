"""`cgwm diagnose`: which physical or measurement effect a model lacks, what else it could be, and what remains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..datasets.capture import Capture
from ..datasets.models import Model, read_model
from ..schemas import (
    ContactLimit,
    DiagnoseResult,
    EffectEstimate,
    FlightTest,
    InputDataError,
    LawTerm,
    RankedEffect,
    ResidualLaw,
    UsageError,
)
from .diagnosis.candidates import Candidate, admissible
from .diagnosis.contact_limits import ContactLimit as FoundLimit
from .diagnosis.episodes import diagnosed_episodes
from .diagnosis.law_file import require_law_file, save_law
from .diagnosis.next_throw import next_experiment
from .diagnosis.prepared import Prepared, prepare
from .diagnosis.residual_law import residual_law
from .diagnosis.slots import Evidence
from .diagnosis.throws import DEFAULT, Throw, read_throws, throws_of
from .diagnosis.usable import refuse_blind, refuse_strange
from .diagnosis.verdict import Findings, find
from .diagnosis.wrench import Omnibus, organisers, wrench_windows
from .own_worlds import with_known_numbers
from .physics.effects.registry import effect_names, load_effect, split_units
from .physics.world import World
from .sg_gs import resolve_device
from .threads import one_torch_thread


@one_torch_thread()
def diagnose(
    model: Path,
    capture: Path,
    split: str = "train",
    candidates: Sequence[str] = (),
    throws: Path | None = None,
    save_law_to: Path | None = None,
    overwrite: bool = False,
    device: str = "auto",
) -> DiagnoseResult:
    """Find what a fitted model lacks of measured motions; no episode outside the split is opened.

    Args:
        model: MODEL, with fitted physics.
        capture: The capture, with tracks, or with videos in which the model's fit found the poses.
        split: The episodes to look at; cross-validation is among them.
        candidates: Effects beside the built-in ones, `file.py:Class` or names of entry points.
        throws: A TOML file of throws among which to look for the next one; None for those that a hand can make.
        save_law_to: Where to write the residual law as an effect of one's own; None for nowhere.
        overwrite: Replace that file.
        device: Where rollouts run: auto, cpu or cuda; what the kernel there cannot take runs on the CPU.

    Raises:
        InputDataError: If the data cannot carry a verdict: what is lacking, and what to do; or if there is no residual
            law to save.
        UsageError: If there is no such split or effect, or the file exists.
    """
    if save_law_to is not None:
        require_law_file(save_law_to, overwrite)
    compared = throws_of(DEFAULT) if throws is None else read_throws(throws)
    library = library_of(candidates)
    world, prepared = prepared_world(read_model(model), Capture.open(capture, splits=(split,)), split, device)
    result = report(prepared, world, library, compared)
    if save_law_to is None:
        return result
    saved = save_law(result, save_law_to, overwrite)
    return result.model_copy(update={"saved_law": saved})


def prepared_world(model: Model, capture: Capture, split: str, device: str = "auto") -> tuple[World, Prepared]:
    """Return a fitted model's world, and a split's episodes ready for tests of it.

    Raises:
        InputDataError: If the data cannot carry a verdict: what is lacking, and what to do.
        UsageError: If there is no such split.
    """
    world = replace(_world(model, capture), rolls_on=resolve_device(device).type)
    found = diagnosed_episodes(model, capture, split)
    names = [name for name, _ in found.episodes]
    world = with_known_numbers(world, model.file, names, capture.groups)
    refuse_strange(world, found.episodes, str(capture.root))
    prepared = prepare(world, found.episodes, found.noise, _groups(capture, names))
    prepared = replace(prepared, warnings=(*found.warnings, *prepared.warnings))
    refuse_blind(world, prepared, str(capture.root))
    return world, prepared


def report(
    prepared: Prepared, world: World, library: Sequence[Candidate], throws: Sequence[Throw] = ()
) -> DiagnoseResult:
    """Return the diagnosis of prepared episodes; throws: among which to look for the next one."""
    if prepared.flight is None and not prepared.contact_items:
        raise InputDataError(
            "no part of the tracks is long enough to be followed by the model: neither six frames of flight nor of "
            "contact without a gap.",
            todo="record at 60 Hz or more, or name another split.",
        )
    findings = find(prepared, world, library)
    _, refused = admissible(world, library, prepared.turned)
    clear = prepared.clear & (prepared.whole.seen.amax(-1) > 0)
    seen = int((prepared.whole.seen.amax(-1) > 0).sum())
    warnings = [*prepared.warnings, *_one_phase(prepared)]
    warnings += [f"{law.effect}: these flights fit {law.formula} as well as its own law." for law in findings.as_good]
    law = _law(prepared, findings) if findings.verdict == "unexplained" or findings.remaining else None
    selected = () if findings.verdict == "unexplained" else tuple(c.evidence.candidate.spec for c in findings.chosen)
    groups = [c.equals for c in findings.chosen if len(c.equals) > 1] if selected else []
    return DiagnoseResult(
        verdict=findings.verdict,
        sentence=_sentence(findings, law) + _unseen(prepared),
        selected=selected,
        remaining_unexplained=findings.remaining,
        ranking=tuple(_ranked(e, findings) for e in findings.ranking),
        aliases=tuple(tuple(e.candidate.spec for e in group) for group in groups),
        next_experiment=next_experiment(prepared, findings, throws),
        residual_law=law,
        episodes=len(prepared.names),
        phases={"flight": int(clear.sum()), "contact": seen - int(clear.sum())},
        noise={"position_m": prepared.noise[0], "rotation_rad": prepared.noise[1]},
        flight_before=_flight_test(findings.before),
        flight_after=_flight_test(findings.after),
        contact_chi2=findings.contact_chi2,
        contact_limits=tuple(_limit(one) for one in findings.limits),
        not_tested=dict(sorted(refused.items())),
        warnings=tuple(warnings),
    )


def library_of(candidates: Sequence[str]) -> list[Candidate]:
    """Return the built-in effects, those of installed packages, and the given ones, as candidates.

    Raises:
        UsageError: If an effect cannot be loaded, or two have one name.
    """
    shared = next((spec for spec in candidates if split_units(spec)[1] is not None), None)
    if shared is not None:
        raise UsageError(
            f"{shared}: a diagnosis tests one value for all episodes of what it has built in.",
            f"{split_units(shared)[0]}.",
            f"add it to the model: 'cgwm fit CAPTURE --from MODEL --effects {shared}'.",
        )
    specs = [*effect_names(), *(spec for spec in candidates if spec not in effect_names())]
    library = [Candidate(spec, load_effect(spec)) for spec in specs]
    names: dict[str, str] = {}
    for candidate in library:
        own = candidate.effect.name
        if own in names:
            raise UsageError(
                f"two candidates are called '{own}': {names[own]} and {candidate.spec}.", todo="rename one of them."
            )
        names[own] = candidate.spec
    return library


def _world(model: Model, capture: Capture) -> World:
    """Return the model's world, on the ground of the capture: one moved by a fit hides what moved it."""
    own = [body.name for body in model.file.bodies]
    if set(own) != set(capture.body_names):
        raise InputDataError(
            f"the model's bodies are {', '.join(own)}; those of {capture.root} are {', '.join(capture.body_names)}.",
            "a model of this capture's bodies.",
            f"run 'cgwm fit {capture.root} --out MODEL'.",
        )
    world = World.from_model(model)
    ground = capture.manifest.world.ground
    if ground is None or world.ground_offset is None:
        return world
    return replace(world, ground_offset=torch.full_like(world.ground_offset, ground.offset_m))


def _groups(capture: Capture, names: Sequence[str]) -> list[int]:
    entries = [capture.manifest.episodes.get(name) for name in names]
    sessions = [(entry.group or "") if entry is not None else "" for entry in entries]
    return [sorted(set(sessions)).index(session) for session in sessions]


def _unseen(prepared: Prepared) -> str:
    """Say of what kind of motion nothing was seen, and nothing is said."""
    if not prepared.contact_items:
        return " Only flight was seen: this says nothing about contact."
    if prepared.flight is None:
        return " Only contact was seen: this says nothing about flight."
    return ""


def _one_phase(prepared: Prepared) -> list[str]:
    if not prepared.contact_items:
        return ["there is no contact to look at: effects that act in contact cannot be judged."]
    if prepared.flight is None:
        return ["there is no flight to look at: effects that act in flight cannot be judged."]
    return []


def _law(prepared: Prepared, findings: Findings) -> ResidualLaw | None:
    """Return the law of what is left: of everything where nothing was selected, else beside the selected effects."""
    if prepared.flight is None:
        return None
    world = findings.base if findings.verdict == "unexplained" else findings.world
    windows = wrench_windows(world, prepared.whole, prepared.flight.items, prepared.noise, prepared.memory)
    if windows is None:
        return None
    law = residual_law(windows)
    return ResidualLaw(
        terms=tuple(
            LawTerm(term=t.name, coefficient=t.coefficient, std_error=t.std_error, unit=t.unit) for t in law.terms
        ),
        exponent=law.exponents,
        left_chi2=law.left_chi2,
        where=organisers(windows)[0].coordinate,
    )


def _ranked(evidence: Evidence, findings: Findings) -> RankedEffect:
    effect = evidence.candidate.effect
    where = "contact" if effect.phase == "contact" or effect.name in findings.judged_in_contact else "flight"
    numbers = evidence.numbers
    if numbers is None:
        std = np.sqrt(np.diag(evidence.test.covariance))
        numbers = {
            p.name: (float(v), float(s))
            for p, v, s in zip(effect.parameters, evidence.test.estimate, std, strict=False)
        }
    unit = {p.name: p.unit for p in effect.parameters}
    before, after = findings.errors.get(effect.name, (None, None))
    return RankedEffect(
        effect=evidence.candidate.spec,
        acts_in=(effect.phase,),
        judged_in=where,
        score_p=evidence.p_value,
        contact_score=next((_finite(c.score) for c in findings.contact if c.evidence.name == effect.name), None),
        delta_bic=evidence.delta_bic,
        cv_error_before_m=before,
        cv_error_after_m=after,
        parameters=tuple(
            EffectEstimate(name=name, unit=unit[name], estimate=float(v), std_error=float(s))
            for name, (v, s) in numbers.items()
        ),
        constants=evidence.constants,
    )


def _limit(found: FoundLimit) -> ContactLimit:
    units = {p.name: p.unit for p in found.candidate.effect.parameters if p.name in found.sizes}
    return ContactLimit(effect=found.candidate.spec, sizes=found.sizes, units=units, constants=found.constants)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _flight_test(found: Omnibus | None) -> FlightTest | None:
    if found is None:
        return None
    return FlightTest(statistic=found.statistic, degrees_of_freedom=found.dof, p_value=found.p_value)


def _sentence(findings: Findings, law: ResidualLaw | None) -> str:
    names = [c.evidence.candidate.spec for c in findings.chosen]
    if findings.verdict == "none_missing":
        return "Nothing is missing that these data could show."
    if findings.verdict == "unexplained":
        where = f"; it is organised by {law.where}" if law is not None else ""
        return f"Something is missing in flight, and none of the candidates explains it{where}."
    words = []
    for one in findings.chosen:
        others = [e.candidate.spec for e in one.equals[1:]]
        words.append(f"{one.evidence.candidate.spec} (or {', '.join(others)}: not separable)" if others else "")
    listed = " and ".join(word or name for word, name in zip(words, names, strict=True))
    rest = " Something beside it remains unexplained." if findings.remaining else ""
    return f"Missing: {listed}.{rest}"

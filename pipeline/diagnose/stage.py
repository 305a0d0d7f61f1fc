"""Diagnosis of a fitted model: the missing physical or measurement effect, its equals, and the residual."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ...datasets.capture.capture import Capture
from ...datasets.io.atomic import new_file
from ...datasets.io.outputs import reads, refuse_output
from ...datasets.io.progress import note
from ...datasets.models.fit_inputs import changed_since_fit
from ...datasets.models.laws import refuse_paper_law
from ...datasets.models.model import Model, read_model
from ...schemas import (
    ContactLimit,
    DiagnoseResult,
    EffectParameterEstimate,
    FlightTest,
    InputDataError,
    LawTerm,
    NextExperiment,
    NextMotions,
    NotDescribed,
    RankedEffect,
    ResidualLaw,
    UsageError,
)
from ...schemas.printable import typed_path
from ..physics.effects.recording import no_recording
from ..physics.effects.registry import effect_names, effect_of, load_effect, split_units
from ..physics.model_world import world_of_model
from ..physics.rollout_cost import durations, segment_part
from ..physics.world import World
from ..report.page_file import shows_the_same
from ..runtime.device import resolve_device
from ..runtime.resources import one_torch_thread
from ..runtime.work_budget import motion_doubt, within_budget
from ..segments.candidates import Candidate, admissible, without_effects
from ..segments.center_of_mass import as_one_body
from ..segments.described_motion import not_described
from ..segments.flights.residual_wrench import Omnibus, covariates_of
from ..segments.ground_contact import on_the_ground
from ..segments.group_parameters import with_known_groups
from ..segments.input_checks import check_observability, check_units_and_geometry
from ..segments.prepare import Prepared, prepare
from ..segments.sliding.support import on_surfaces
from .contact.detection_limits import DetectionLimit
from .episodes import DiagnosedEpisodes, diagnosed_episodes
from .evidence.evidence import Evidence
from .law_export import require_law_file, save_law
from .next_experiment.experiments import DEFAULT, Experiment, experiments_of, read_experiments
from .next_experiment.motions import next_motions
from .next_experiment.surface_motions import surface_motions
from .next_experiment.throws import next_experiment
from .remaining import held_out_of, remaining_of
from .report.next_command import next_command
from .report.page import diagnosis_html, mark_of
from .report.pictures import pictures_of
from .report.wording import (
    law_warnings,
    misfit_warnings,
    motion_warnings,
    noisy_warnings,
    sentence,
    size_warnings,
    unseen_motion,
)
from .sparse_regression import residual_law
from .thresholds import THRESHOLDS
from .unlike_episodes import unlike_episodes, unlike_warnings
from .verdict import Findings, find

JOINTED = (
    "of the jointed body '{name}' the motion of the centre of mass of its links was examined, in flight alone: what "
    "acts on it as a whole is found, not what turns it, and nothing in contact. Losses of its joints are numbers of "
    "'cgwm fit'; masses of links that are wrong by more than a tenth can look like a force."
)
"""Warning that limits a verdict about a jointed body."""
_LESS = "name a split with fewer episodes, or use a model with a longer step_s."


@one_torch_thread()
@reads("model", "capture", "throws")
def diagnose(
    model: Path,
    capture: Path,
    split: str = "train",
    candidates: Sequence[str] = (),
    throws: Path | None = None,
    save_law_to: Path | None = None,
    overwrite: bool = False,
    device: str = "auto",
    accept_units: bool = False,
    page: Path | None = None,
) -> DiagnoseResult:
    """Find the effects that a fitted model lacks to explain measured motions.

    Episodes outside the split are not opened.

    Args:
        model: MODEL, with fitted physics.
        capture: The capture, with tracks, or with videos in which the model's fit found the poses.
        split: The episodes to use; cross-validation is among them.
        candidates: Effects in addition to the built-in ones, `file.py:Class` or names of entry points.
        throws: TOML file with the throws to choose the next experiment from; None for throws that can be made by hand.
        save_law_to: File to write the residual law to, as a custom effect; None to write none.
        overwrite: Replace that file.
        device: Device of the rollouts: auto, cpu or cuda. What the kernel does not support runs on the CPU.
        accept_units: Do not refuse units and frames of the capture that its motion contradicts.
        page: The HTML page to write; None writes none. One of the same model, capture and split is replaced.

    Raises:
        InputDataError: If the data do not suffice for a verdict (the message says what is missing), or no residual law
            was found to save.
        UsageError: If the split or an effect does not exist, or a file exists.
    """
    if page is not None:
        replaces = overwrite or shows_the_same(page, mark_of(page, model, capture, split))
        refuse_output(page, "page", replaces)
    if save_law_to is not None:
        require_law_file(save_law_to, overwrite)
    compared = experiments_of(DEFAULT) if throws is None else read_experiments(throws)
    library = library_of(candidates)
    loaded = read_model(model)
    accepted = accept_units or loaded.accepts_units
    opened = Capture.open(capture, splits=(split,), accept_units=accepted)
    with no_recording([*(one.effect for one in library), *map(effect_of, loaded.file.effects)]):
        note(f"diagnose: flights, contacts and noise of {len(opened.episodes(split))} episodes")
        world, prepared = prepared_world(loaded, opened, split, device, accepted)
        note(f"diagnose: {len(library)} effects")
        result, findings = report_and_findings(prepared, world, library, compared)
        if not loaded.file.articulations:
            episodes = diagnosed_episodes(loaded, opened, split).episodes
            result = _first_of_all(result, not_described(world, episodes, prepared.noise))
        pictures = None if page is None else pictures_of(prepared, findings, result)
    if save_law_to is not None:
        present = [split_units(effect.name)[0] for effect in loaded.file.effects]
        result = result.model_copy(update={"saved_law": save_law(result, save_law_to, overwrite, present)})
    if page is None or pictures is None:
        return result
    result = result.model_copy(update={"report": str(page)})
    note("diagnose: page")
    with new_file(page, "page", replaces) as path:
        then = shlex.join(next_command(result, Path(model), Path(capture), split))
        html = diagnosis_html(result, pictures, page, Path(model), Path(capture), split, then)
        path.write_text(html, encoding="utf-8")
    return result


def prepared_world(
    model: Model, capture: Capture, split: str, device: str = "auto", accept_units: bool = False
) -> tuple[World, Prepared]:
    """Return the world of a fitted model and the prepared episodes of a split.

    Args:
        model: The fitted model.
        capture: The capture.
        split: Name of the split.
        device: Device of the rollouts: auto, cpu or cuda.
        accept_units: Do not check whether units, shape and ground agree with the tracks.

    Raises:
        InputDataError: If the data do not suffice for a verdict; the message says what is missing.
        UsageError: If the split does not exist.
    """
    world = replace(_world(model, capture), rolls_on=resolve_device(device).type)
    found = diagnosed_episodes(model, capture, split)
    if world.chains:
        world, found = _whole(world, found, f"{capture.root}: split '{split}'")
    names = [name for name, _ in found.episodes]
    world = with_known_groups(world, model.file, names, capture.groups)
    if not accept_units:
        check_units_and_geometry(world, found.episodes, str(capture.root))
    spans = durations(found.episodes)
    with within_budget([segment_part("the tests of all effects", world, spans)], _LESS, doubt=motion_doubt(spans)):
        prepared = prepare(world, found.episodes, found.noise, _groups(capture, names))
        unlike = {} if world.chains else unlike_episodes(prepared)
        if unlike:
            kept = [episode for episode in found.episodes if episode[0] not in unlike]
            prepared = prepare(world, kept, found.noise, _groups(capture, [name for name, _ in kept]))
    changed = changed_since_fit(model.file.provenance, capture)
    prepared = replace(
        prepared,
        filmed=found.filmed,
        warnings=(*changed, *found.warnings, *unlike_warnings(unlike), *prepared.warnings),
    )
    check_observability(world, prepared, str(capture.root))
    return world, prepared


def report(
    prepared: Prepared, world: World, library: Sequence[Candidate], throws: Sequence[Experiment] = ()
) -> DiagnoseResult:
    """Diagnose prepared episodes and return the result document; see :func:`report_and_findings`."""
    return report_and_findings(prepared, world, library, throws)[0]


def report_and_findings(
    prepared: Prepared, world: World, library: Sequence[Candidate], throws: Sequence[Experiment] = ()
) -> tuple[DiagnoseResult, Findings]:
    """Diagnose prepared episodes and return the result document with the findings that it tells of.

    Args:
        prepared: The episodes.
        world: The model's world.
        library: All candidates.
        throws: Experiments to choose the next one from.

    Raises:
        InputDataError: If no segment is long enough to be fitted.
    """
    if prepared.flight is None and not prepared.contact_items:
        raise InputDataError(
            "no part of the tracks is long enough for a fit: neither flight nor contact has six frames without a gap.",
            todo="record at 60 Hz or more, or name another split.",
        )
    world, prepared = on_the_ground(world, prepared)
    findings = find(prepared, world, library)
    _, refused = admissible(world, library, prepared.has_orientation, prepared.observations.spin_rad_s is not None)
    clear = prepared.airborne & (prepared.observations.seen.amax(-1) > 0)
    seen = int((prepared.observations.seen.amax(-1) > 0).sum())
    warnings = [*prepared.warnings, *motion_warnings(prepared, on_surfaces(world)), *noisy_warnings(prepared, findings)]
    warnings += [*law_warnings(findings), *size_warnings(findings), *misfit_warnings(findings)]
    law = _law(findings.flight.prepared, findings) if findings.verdict == "unexplained" or findings.remaining else None
    selected = () if findings.verdict == "unexplained" else tuple(c.evidence.candidate.spec for c in findings.chosen)
    groups = [c.equals for c in findings.chosen if len(c.equals) > 1] if selected else []
    if on_surfaces(world):
        motions = surface_motions(findings)
    else:
        motions = next_motions(findings.flight.prepared, findings, library)
    document = DiagnoseResult(
        verdict=findings.verdict,
        sentence=sentence(findings, law) + unseen_motion(prepared),
        selected=selected,
        remaining_unexplained=findings.remaining,
        ranking=tuple(_ranked(e, findings) for e in findings.ranking),
        aliases=tuple(tuple(e.candidate.spec for e in group) for group in groups),
        next_experiment=None
        if on_surfaces(world) and prepared.flight is None
        else _next_throw(findings, motions, throws),
        next_motions=motions,
        remaining=remaining_of(findings.flight),
        residual_law=law,
        episodes=len(prepared.names),
        phases={"flight": int(clear.sum()), "contact": seen - int(clear.sum())},
        noise={"position_m": prepared.noise.position_m, "rotation_rad": prepared.noise.rotation_rad},
        flight_before=_flight_test(findings.flight.before),
        flight_after=_flight_test(findings.flight.after),
        contact_chi2=findings.contact_chi2,
        contact_misfits=findings.misfits,
        contact_limits=tuple(_limit(one) for one in findings.limits),
        not_tested=_not_tested(refused, findings),
        left_out_s=dict(prepared.left_out_s),
        warnings=tuple(warnings),
    )
    return document, findings


def _next_throw(findings: Findings, motions: NextMotions | None, throws: Sequence[Experiment]) -> NextExperiment | None:
    """Return the next experiment among throws; None where motions that are asked for tell the rivals apart.

    Motions that tell effects of contact apart are chosen by the tests that will judge them.
    """
    if motions is not None and motions.separates:
        return None
    return next_experiment(findings.flight.prepared, findings, throws)


def _not_tested(refused: Mapping[str, str], findings: Findings) -> dict[str, str]:
    """Return why candidates were not tested; some were beside an effect that they need."""
    tested = {evidence.name for evidence in findings.ranking}
    return {name: why for name, why in sorted(refused.items()) if name not in tested}


def _first_of_all(result: DiagnoseResult, useless: NotDescribed | None) -> DiagnoseResult:
    """Return the result with what comes first: that the model does not describe the motion at all.

    A missing effect may be the reason that a body which stands still is nearer; it stays the verdict then.
    """
    if useless is None:
        return result
    update = {"not_described": useless, "sentence": f"{useless.sentence} {result.sentence}"}
    if useless.never_touches or not result.selected:
        update |= {"verdict": "not_described", "sentence": useless.sentence, "selected": (), "aliases": ()}
    return result.model_copy(update=update)


def library_of(candidates: Sequence[str]) -> list[Candidate]:
    """Return the built-in effects, those of installed packages, and the given ones, as candidates.

    Raises:
        UsageError: If an effect cannot be loaded, or two have the same name.
    """
    shared = next((spec for spec in candidates if split_units(spec)[1] is not None), None)
    if shared is not None:
        raise UsageError(
            f"{shared}: a diagnosis tests built-in effects with one value for all episodes.",
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
    """Return the model's world with the ground at the height of the capture.

    A ground height changed by the fit would hide the effect that changed it.
    """
    own = [body.name for body in model.file.bodies]
    if set(own) != set(capture.body_names):
        raise InputDataError(
            f"the model's bodies are {', '.join(own)}; those of {capture.root} are {', '.join(capture.body_names)}.",
            "a model of this capture's bodies.",
            f"run 'cgwm fit {typed_path(capture.root)} --out MODEL'.",
        )
    refuse_paper_law(model.file, model.place, "diagnose")
    world = world_of_model(model)
    ground = capture.manifest.world.ground
    if ground is None or world.ground_offset is None:
        return world
    return replace(world, ground_offset=torch.full_like(world.ground_offset, ground.offset_m))


def _whole(world: World, found: DiagnosedEpisodes, place: str) -> tuple[World, DiagnosedEpisodes]:
    """Return the flights of the centre of mass of a jointed body as episodes of a body that touches nothing.

    Its noise is measured: that of the links does not say what the errors of their orientations add.
    """
    name, least = world.chains[0].name, THRESHOLDS.verdict.min_episodes
    alone, flown = as_one_body(world, found.episodes, found.noise, place)
    if len(flown) < least:
        raise InputDataError(
            f"{place}: '{name}' flies without touching anything in {len(flown)} episodes.",
            f"flights in at least {least} episodes; in contact, jointed bodies are not examined.",
            "record throws, or use 'cgwm compare', which shows in which phase and at which link predictions miss.",
        )
    return alone, DiagnosedEpisodes(flown, (None, None), (*found.warnings, JOINTED.format(name=name)), found.filmed)


def _groups(capture: Capture, names: Sequence[str]) -> list[int]:
    """Return the index of each episode's group; episodes without a group share one."""
    entries = [capture.manifest.episodes.get(name) for name in names]
    sessions = [(entry.group or "") if entry is not None else "" for entry in entries]
    return [sorted(set(sessions)).index(session) for session in sessions]


def _law(prepared: Prepared, findings: Findings) -> ResidualLaw | None:
    """Fit a law to the residual wrench in flight; None without flight.

    For the verdict "unexplained" the residual is that of the model's world, else that with the selected effects.
    """
    withheld = [one.effect for one in findings.flight.withheld]
    world = findings.base if findings.verdict == "unexplained" else without_effects(findings.world, *withheld)
    windows = world.once(prepared.short_windows)
    if windows is None:
        return None
    law = residual_law(windows)
    return ResidualLaw(
        terms=tuple(
            LawTerm(term=t.name, coefficient=t.coefficient, std_error=t.std_error, unit=t.unit) for t in law.terms
        ),
        exponent=law.exponents,
        left_chi2=law.left_chi2,
        where=covariates_of(windows)[0].coordinate,
    )


def _ranked(evidence: Evidence, findings: Findings) -> RankedEffect:
    """Return the entry of a candidate in the result document."""
    effect = evidence.candidate.effect
    where = "contact" if effect.phase == "contact" or effect.name in findings.judged_in_contact else "flight"
    estimates = evidence.numbers
    if estimates is None:
        std = np.sqrt(np.diag(evidence.test.covariance))
        estimates = {
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
        contact_score=next((_finite(c.score) for c in findings.contact if c.name == effect.name), None),
        delta_bic=evidence.delta_bic,
        cv_error_before_m=before,
        cv_error_after_m=after,
        parameters=tuple(
            EffectParameterEstimate(name=name, unit=unit[name], estimate=float(v), std_error=float(s))
            for name, (v, s) in estimates.items()
        ),
        constants=evidence.constants,
        spread=dict(evidence.spread),
        told_apart_by=_told_apart(evidence, findings),
        **held_out_of(evidence),
    )


def _told_apart(evidence: Evidence, findings: Findings) -> str | None:
    """Return what rules out the effects that flight does not tell from a selected one; None where nothing does."""
    chosen = next((c for c in findings.chosen if c.evidence.name == evidence.name and not evidence.spread), None)
    step = next((s for s in findings.flight.steps if s.flagged and evidence.name in {e.name for e in s.equals}), None)
    if chosen is None or step is None:
        return None
    out = sorted({e.name for e in step.equals} - {e.name for e in chosen.equals})
    return f"contact rules out {', '.join(out)}" if out else None


def _limit(found: DetectionLimit) -> ContactLimit:
    """Return the entry of a detection limit in the result document."""
    units = {p.name: p.unit for p in found.candidate.effect.parameters if p.name in found.sizes}
    return ContactLimit(effect=found.candidate.spec, sizes=found.sizes, units=units, constants=found.constants)


def _finite(value: float) -> float | None:
    """Return the value; None if it is infinite or not a number."""
    return value if math.isfinite(value) else None


def _flight_test(found: Omnibus | None) -> FlightTest | None:
    """Return the entry of an omnibus test in the result document; None without flight."""
    if found is None:
        return None
    return FlightTest(statistic=found.statistic, degrees_of_freedom=found.dof, p_value=found.p_value)

"""Sentences of a diagnosis: the verdict in words, and the warnings about what the data do not show."""

from __future__ import annotations

import math

from ....schemas import ResidualLaw
from ...physics.effects.effect import EffectParameter
from ...report.page import listed
from ...segments.prepare import Prepared
from ..evidence.evidence import Evidence, implausible
from ..flight.omnibus import is_significant
from ..flight.own_accelerations import UPWARD
from ..law_export import further_terms
from ..remaining import bad_ones
from ..thresholds import THRESHOLDS
from ..verdict import Findings

_DIFFERS = " Something is left in flight; it differs from episode to episode, as errors of the tracking do."
_UNTOLD = (
    "Something is left in flight beside independent errors, but the flights are too few or too short to tell a force "
    "from errors of the tracking that last over several frames. Record longer flights, more of them, or more frames a "
    "second."
)
_INEXACT = "the law of contact does not describe all of the motion"
_PHASE_WORDS = {"impact": "impacts", "sliding": "slides", "rolling": "rolling", "sticking": "tipping", "rest": "rest"}
_ORGANISED = {
    "constant": "In these flights, one constant force explains more than any coordinate does.",
    "time": "The force changes most clearly with the time within an episode.",
    "x": "The force changes most clearly with the place along x.",
    "y": "The force changes most clearly with the place along y.",
    "height": "The force changes most clearly with the height.",
    "heading": "The force changes most clearly with the direction of motion.",
    "speed": "The force changes most clearly with the speed.",
    "spin": "The force changes most clearly with the spin.",
    "episode": "The force differs most clearly from episode to episode.",
}


def organised(coordinate: str) -> str:
    """Return as a sentence what a residual force follows; its coordinate is one of `Covariate.coordinate`."""
    return _ORGANISED[coordinate]


def sentence(findings: Findings, law: ResidualLaw | None) -> str:
    """Return the verdict as one or two sentences.

    Args:
        findings: The findings.
        law: The law of the residual wrench, whose covariate is named where no candidate explains the residual.
    """
    names = [c.evidence.candidate.spec for c in findings.chosen]
    if findings.verdict == "none_missing":
        return (
            f"Nothing is missing that these data could show.{_DIFFERS if findings.remaining else ''}"
            f"{_levelled(findings)}"
        )
    if findings.verdict == "law_inexact":
        return f"No effect is named, but {_INEXACT}: {_misfit(findings)}{_described(findings)}{_levelled(findings)}"
    if findings.verdict == "unexplained":
        if findings.flight.untold:
            return _UNTOLD
        where = f" {organised(law.where)}" if law is not None else ""
        none = f"Something is missing in flight, and none of the candidates explains it.{_nearest(findings)}"
        return f"{none}{where}{_own(findings)}"
    words = []
    for one in findings.chosen:
        others = [e.candidate.spec for e in one.equals[1:]]
        words.append(f"{one.evidence.candidate.spec} (or {', '.join(others)}: not separable)" if others else "")
    named = listed([word or name for word, name in zip(words, names, strict=True)])
    beside = f"{_withheld(findings)}{_rest(findings, law)}{_levelled(findings)}"
    return f"{_called(findings)}: {named}.{_apart(findings)}{_as_good(findings)}{beside}"


def _nearest(findings: Findings) -> str:
    """Return which effects come near, and in what other form the flights fit them as well or better; empty for none."""
    words = []
    for form in findings.flight.others:
        if form.likelier and form.gain > 0:
            words.append(f" Nearest is {form.effect}, but the flights fit {form.words} better.")
        elif form.likelier:
            words.append(
                f" Nearest is {form.effect}, but these flights hardly tell it from {form.words}. Next, {form.then}."
            )
    return "".join(words)


def _levelled(findings: Findings) -> str:
    """Return which tilt of all flights is no more than errors of levelling, and how to add it; empty for none."""
    for one in findings.flight.levelled:
        sizes = [value for name, (value, _) in one.estimates.items() if name.startswith("tilt")]
        if sizes:
            return (
                f" All flights share a tilt of {1e3 * math.hypot(*sizes):.2g} mrad, which is no more than frames and "
                f"grounds are off level by: it is not named; `--effects {one.candidate.spec}` adds it."
            )
    return ""


def _withheld(findings: Findings) -> str:
    """Return which forces act beside the named ones and have no name, as their law is not known; empty for none."""
    words = [
        f" Beside it a force acts to which {one.effect} is nearest, but which these flights do not tell from "
        f"{one.words}. Next, {one.then}."
        for one in findings.flight.withheld
    ]
    return "".join(words)


def _as_good(findings: Findings) -> str:
    """Return which forms of the named forces the flights fit as well, and what tells them apart; empty for none."""
    words = [
        f" These flights do not tell {form.effect} from {form.words}. Next, {form.then}." for form in findings.as_good
    ]
    return "".join(words)


def _called(findings: Findings) -> str:
    """Return what the selected effects are called: where they explain too little, they are the nearest of the library.

    An effect in no library does some of what one in it does.
    """
    found = findings.flight
    partly = bool(found.in_flight) and is_significant(found.after)
    if partly and found.explained_share < THRESHOLDS.verdict.nearest_share:
        share = f"{100 * max(found.explained_share, 0.0):.0f} % of what exceeds the noise in flight"
        return f"Nearest in the library, which explains {share}"
    return "Missing"


def _misfit(findings: Findings) -> str:
    """Return which phases of contact are badly described, how badly, and what to record next for the worst."""
    bad = bad_ones(findings.misfits)
    words = []
    for one in bad:
        turned = "" if one.rotation_rms_rad is None else f" and {math.degrees(one.rotation_rms_rad):.2g} deg"
        size = f"{1e3 * one.position_rms_m:.2g} mm{turned} within {1e3 * one.segment_s:.0f} ms"
        times = f"{math.sqrt(one.reduced_chi2):.0f} times the noise"
        words.append(f"in {_PHASE_WORDS[one.phase]} it is off by {size} ({times})")
    return f"{listed(words)}, and none of the candidates explains it. Next, {bad[0].then}."


def _described(findings: Findings) -> str:
    """Return what is described down to the noise all the same; empty where nothing is."""
    if findings.flight.before is None or findings.remaining:
        return _DIFFERS if findings.remaining else ""
    return " In flight nothing is missing that these data could show."


def _own(findings: Findings) -> str:
    """Return what the accelerations follow that differ from episode to episode; empty for nothing."""
    law = findings.flight.own_law
    if law is None:
        return ""
    if law == "episode":
        return " Each episode is pushed in another direction; more episodes tell a tilt of each from a force."
    if law == UPWARD:
        return (
            " Each episode is pushed in another direction, upwards or downwards, too, which no tilt does, but the lift "
            "of a spin: measure the spin."
        )
    return f" Each episode is pushed in another direction, which follows its {law}."


def _apart(findings: Findings) -> str:
    """Return what rules out effects that flight alone does not tell from the selected ones; empty for none."""
    words = []
    for chosen in findings.chosen:
        name = chosen.evidence.name
        step = next((s for s in findings.flight.steps if s.flagged and name in {e.name for e in s.equals}), None)
        if step is not None and step.own_std is None:
            out = sorted({e.name for e in step.equals} - {e.name for e in chosen.equals})
            if out:
                it = "it" if len(out) == 1 else "them"
                words.append(f" In flight {listed(out)} would do the same as {name}; the contacts rule {it} out.")
    return "".join(words)


def _rest(findings: Findings, law: ResidualLaw | None) -> str:
    """Return what is left beside the selected effects, and the law of the residual, which can be added with them."""
    if not findings.remaining:
        return ""
    names = [one.evidence.candidate.spec for one in findings.chosen]
    names += [active.effect.name for active in findings.base.effects]
    further = () if law is None else further_terms(law, names)
    if not further:
        return f"{_left(findings)}{_own(findings)}"
    terms = listed([f"{term.coefficient:.3g} {term.unit} [{term.term}]" for term in further])
    return (
        f"{_left(findings, True)}{_own(findings)} A law describes a part of it: {terms}; `--save-law FILE.py` makes "
        "an effect of it that is added in the same step."
    )


def _left(findings: Findings, law: bool = False) -> str:
    """Return what is left beside the selected effects.

    Args:
        findings: The findings.
        law: Whether a law describes a part of it, which is then no error of the tracking alone.
    """
    found = findings.flight
    if found.repeats and found.left is not None:
        share = f"{100 * found.common_share:.0f} % of what repeats from episode to episode is explained"
        what = "a constant force" if found.left.coordinate == "constant" else f"a force by {found.left.coordinate}"
        return f" In addition, something remains unexplained: {share}, and {what} remains."
    if found.slow is not None and not law and found.own_law is None:
        return (
            " In addition, something remains unexplained; it differs from episode to episode, as errors of the "
            "tracking do."
        )
    return " In addition, something remains unexplained."


def unseen_motion(prepared: Prepared) -> str:
    """Return the sentence that limits the verdict to the kind of motion that was measured; empty for both kinds."""
    if not prepared.contact_items:
        return " Only flight was measured, so the verdict does not cover contact."
    if prepared.flight is None:
        return " Only contact was measured, so the verdict does not cover flight."
    return ""


def motion_warnings(prepared: Prepared, on_surfaces: bool = False) -> list[str]:
    """Return a warning if the episodes have no contact or no flight, of which rolls on surfaces show some effects."""
    if not prepared.contact_items:
        return ["the tracks contain no usable contact: effects that act in contact cannot be tested."]
    if prepared.flight is None:
        tested = "are tested by rolling and sliding alone" if on_surfaces else "cannot be tested"
        return [f"the tracks contain no usable flight: effects that act in flight {tested}."]
    return []


def noisy_warnings(prepared: Prepared, findings: Findings) -> list[str]:
    """Return a warning that names the episodes of which no flight was searched, since they are noisier than all others.

    Args:
        prepared: The episodes as they were given.
        findings: The findings, whose flights are those that were searched.
    """
    searched = findings.flight.prepared.flight
    if prepared.flight is None or searched is None:
        return []
    lost = {item.episode for item in prepared.flight.items} - {item.episode for item in searched.items}
    if not lost:
        return []
    names = ", ".join(prepared.names[k] for k in sorted(lost))
    return [
        f"{names}: left out of the search in flight, where no effect brings the flights as near as those of others."
    ]


def size_warnings(findings: Findings) -> list[str]:
    """Return a warning for each selected effect that is larger than instruments or nature usually have it."""
    found = []
    for chosen in findings.chosen:
        one = chosen.evidence
        effect, values = one.candidate.effect, {name: value for name, (value, _) in one.estimates.items()}
        others = [f"{other.candidate.spec} with {_sizes(other)}" for other in chosen.equals[1:] if other.estimates]
        same = f" The same is done by {listed(others)}." if others else ""
        for p in implausible(effect, values):
            unit = _unit(p)
            found.append(
                f"{one.candidate.spec}: {p.name} = {values[p.name]:.2g}{unit}, and more than {p.plausible:g}{unit} is "
                "rare. Check what was given (frame rate, units, lengths), or look for a force that does the same."
                f"{same}"
            )
    return found


def _sizes(evidence: Evidence) -> str:
    """Return the estimates of an effect in words."""
    parameters = {p.name: p for p in evidence.candidate.effect.parameters}
    return ", ".join(f"{k} = {v:.2g}{_unit(parameters[k])}" for k, (v, _) in evidence.estimates.items())


def _unit(parameter: EffectParameter) -> str:
    """Return the unit of a parameter as it follows a number; empty for none."""
    return "" if parameter.unit == "1" else f" {parameter.unit}"


def misfit_warnings(findings: Findings) -> list[str]:
    """Return a warning where the law of contact does not describe a phase and the verdict is about another thing."""
    if findings.verdict == "law_inexact" or not bad_ones(findings.misfits):
        return []
    return [f"{_INEXACT}: {_misfit(findings)}"]


def law_warnings(findings: Findings) -> list[str]:
    """Return a warning for each effect that slides show no better than a law does that is no candidate."""
    lines = [
        f"{name}: not named, since the slides fit a friction that changes at a line across the ground as well: oil, "
        "another floor, a worn spot. Next, record slides of several speeds over the same places, and slides that stay "
        "on one side."
        for name in findings.as_line
    ]
    return lines + [
        f"{name}: not named, since the slides fit a friction limited along each of two axes by itself as well, as "
        "engines with a friction pyramid have it and no surface does. Next, where they were measured on a surface, "
        "record slides along x, along y and between them."
        for name in findings.as_pyramid
    ]

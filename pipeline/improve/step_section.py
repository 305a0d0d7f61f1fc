"""A step of a ladder on its page: what was missing, the evidence, what was tried, the errors on unseen episodes."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas import (
    ErrorRatio,
    FittedParameter,
    ImproveStep,
    ImproveTest,
    ImproveTestStep,
    ImproveTrial,
    RankedEffect,
)
from ..report.page import fixed, listed, number, paragraph, section, table, text, unit_text, unit_words
from ..report.plots import Bar, bars
from .wording import WHY, not_added_words, share_words, trial_words

RANKED = 6
"""Number of candidates that are shown of a ranking."""
_MM = 1e3


def accepted(step: ImproveStep) -> ImproveTrial | None:
    """Return the trial of the addition that a step has made."""
    return next((one for one in step.tried if one.helps and one.effects == step.added), None)


def tested_step(test: ImproveTest | None, model: str, than: str) -> ImproveTestStep | None:
    """Return the errors on test episodes of a model over those of another; None where they were not measured."""
    steps = () if test is None else test.steps
    return next((one for one in steps if (one.model, one.than) == (model, than)), None)


def ratios(found: ImproveTrial | ImproveTestStep | None) -> str:
    """Return the ratios in flight and in contact with their intervals."""
    if found is None:
        return "–"
    known = [(kind, one) for kind, one in (("flight", found.flight), ("contact", found.contact)) if one is not None]
    return "<br>".join(f"{kind} {_ratio(one)}" for kind, one in known) or "–"


def _ratio(ratio: ErrorRatio) -> str:
    span = ratio.interval_95
    return number(ratio.ratio) + (f" ({number(span[0])} to {number(span[1])})" if span else " (no interval)")


def step_section(place: int, step: ImproveStep, test: ImproveTest | None) -> str:
    """Return the section of a step that has added something."""
    return section(
        f"Step {place}: {', '.join(step.added)}",
        paragraph(f"What {step.model} lacks. {step.sentence}"),
        *map(paragraph, [*share_words(step), *not_added_words(step)]),
        _unseen(accepted(step), tested_step(test, step.next_model or "", step.model)),
        _parameters(step.next_parameters),
        "<h3>Evidence</h3>",
        _chart(step),
        ranking_table(step),
        rivals(step),
        trials(step),
        law_words(step),
    )


def _unseen(judged: ImproveTrial | None, tested_: ImproveTestStep | None) -> str:
    """Return the table of prediction errors on unseen episodes before and after a step."""
    rows = [
        [
            text(where),
            kind,
            number(ratio.before),
            number(ratio.after),
            _ratio(ratio),
            f"{ratio.better} of {ratio.episodes}",
        ]
        for where, found in (("cross-validated", judged), ("test episodes", tested_))
        for kind in ("flight", "contact")
        if found is not None and (ratio := getattr(found, kind)) is not None
    ]
    header = ["unseen episodes", "in", "error before [noise]", "error after [noise]", "ratio (95 %)", "smaller in"]
    return table(header, rows, (2, 3)) if rows else ""


def _parameters(parameters: Sequence[FittedParameter]) -> str:
    rows = [
        [
            f"<code>{text(p.name)}</code>",
            number(p.estimate),
            f"{number(p.interval_95[0])} to {number(p.interval_95[1])}" if p.interval_95 else "–",
            unit_text(p.unit),
        ]
        for p in parameters
    ]
    return table(["parameter", "estimate", "95 % interval", "unit"], rows, (1, 2)) if rows else ""


def _chart(step: ImproveStep) -> str:
    """Return the chart of how much better the best candidates describe flights; empty where none was refitted."""
    judged = sorted((e for e in step.ranking if e.delta_bic is not None), key=lambda e: e.delta_bic or 0.0)[:RANKED]
    if not judged or (judged[0].delta_bic or 0.0) >= 0:
        return ""
    words = (
        "How much better flights are described with each candidate alone, or beside the ones named before it: the "
        "fall of BIC, twice the rise of the log-likelihood less a charge for each fitted number. A difference of 10 "
        "is strong evidence for the longer bar."
    )
    rows = [
        Bar(name=e.effect, value=-e.delta_bic, words=number(-e.delta_bic), strong=e.effect in step.selected)
        for e in judged
        if e.delta_bic is not None
    ]
    return paragraph(words) + bars(rows)


def ranking_table(step: ImproveStep) -> str:
    """Return the table of the selected candidates and the best others."""
    shown = [e for e in step.ranking if e.effect in step.selected]
    shown += [e for e in step.ranking if e not in shown][: max(RANKED - len(shown), 0)]
    rows = [
        [
            text(entry.effect),
            text(", ".join(entry.acts_in)),
            f"{entry.score_p:.2g}".replace("-", "−") if entry.score_p > 0 else "&lt; 1e−300",
            number(entry.delta_bic),
            f"{fixed(entry.cv_error_before_m, 2, _MM)} → {fixed(entry.cv_error_after_m, 2, _MM)}"
            if entry.cv_error_after_m is not None
            else "–",
            _gain(entry),
            "; ".join(f"{text(p.name)} = {number(p.estimate)} ± {number(p.std_error, 2)}{unit_words(p.unit)}"
                      for p in entry.parameters[:3]),
        ]
        for entry in shown
    ]  # fmt: skip
    if not rows:
        return paragraph("No candidate was tested.", "soft")
    strong = [k for k, entry in enumerate(shown) if entry.effect in step.selected]
    header = ["candidate", "acts in", "p-value", "change of BIC", "held-out error [mm]", "held-out gain [nats]"]
    return table([*header, "estimate"], rows, (2, 3), strong)


def _gain(entry: RankedEffect) -> str:
    """Return the rise of the log-likelihood of held-out episodes, with its interval."""
    if entry.held_out_nats is None:
        return "–"
    span = entry.held_out_nats_95
    return _nats(entry.held_out_nats) + (f" ({_nats(span[0])} to {_nats(span[1])})" if span else "")


def _nats(value: float) -> str:
    return number(value) if abs(value) >= 1 else fixed(value + 0.0, 2)


def rivals(step: ImproveStep) -> str:
    """Return which effects the data cannot tell from the selected ones; empty where none is selected."""
    if not step.selected:
        return ""
    if not step.aliases:
        return paragraph(f"No rival: no other candidate explains these data as well as {listed(step.selected)}.")
    said = [f"These data cannot tell {one[0]} from {' or '.join(one[1:])}." for one in step.aliases]
    return paragraph(" ".join(said))


def trials(step: ImproveStep) -> str:
    """Return the table of what was tried on unseen episodes; empty for nothing."""
    if not step.tried:
        return ""
    rows = [
        [
            text(", ".join(trial.effects)),
            text(WHY[trial.why]),
            ratios(trial),
            text(trial_words(trial)),
        ]
        for trial in step.tried
    ]
    header = ["tried", "why", "error after / before, unseen", "outcome"]
    return "<h3>Tried on unseen episodes</h3>" + table(header, rows, strong=_helped(step))


def _helped(step: ImproveStep) -> list[int]:
    return [k for k, trial in enumerate(step.tried) if trial.helps and trial.effects == step.added]


def law_words(step: ImproveStep) -> str:
    """Return the law of the residual force that regression has found; empty for none."""
    law = step.residual_law
    if law is None or not law.terms:
        return ""
    terms = ", ".join(f"{number(t.coefficient)} ± {number(t.std_error, 2)} {t.unit} [{t.term}]" for t in law.terms)
    return paragraph(f"Law of the residual force, by regression: {terms}. What is left of it has a mean chi2 of "
                     f"{number(law.left_chi2)} (1: noise).")  # fmt: skip

"""The verb `cgwm diagnose`: find the effect that a model lacks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .execution import Emit, loading
from .options import AcceptUnits, AnyDevice, Overwrite, TrustEffects, require_models_first, trust
from .verb import verb

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..schemas import (
        ContactLimit,
        DiagnoseResult,
        NextExperiment,
        NextMotions,
        RankedEffect,
        Remaining,
        ResidualLaw,
    )

SHOWN = 8
"""Number of candidates that are listed; --json has all."""
THROWS_SHOWN = 3
"""Number of throws that are listed."""


@verb
def diagnose(
    emit: Emit,
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="The model's directory.", show_default=False)],
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE",
            help="The capture.",
            show_default=False,
        ),
    ],
    split: Annotated[str, typer.Option("--split", metavar="NAME", help="The episodes to look at.")] = "train",
    candidates: Annotated[
        str,
        typer.Option(
            "--candidates",
            metavar="FILE.py:CLASS,...",
            help="Custom effects, in addition to the built-in ones.",
            show_default=False,
        ),
    ] = "",
    throws: Annotated[
        Path | None,
        typer.Option(
            "--throws",
            metavar="FILE",
            help="Candidates for the next throw: a TOML file of [[throws]] tables.",
            show_default="about 30 that can be thrown by hand",
        ),
    ] = None,
    save_law: Annotated[
        Path | None,
        typer.Option(
            "--save-law",
            metavar="FILE.py",
            help="If no candidate explains the residual, write its law as a custom effect.",
            show_default=False,
        ),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(
            "--page",
            metavar="FILE",
            help="The page to write (diagnose-MODEL.html beside the model; one of the same model and capture is "
            "replaced).",
            show_default=False,
        ),
    ] = None,
    device: AnyDevice = "auto",
    overwrite: Overwrite = False,
    trust_effects: TrustEffects = "",
    accept_units: AcceptUnits = False,
) -> None:
    """Find the missing physical or measurement effect, and those that these data cannot distinguish from it."""
    trust(trust_effects)
    require_models_first("diagnose", [model], capture)
    with loading():
        from ..pipeline.diagnose import diagnose as work
        from ..pipeline.diagnose.report.page import default_page

    wanted = [name.strip() for name in candidates.split(",") if name.strip()]
    place = page or default_page(model, split)
    result = work(model, capture, split, wanted, throws, save_law, overwrite, device, accept_units, place)
    emit(result, lambda found: _summary(found, model, capture, split))


def _summary(result: DiagnoseResult, model: Path, capture: Path, split: str) -> str:
    from ..pipeline.diagnose.report.next_command import next_command
    from .output import next_line, table, warnings

    words = next_command(result, model, capture, split)
    rows = [_row(entry, result) for entry in _shown(result)]
    lines = [result.sentence, table(rows, ["effect", "acts in", "judged in", "p", "evidence", "estimate"])]
    lines += [*_misfit(result, split), *_limits(result.contact_limits), *_held_out_errors(result.ranking, split)]
    lines += _remaining(result.remaining)
    if result.residual_law is not None:
        lines.append(f"law of the residual: {_terms(result.residual_law) or 'none found'}")
    if result.next_experiment is not None:
        lines += _experiment(result.next_experiment)
    lines += _motions(result.next_motions)
    lines += [f"Wrote {result.saved_law.rpartition(':')[0]}."] if result.saved_law is not None else []
    lines += [f"Page: {result.report}"] if result.report is not None else []
    return "\n".join([*lines, *warnings(result.warnings), next_line(*words)])


def _misfit(result: DiagnoseResult, split: str) -> list[str]:
    """Return the misfit of the flights, without and with the named effects; nothing where it was not measured."""
    from ..pipeline.report.page import listed

    if result.flight_before is None or result.flight_after is None:
        return []
    added = f"; with {listed(result.selected)} {result.flight_after.statistic:.2f}" if result.selected else ""
    return [
        f"misfit of the flights of '{split}' (mean chi2 of the force that each piece of at most 0.3 s lacks; noise "
        f"alone gives 1): {result.flight_before.statistic:.2f}{added}"
    ]


def _terms(law: ResidualLaw) -> str:
    return ", ".join(f"{t.coefficient:.3g} {t.unit} [{t.term}]" for t in law.terms)


def _shown(result: DiagnoseResult) -> list[RankedEffect]:
    """Return the candidates of the table: the selected ones, then the best of the others."""
    shown = [entry for entry in result.ranking if entry.effect in result.selected]
    shown += [entry for entry in result.ranking if entry not in shown]
    return shown[:SHOWN]


def _held_out_errors(ranking: Sequence[RankedEffect], split: str) -> list[str]:
    """Return the errors, without and with each effect, in episodes of the split that its fit did not use."""
    from .output import millimetres

    lines = []
    tried = [one for one in ranking if one.cv_error_before_m is not None and one.cv_error_after_m is not None]
    beside = ", beside the others" if len(tried) > 1 else ""
    for one in tried:
        errors = f"{millimetres(one.cv_error_before_m or 0.0)} -> {millimetres(one.cv_error_after_m or 0.0)}"
        lines.append(
            f"{one.effect}: error in episodes of '{split}' held out in turn, without and with it{beside}: {errors}"
        )
    if lines:
        first = "(of the second half of each piece of motion, from its first half; cgwm compare starts from 0.1 s of a "
        lines.append(f"{first}whole episode, and its errors are larger)")
    return lines


def _remaining(found: Remaining | None) -> list[str]:
    """Return what is left in flight, in words, where errors are slow or something repeats."""
    from .output import millimetres

    if found is None or not (found.slow_position_std_m or found.own_acceleration_std_m_s2 or found.repeats):
        return []
    words = [f"{millimetres(found.position_rms_m)} in whole flights"]
    if found.slow_position_std_m and found.slow_time_s is not None:
        time = "over the whole flight" if found.slow_time_s > 0.9 else f"within {1e3 * found.slow_time_s:.0f} ms"
        words.append(f"slow errors of {millimetres(found.slow_position_std_m)} that change {time}")
    if found.own_acceleration_std_m_s2:
        words.append(f"accelerations of each flight's own of {found.own_acceleration_std_m_s2:.2g} m/s2")
    if found.repeats:
        words.append(f"a part that repeats from episode to episode, by {found.coordinate}")
    return [f"left in flight: {'; '.join(words)}"]


def _limits(limits: tuple[ContactLimit, ...]) -> list[str]:
    """Return the detection limits of effects in contact, below which the diagnosis makes no statement."""
    seen = [f"{one.effect} from {_sizes(one)}" for one in limits if one.sizes]
    blind = [one.effect for one in limits if not one.sizes]
    lines = [f"approximate detection limits in contact: {'; '.join(seen)}"] if seen else []
    return [*lines, *([f"hardly detectable in contact: {', '.join(blind)}"] if blind else [])]


def _sizes(limit: ContactLimit) -> str:
    words = [f"{name} = {size:.2g} {limit.units[name]}".removesuffix(" 1") for name, size in limit.sizes.items()]
    return ", ".join(words)


def _motions(found: NextMotions | None) -> list[str]:
    """Return the motions to record next for contact, one a line, and what they show."""
    from ..pipeline.report.page import listed

    if found is None:
        return []
    if found.separates:
        lines = [f"To distinguish {listed(found.separates)}, record next and add to the split:"]
    else:
        lines = ["To see effects of contact that these data could not show, record next and add to the split:"]
    lines += [f"  {place}. {motion.what}" for place, motion in enumerate(found.motions, 1)]
    shown = [
        f"{one.effect} from {one.then_from:g} {one.unit}".removesuffix(" 1")
        + (f" (now {one.seen_from:g})" if one.seen_from is not None else " (now hardly)")
        for one in found.reveals
    ]
    return [*lines, *([f"  expected to show then: {'; '.join(shown)}"] if shown else [])]


def _experiment(found: NextExperiment) -> list[str]:
    from ..pipeline.report.page import listed

    if not found.ranked:
        return [f"Measure next: {found.what}."]
    lines = [f"To distinguish {listed(found.separates)}: {found.what}."]
    lines.append(f"  1. {found.ranked[0]['what']} (about {found.ranked[0]['order_of_magnitude']:g} nats expected)")
    lines += [
        f"  {entry['rank']}. {entry['what']} (about {entry['order_of_magnitude']:g} nats)"
        for entry in found.ranked[1:THROWS_SHOWN]
    ]
    return lines


def _row(entry: RankedEffect, result: DiagnoseResult) -> list[str]:
    return [
        entry.effect,
        ", ".join(entry.acts_in),
        entry.judged_in,
        f"{entry.score_p:.2g}" if entry.score_p > 0 else "< 1e-300",
        _evidence(entry, result),
        _numbers(entry),
    ]


def _numbers(entry: RankedEffect) -> str:
    """Return the parameters of an effect, and by how much they differ between groups or episodes."""
    numbers = ", ".join(
        f"{p.name} = {p.estimate:.3g} +- {p.std_error:.2g}{'' if p.unit == '1' else f' {p.unit}'}"
        for p in entry.parameters[:3]
    )
    if len(entry.parameters) > 3:
        numbers += ", ..."
    if entry.spread:
        unit = "group" if entry.effect.endswith("@group") else "episode"
        stds = ", ".join(f"{std:.2g}" for std in entry.spread.values())
        differ = "differs" if len(entry.spread) == 1 else "differ"
        numbers += f"; {', '.join(entry.spread)} {differ} by {stds} from {unit} to {unit}"
    return numbers


def _evidence(entry: RankedEffect, result: DiagnoseResult) -> str:
    """Return the figure that decides: the fall of BIC in flight, the score in contact; empty without a refit.

    An effect that was named after others was judged beside these, and so were its equals.
    """
    if entry.judged_in == "contact" and entry.contact_score is not None:
        return f"score {entry.contact_score:.0f}"
    if entry.delta_bic is None:
        return ""
    from ..pipeline.report.page import listed

    places = [k for k, name in enumerate(result.selected) if entry.effect in result.equals_of(name)]
    beside = result.selected[: places[0]] if places else ()
    return f"BIC {entry.delta_bic:+.0f}" + (f" beside {listed(beside)}" if beside else "")

"""The page of a ladder: what was missing at each step, the evidence, the errors on unseen episodes, what remains."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from ...schemas import ImproveResult, ImproveStep, ImproveTest, ImproveTestFigures
from ..diagnose.report.page import asked_motions, drawn_throw
from ..diagnose.report.pictures import DrawnMotion
from ..report.page import (
    cautions,
    command,
    facts,
    fixed,
    folded,
    link,
    listed,
    number,
    page,
    paragraph,
    section,
    table,
    text,
)
from ..report.plots import Bar, bars
from .step_section import accepted, law_words, ranking_table, ratios, rivals, step_section, tested_step, trials
from .wording import AXES, not_added_words, remaining_words

PAGE = "improve.html"
_MM = 1e3


def ladder_html(result: ImproveResult, out: Path, throw: Sequence[DrawnMotion] = ()) -> str:
    """Return the HTML page of a ladder.

    Args:
        result: The ladder.
        out: Its directory.
        throw: The experiment of `asking_step`, drawn.
    """
    ladder = [step for step in result.steps if step.added]
    ends = [step for step in result.steps if not step.added]
    body = [
        f"<h1>cgwm improve · {text(Path(result.capture).name)} · {result.episodes} episodes of split "
        f"{text(result.split)}</h1>",
        f'<p class="verdict">{text(result.sentence)}</p>',
        _cards(result.test),
        cautions(result.warnings),
        _overview(result, ladder),
        *(step_section(number, step, result.test) for number, step in enumerate(ladder, 1)),
        *(_remains(step, result) for step in ends),
        _measure_next(result.steps, throw),
        _commands(result, out),
        _judged(result),
        _provenance(result, out),
    ]
    title = f"cgwm improve: {Path(result.capture).name}"
    return page(title, [piece for piece in body if piece])


def _cards(test: ImproveTest | None) -> str:
    """Return the cards of the errors on the test episodes, of the last model and of the first."""
    if test is None:
        return ""
    first, last = test.models[0], test.models[-1]
    known = [
        ("prediction error in flight, times the noise", first.flight, last.flight, 1.0, ""),
        ("prediction error in contact, times the noise", first.contact, last.contact, 1.0, ""),
        (
            "error of whole episodes, open loop",
            first.translation_error_m.median,
            last.translation_error_m.median,
            _MM,
            "mm",
        ),
    ]
    if first.state_fitted_residual_m is not None and last.state_fitted_residual_m is not None:
        residuals = (first.state_fitted_residual_m.median, last.state_fitted_residual_m.median)
        known.append(("the same with the start fitted", *residuals, _MM, "mm"))
    same = first.model == last.model
    cards = [
        f'<div class="card"><div>{name}</div><div class="value">{number(after * scale)} {unit}</div><dl>'
        + ("" if same else f"<dt>{text(first.model)}</dt><dd>{number(before * scale)} {unit}</dd>")
        + f"<dt>model</dt><dd>{text(last.model)}</dd>"
        f"<dt>test episodes</dt><dd>{test.episodes}</dd></dl></div>"
        for name, before, after, scale, unit in known
        if before is not None and after is not None
    ]
    return f'<div class="cards">{"".join(cards)}</div>'


def _overview(result: ImproveResult, ladder: Sequence[ImproveStep]) -> str:
    test = result.test
    tested = {one.model: one for one in test.models} if test is not None else {}
    rows = []
    for k, name in enumerate(result.models):
        one = tested.get(name)
        added = "as fitted" if k == 0 else ", ".join(ladder[k - 1].added)
        judged = None if k == 0 else accepted(ladder[k - 1])
        tests = tested_step(test, name, result.models[k - 1]) if k else None
        rows.append(
            [
                text(name),
                text(added),
                ratios(judged),
                ratios(tests),
                fixed(one.translation_error_m.median if one else None, 1, _MM),
                fixed(one.state_fitted_residual_m.median if one and one.state_fitted_residual_m else None, 1, _MM),
                number(one.flight if one else None),
                number(one.contact if one else None),
            ]
        )
    header = ["model", "added", "ratio, cross-validated", "ratio, test", "open loop [mm]", "state-fitted [mm]"]
    words = (
        "Ratio: prediction error after the step over that before it, geometric mean over episodes, with its "
        "95 % interval. Cross-validated: episodes of the split that decides, each predicted by a model that was not "
        "fitted to it. The last columns are medians over the test episodes."
    )
    header += ["flight [noise]", "contact [noise]"]
    charts = [_errors_chart(kind, tested, result.models[-1]) for kind in ("flight", "contact")]
    return section("The ladder", paragraph(words), table(header, rows, (4, 5, 6, 7)), *charts)


def _errors_chart(kind: str, tested_: Mapping[str, ImproveTestFigures], last: str) -> str:
    """Return the chart of the prediction errors of all models on the test episodes; empty where there are none."""
    rows = [
        Bar(name=name, value=value, words=f"{number(value)} times the noise", strong=name == last)
        for name, one in tested_.items()
        if (value := getattr(one, kind)) is not None
    ]
    return paragraph(f"Prediction error of the test episodes in {kind}:") + bars(rows) if rows else ""


def _remains(step: ImproveStep, result: ImproveResult) -> str:
    """Return the section of the diagnosis to which nothing was added."""
    pieces = [paragraph(f"Diagnosis of {step.model}. {step.sentence}")]
    if result.refusal:
        pieces.append(paragraph(f"It could not be diagnosed again: {result.refusal}"))
    pieces += [*map(paragraph, [*not_added_words(step), *remaining_words(step)]), _sizes(step)]
    return section(
        "What remains", *pieces, rivals(step), law_words(step), trials(step), ranking_table(step), _limits(step)
    )


def _sizes(step: ImproveStep) -> str:
    """Return the chart of what is left in flight: all of it, its slow part, and the noise."""
    found = step.remaining
    if found is None:
        return ""
    sizes = [("measurement less model", found.position_rms_m / AXES, True)]
    sizes += [("slow errors", found.slow_position_std_m, False)] if found.slow_position_std_m else []
    sizes += [("noise from frame to frame", std, False)] if (std := step.noise.get("position_m")) else []
    rows = [
        Bar(name=name, value=size, words=f"{fixed(size, 2, _MM)} mm", strong=strong) for name, size, strong in sizes
    ]
    return "<h3>Positions in flight, error along each axis</h3>" + bars(rows)


def _limits(step: ImproveStep) -> str:
    """Return what contact would have shown, folded."""
    rows = []
    for limit in step.contact_limits:
        sizes = [f"{name} = {number(size, 2)} {limit.units[name]}".removesuffix(" 1")
                 for name, size in limit.sizes.items()]  # fmt: skip
        rows.append([text(limit.effect), text(", ".join(sizes)) or "hardly detectable in these motions"])
    rows += [[text(name), f"not tested: {text(why)}"] for name, why in step.not_tested.items()]
    words = "What could not have been seen: effects of contact below these sizes, and candidates that were not tested"
    return folded(words, table(["effect", "seen from"], rows)) if rows else ""


def asking_step(steps: Sequence[ImproveStep]) -> ImproveStep | None:
    """Return the last step whose diagnosis has proposed an experiment; None where none has."""
    return next((one for one in reversed(steps) if one.next_experiment is not None), None)


def _measure_next(steps: Sequence[ImproveStep], throw: Sequence[DrawnMotion]) -> str:
    """Return the last experiment that a diagnosis has proposed, and the motions for contact that the last asks for."""
    pieces = _throw(steps, throw)
    if steps and (motions := steps[-1].next_motions) is not None:
        pieces += asked_motions(motions, f"Asked for by the diagnosis of {steps[-1].model}.")
    if pieces or not steps:
        return section("What to measure next", *pieces) if pieces else ""
    words = "No rivals are left that another motion would tell apart, and no effect of contact that one would show."
    return section("What to measure next", paragraph(words))


def _throw(steps: Sequence[ImproveStep], throw: Sequence[DrawnMotion]) -> list[str]:
    step = asking_step(steps)
    if step is None or (found := step.next_experiment) is None:
        return []
    apart = f" It tells {listed(found.separates)} apart." if found.separates and found.initial_state else ""
    pieces = [
        paragraph(f"{found.what[:1].upper()}{found.what[1:]}.{apart} Asked for by the diagnosis of {step.model}."),
        drawn_throw(throw),
    ]
    rows = [[text(entry["rank"]), text(entry["what"]), number(entry.get("order_of_magnitude"), 2)]
            for entry in found.ranked[:3]]  # fmt: skip
    if rows:
        words = (
            "The best of the motions that were compared, with the rise of the log-likelihood ratio that each is "
            "expected to give, to the power of ten; 5 are odds of about 150 to 1."
        )
        pieces += [paragraph(words), table(["rank", "motion", "expected gain [nats]"], rows, (2,))]
    if rows and found.not_separated:
        pieces.append(paragraph(f"None of them separates {listed(found.not_separated)}."))
    return pieces


def _commands(result: ImproveResult, out: Path) -> str:
    first, last = out / result.models[0], out / result.models[-1]
    pair = shlex.join(["cgwm", "compare", str(first), str(last), result.capture])
    typed = [command(pair)] if first != last else []
    typed.append(command(f"cgwm synthesize {shlex.quote(str(last))} --out DATASET"))
    links = ", ".join(link(name, out / name, out / PAGE) for name in result.models)
    return section("Models and commands", f"<p>Models: {links}. Every other command accepts them.</p>", *typed)


def _judged(result: ImproveResult) -> str:
    words = (
        f"The {result.episodes} episodes of split '{result.split}' were divided into {len(result.folds)} parts. For "
        "each part and each addition all parameters were fitted to the other parts, and the part was predicted. An "
        "addition stays if the error of these predictions falls by at least 2 % in flight or in contact, with a 95 % "
        "interval of the ratio below 1, and in neither rises by 2 % or more beyond chance. The diagnosis that proposes "
        "additions sees the whole split, so that these intervals are a little too short; those of the test episodes "
        "are not, as they have decided nothing."
    )
    short = (
        "Prediction error: the motion is cut into segments of flight and contact; the state of each is fitted to its "
        "first half, and the second half is predicted (on fixed surfaces to the first 0.1 s of an episode, and the "
        "rest of it is predicted). Frames are averaged on a logarithmic scale, so that a few impacts do not outweigh a "
        "long flight. The unit is the noise of the measurement; the error of the fitted "
        "state is included, so that a perfect model has an error above 1."
    )
    return section("How it was judged", paragraph(words), paragraph(short))


def _provenance(result: ImproveResult, out: Path) -> str:
    rows = [
        ("capture", link(result.capture, result.capture, out / PAGE)),
        ("versions", text(", ".join(f"{name} {version}" for name, version in result.versions.items()))),
        ("figures", link("improve.json", out / "improve.json", out / PAGE)),
    ]
    rows += [(name, f'<code class="long">{text(digest)}</code>') for name, digest in result.model_sha256.items()]
    return section("Provenance", facts(rows))

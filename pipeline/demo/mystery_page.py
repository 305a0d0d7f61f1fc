"""The page of the mystery: five steps from a model to its missing effect, and at the end what was hidden."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...schemas import ComparedParameter, HiddenEffect, ModelComparison, MysteryResult, RankedEffect
from ..compare.error_ladder import LADDER_WORDS, error_ladder
from ..compare.player import REPLAY_STYLE
from ..report.charts import interval_svg
from ..report.page import (
    cautions,
    fixed,
    number,
    page,
    paragraph,
    read_asset,
    section,
    table,
    text,
    unit_text,
    unit_words,
    way_link,
)

REPORT_HTML = "report.html"
REPORT_JSON = "report.json"

SHOWN = 8
"""Number of candidates that are listed."""
_LEAST_P = 1e-300
_STYLE = read_asset(__name__, "mystery.css")
_LINK = '<p>Predicted and measured motion, and all figures: <a href="compare.html">compare.html</a>.</p>'
_GOOD = ("right", "right_class")


def mystery_html(result: MysteryResult) -> str:
    """Return the whole page."""
    added = bool(result.diagnosis.selected)
    body = [
        f"<h1>cgwm demo · scene mystery · seed {result.seed}</h1>",
        paragraph(_opening(result), "verdict"),
        _fit(result),
        _fails(result),
        _diagnosis(result),
        _added(result),
        _compared(result) if added else "",
        _hidden(result),
        _files(result),
    ]
    title = f"cgwm demo: mystery, seed {result.seed}"
    return page(title, [part for part in body if part], REPLAY_STYLE + _STYLE)


def _opening(result: MysteryResult) -> str:
    return (
        f"A {result.body} was thrown, pushed and dropped {result.train_episodes + result.test_episodes} times in "
        "another simulator, perhaps with something in its physics or in its measurement that a textbook omits. "
        "What, if anything? The answer was in a sealed file until all of this had been computed."
    )


def _commands(*lines: str) -> str:
    return f"<pre><code>{text(chr(10).join(lines))}</code></pre>"


# The five steps


def _fit(result: MysteryResult) -> str:
    return section(
        "1. Fit a model",
        _commands(f"cgwm fit capture --out m0 {result.settings}"),
        paragraph(
            f"From {result.train_episodes} tracked episodes: a rigid body with free flight and with contacts modelled "
            "as a spring, a damper and Coulomb friction, without further effects. (The setting halves the time of the "
            "demo.)"
        ),
    )


def _fails(result: MysteryResult) -> str:
    base = result.comparison.models[0]
    return section(
        "2. Compare it with the measurement",
        _commands("cgwm compare m0 capture"),
        paragraph(
            f"On {result.test_episodes} episodes that the fit has not seen, its error is "
            f"{_mm(base.translation_error_m.median)} (median). Short predictions, each from the start that fits it "
            "best, show where the model fails: their errors in units of the measurement noise are about 1 where the "
            "model explains the data."
        ),
        _phases([base], ["m0"]),
        "" if result.diagnosis.selected else _LINK,
    )


def _diagnosis(result: MysteryResult) -> str:
    found = result.diagnosis
    best = found.ranking[:SHOWN]
    best = [*best, *(entry for entry in found.ranking[SHOWN:] if entry.effect in found.selected)]
    header = ["effect", "acts in", "judged in", "p", "estimate", "held-out error, without → with"]
    rows = [_candidate(entry) for entry in best]
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    chosen = [k for k, entry in enumerate(best) if entry.effect in found.selected]
    pieces = [
        _commands("cgwm diagnose m0 capture"),
        paragraph(found.sentence, "verdict"),
        paragraph(
            "Each candidate effect is tested on the training episodes; the best few are fitted and cross-validated on "
            "episodes that were held out from their fit. The test episodes are not used. "
            f"{len(found.ranking)} candidates were tested; these fit best:"
        ),
        table(header, rows, strong=chosen),
        paragraph(
            "p: p-value of one candidate alone against the model without it. If a large effect is missing, many "
            "candidates improve the model; the diagnosis chooses between them.",
            "soft",
        ),
    ]
    if found.aliases:
        groups = "; ".join(", ".join(group) for group in found.aliases)
        pieces.append(paragraph(f"These data cannot distinguish: {groups}."))
    before, after = found.flight_before, found.flight_after
    if before is not None and after is not None:
        pieces.append(
            paragraph(
                f"A force that is missing in flight raises the mean χ² above 1; it is {number(before.statistic)}"
                + (f", and {number(after.statistic)} with the named effects." if found.selected else ".")
            )
        )
    return section("3. Diagnose: what is missing?", *pieces)


def _candidate(entry: RankedEffect) -> list[str]:
    numbers = "<br>".join(
        f"<code>{text(p.name)}</code> = {number(p.estimate)} ± {number(p.std_error, 2)}{unit_words(p.unit)}"
        for p in entry.parameters[:3]
    )
    # number() writes magnitudes below 1e-12 as zero; a p-value may be that small
    p = "< 1e-300" if entry.score_p < _LEAST_P else f"{entry.score_p:.1g}"
    before, after = entry.cv_error_before_m, entry.cv_error_after_m
    gain = "" if before is None or after is None else f"{fixed(before, 2, 1e3)} → {fixed(after, 2, 1e3)} mm"
    return [
        f"<code>{text(entry.effect)}</code>",
        text(", ".join(entry.acts_in)),
        text(entry.judged_in),
        text(p.replace("-", "−")),
        numbers + ("<br>…" if len(entry.parameters) > 3 else ""),
        gain,
    ]


def _added(result: MysteryResult) -> str:
    selected = result.diagnosis.selected
    if not selected:
        return section(
            "4. Add it",
            paragraph("The diagnosis named no effect, so nothing is added and no second model is compared."),
        )
    rows = [
        [f"<code>{text(p.name)}</code>", number(p.estimate), _span(p.interval_95), unit_text(p.unit)]
        for p in (compared.parameter for compared in result.parameters)
    ]
    return section(
        "4. Add it",
        _commands(f"cgwm fit capture --from m0 --effects {','.join(selected)} --out m1 {result.settings}"),
        paragraph("A child of m0 with the named effects; all parameters are fitted again."),
        table(["parameter", "estimate", "95 % interval", "unit"], rows, numeric=(1, 2)),
    )


def _compared(result: MysteryResult) -> str:
    names = [model.model for model in result.comparison.models]
    return section(
        "5. Compare again",
        _commands("cgwm compare m0 m1 capture"),
        paragraph(result.comparison.verdict, "verdict"),
        *error_ladder(result.comparison, names),
        _phases(result.comparison.models, names),
        paragraph(LADDER_WORDS, "soft"),
        _LINK,
    )


def _phases(models: Sequence[ModelComparison], names: Sequence[str]) -> str:
    """Return a table of the errors of short predictions by phase, in units of the noise, with a bar for each."""
    known = [
        (phase, [model.by_phase[phase] for model in models])
        for phase in models[0].by_phase
        if models[0].by_phase[phase] is not None
    ]
    rows, largest = [], 1.0
    for phase, figures in known:
        roots = [math.sqrt(f.reduced_chi2) if f is not None and f.reduced_chi2 else None for f in figures]
        largest = max([largest, *(root for root in roots if root)])
        rows.append((phase, figures[0].frames if figures[0] else 0, roots))

    def cell(root: float | None) -> str:
        if root is None:
            return "–"
        return f'{root:.2f} × noise<span class="bar" style="width:{100 * root / largest:.1f}%"></span>'

    cells = [[text(phase), str(frames), *map(cell, roots)] for phase, frames, roots in rows]
    return f'<div class="bars">{table(["phase", "frames", *names], cells, numeric=(1,))}</div>'


# The seal


def _hidden(result: MysteryResult) -> str:
    mark = "good" if result.outcome in _GOOD else "bad"
    pieces = [paragraph(result.sentence, f"verdict {mark}")]
    pieces += [_truth(effect) for effect in result.hidden]
    known = [compared for compared in result.parameters if compared.true_value is not None]
    if known:
        rows = [_with_truth(compared) for compared in known]
        header = ["parameter", "found", "95 % interval", "", "true", "unit", ""]
        pieces.append(table(header, rows, numeric=(1, 2, 4)))
    if result.outcome == "silent":
        pieces.append(
            paragraph(
                "An effect is not named if it moves the body by less than the possible error of the contact model."
            )
        )
    return section("What was hidden", f'<div class="told">{"".join(pieces)}</div>')


def _truth(effect: HiddenEffect) -> str:
    values = ", ".join(f"{name} = {_value(value)}" for name, value in effect.values.items())
    return f"<p><code>{text(effect.name)}</code>: {text(effect.form)}; {text(values)} (SI units).</p>"


def _value(value: float | list[float]) -> str:
    return f"({', '.join(map(number, value))})" if isinstance(value, list) else number(value)


def _with_truth(compared: ComparedParameter) -> list[str]:
    p = compared.parameter
    drawn = interval_svg(p.estimate, p.interval_95, compared.true_value) if p.interval_95 else ""
    word = {True: "in the interval", False: '<span class="bad">outside the interval</span>', None: ""}
    return [
        f"<code>{text(p.name)}</code>",
        number(p.estimate),
        _span(p.interval_95),
        drawn,
        number(compared.true_value),
        unit_text(p.unit),
        word[compared.covered],
    ]


def _files(result: MysteryResult) -> str:
    rows = [[text(kind), way_link(path, path)] for kind, path in result.paths.items()]
    times = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in result.seconds.items())
    return section(
        "Files, warnings and times",
        table(["what", "where"], rows),
        cautions([*result.warnings, *result.comparison.warnings]),
        paragraph(f"On {result.device}: {times}.", "soft"),
    )


def _span(interval: tuple[float, float] | None) -> str:
    return f"{number(interval[0])} to {number(interval[1])}" if interval else "–"


def _mm(value: float) -> str:
    return f"{fixed(value, 1, 1e3)} mm"

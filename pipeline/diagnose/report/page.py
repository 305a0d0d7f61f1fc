"""The page of a diagnosis: the verdict, the ranking, the missing force, what the effects do, and what to measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ....schemas import DiagnoseResult, EffectParameterEstimate, NextMotions, RankedEffect
from ...report.page import (
    cautions,
    command,
    facts,
    folded,
    link,
    listed,
    number,
    page,
    paragraph,
    section,
    table,
    text,
    unit_words,
)
from ...report.page_file import links_beside, made_of, page_beside
from ...report.plots import Bar, Plot, Series, bars, legend, plot_svg
from .pictures import DrawnMotion, EffectPicture, MissingForce, Pictures, binned_means
from .wording import organised

_MM = 1e3
BARS = 10
"""Number of effects in the chart; the table has all."""
_UNITS = {"time": "s", "x": "m", "y": "m", "height": "m", "heading": "deg", "speed": "m/s", "spin": "rad/s"}
_COLORS = ("m0", "m1", "m2")


def default_page(model: Path, split: str = "train") -> Path:
    """Return the page's path by default: beside the model, named after it."""
    return page_beside([model], "diagnose", *([split] if split != "train" else []))


def mark_of(place: Path, model: Path, capture: Path, split: str) -> str:
    """Return by what the page of a diagnosis is recognised, see `page_file.made_of`."""
    return made_of(place, "diagnose", [model, capture], split)


def diagnosis_html(
    result: DiagnoseResult, pictures: Pictures, place: Path, model: Path, capture: Path, split: str, then: str = ""
) -> str:
    """Return the HTML page of a diagnosis.

    Args:
        result: The diagnosis.
        pictures: What is drawn, see `pictures_of`.
        place: Where the page will be, from where its links lead.
        model: The model.
        capture: The capture.
        split: The episodes that were used.
        then: The command to type next.
    """
    body = [
        f"<h1>cgwm diagnose · {text(model)} · {text(capture)} · split {text(split)}</h1>",
        f'<p class="verdict">{text(result.sentence)}</p>',
        _cards(result),
        cautions(result.warnings),
        paragraph("Next:") + command(then) if then else "",
        _ranking(result),
        _missing(result, pictures),
        *(_effect(result, one) for one in pictures.effects),
        _tested(result),
        _next(result, pictures),
        _files(result, place, model, capture),
    ]
    title = f"cgwm diagnose: {model.name or model} on {capture.name or capture}"
    return page(title, [part for part in body if part], made_of=mark_of(place, model, capture, split))


def _cards(result: DiagnoseResult) -> str:
    cards = []
    before, after = result.flight_before, result.flight_after
    if before is not None:
        shown = after if result.selected and after is not None else before
        rows = [("without effects", number(before.statistic))] if result.selected else []
        cards.append(_card("misfit of flight, mean χ² (1: noise)", number(shown.statistic), rows))
    for entry in result.ranking:
        if entry.effect in result.selected and entry.cv_error_before_m and entry.cv_error_after_m is not None:
            rows = [("without it", f"{entry.cv_error_before_m * _MM:.2f} mm")]
            words = f"{entry.effect}: error in held-out episodes"
            cards.append(_card(words, f"{entry.cv_error_after_m * _MM:.2f} mm", rows))
    frames = " and ".join(f"{count} in {name}" for name, count in result.phases.items())
    noise = result.noise.get("position_m")
    rows = [("frames", frames)] + ([("noise of positions", f"{noise * _MM:.2g} mm")] if noise else [])
    return f'<div class="cards">{"".join([*cards, _card("episodes", str(result.episodes), rows)])}</div>'


def _card(name: str, value: str, rows: Sequence[tuple[str, str]]) -> str:
    small = "".join(f"<dt>{text(label)}</dt><dd>{text(words)}</dd>" for label, words in rows)
    return f'<div class="card"><div>{text(name)}</div><div class="value">{text(value)}</div><dl>{small}</dl></div>'


def _ranking(result: DiagnoseResult) -> str:
    """Return the chart of what decides, and the table of all candidates."""
    if not result.ranking:
        return ""
    flight = [one for one in result.ranking if one.delta_bic is not None]
    contact = [one for one in result.ranking if one.delta_bic is None and one.contact_score is not None]
    pieces = []
    for step, entries in enumerate(_by_step(flight, result)):
        words = (
            "In flight: how much better the data are described with the effect, as the fall of BIC (twice the rise of "
            "the log-likelihood, less a charge for each fitted number and for an implausible size). A difference of 10 "
            "between two effects is strong evidence for the longer bar."
        )
        if step:
            words = f"The same beside {listed(result.selected[:step])}, which the data were fitted with before:"
        pieces += [paragraph(words), _bars(entries, result, lambda one: -(one.delta_bic or 0.0))]
    if contact:
        pieces += _in_contact(contact, result)
    pieces.append(_all_candidates(result))
    pieces += [
        paragraph(f"{listed(group)} cannot be told apart in these data: each of them explains these data as well.")
        for group in result.aliases
    ]
    return section("Which effect explains the data", *pieces)


def _by_step(flight: Sequence[RankedEffect], result: DiagnoseResult) -> list[list[RankedEffect]]:
    """Return the candidates judged in flight by the step that judged them: bars of different steps do not compare.

    A further step shows the effect that it named and the equals of that one; of all others the ranking has the figures
    of the first step.
    """
    known = {one.effect for one in flight}
    later = []
    for name in [name for name in result.selected if name in known][1:]:
        later.append([one for one in flight if one.effect in result.equals_of(name)])
    first = [one for one in flight if not any(one in group for group in later)]
    return [group for group in (first, *later) if group]


def _in_contact(entries: Sequence[RankedEffect], result: DiagnoseResult) -> list[str]:
    if max(one.contact_score or 0.0 for one in entries) <= 0:
        named = ", ".join(one.effect for one in entries)
        return [paragraph(f"In contact, none of the candidates pays for its fitted numbers: {named}.")]
    words = (
        "In contact: the fall of the misfit, robust against single bad frames, less a charge for each fitted number. "
        "Without a bar: the effect does not pay for its numbers."
    )
    return [paragraph(words), _bars(entries, result, lambda one: one.contact_score or 0.0)]


def _all_candidates(result: DiagnoseResult) -> str:
    header = ["effect", "acts in", "judged in", "fall of BIC", "p", "held out [mm]", "estimate"]
    rows = [
        [
            text(one.effect),
            ", ".join(one.acts_in),
            one.judged_in,
            "–" if one.delta_bic is None else number(-one.delta_bic),
            f"{one.score_p:.2g}".replace("-", "−") if one.score_p > 0 else "&lt; 1e−300",
            _held_out(one),
            "<br>".join(_estimate(p) for p in one.parameters[:4]),
        ]
        for one in result.ranking
    ]
    strong = [k for k, one in enumerate(result.ranking) if one.effect in result.selected]
    return folded("All figures of all candidates", table(header, rows, (3, 4, 5), strong, sorts=True))


def _bars(entries: Sequence[RankedEffect], result: DiagnoseResult, figure: Callable[[RankedEffect], float]) -> str:
    ordered = sorted(entries, key=lambda one: -figure(one))[:BARS]
    equal = {name for group in result.aliases for name in group}
    return bars(
        [
            Bar(
                name=one.effect,
                value=figure(one),
                words=number(figure(one)),
                strong=one.effect in result.selected or one.effect in equal,
            )
            for one in ordered
        ]
    )


def _held_out(one: RankedEffect) -> str:
    if one.cv_error_before_m is None or one.cv_error_after_m is None:
        return "–"
    return f"{one.cv_error_before_m * _MM:.2f} → {one.cv_error_after_m * _MM:.2f}"


def _estimate(one: EffectParameterEstimate) -> str:
    return f"{text(one.name)} = {number(one.estimate)} ± {number(one.std_error, 2)}{unit_words(one.unit)}"


def _missing(result: DiagnoseResult, pictures: Pictures) -> str:
    """Return the section with the residual force and torque before and after."""
    missing = pictures.missing
    if missing is None:
        return ""
    axis = f"{missing.coordinate} [{_UNITS[missing.coordinate]}]" if missing.coordinate in _UNITS else "episode"
    what = "force over mass, and torque over inertia," if missing.torque else "force over mass"
    words = (
        f"The constant {what} that would have to be added in each short window of flight, with one standard error. The "
        "line joins the means of four groups of windows. "
        f"{organised('constant' if missing.same_everywhere else missing.coordinate)}"
    )
    pieces = [paragraph(words), _curves(missing, axis, "The model lacks")]
    if pictures.left is not None:
        named = listed(result.selected)
        pieces += [f"<h3>What is left with {text(named)}</h3>", _curves(pictures.left, axis, "left")]
    law = result.residual_law
    if law is not None and law.terms:
        terms = "; ".join(f"{number(t.coefficient)} {t.unit} · [{t.term}]" for t in law.terms)
        pieces.append(
            paragraph(
                f"A law found by regression for what is left: {terms}. u is the velocity and omega the spin. With it, "
                f"the mean χ² is {number(law.left_chi2)} (1: noise)."
            )
        )
    return section("The force that the model lacks", *pieces)


def _curves(found: MissingForce, axis: str, words: str) -> str:
    figures = []
    for kind, unit, curves in (("force / mass", "m/s²", found.force), ("torque / inertia", "rad/s²", found.torque)):
        for curve, color in zip(curves, _COLORS, strict=False):
            known = np.isfinite(curve.std) & (curve.std < 1e3)
            if not known.any():
                continue
            x, y, s = found.x[known], curve.values[known], curve.std[known]
            dots = Series(name=f"{kind} {curve.name}", points=_pairs(x, y), color=color, kind="dots", errors=s.tolist())
            line = Series(name="means", points=binned_means(x, y, s), color="ink", kind="binned")
            title = f"{kind} {curve.name} [{unit}]"
            drawn = plot_svg(Plot(title=title, x=axis, series=[dots, line], zero=True, height=260))
            figures.append(f"<figure>{drawn}</figure>")
    return f'<div class="plots" aria-label="{text(words)}">{"".join(figures)}</div>'


def _pairs(x: np.ndarray, y: np.ndarray) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in zip(x, y, strict=True)]


def _effect(result: DiagnoseResult, picture: EffectPicture) -> str:
    """Return the section that shows what a named effect does to a motion."""
    entry = next((one for one in result.ranking if one.effect.rpartition(":")[2] == picture.effect), None)
    entry = entry or next((one for one in result.ranking if one.effect == picture.effect), None)
    size = ", ".join(_estimate(p) for p in entry.parameters) if entry is not None else ""
    end = float(picture.apart_m[-1])
    words = (
        f"Both motions start as {picture.start}. After {picture.time_s[-1]:.2g} s they are {end * _MM:.3g} mm apart."
        if end < 1
        else f"Both motions start as {picture.start}. After {picture.time_s[-1]:.2g} s they are {end:.2g} m apart."
    )
    series = [
        Series(name=one.name, points=_pairs(*one.path.T), color=color, kind=kind)
        for one, color, kind in zip(picture.motions, ("m0", "frozen"), ("line", "dashed"), strict=True)
    ]
    side = Plot(title="from the side: height [m]", x="along the path [m]", series=series, equal=True)
    apart = Series(name="distance", points=_pairs(picture.time_s, picture.apart_m * _MM), color="m0")
    over = Plot(title="distance between the two [mm]", x="time [s]", series=[apart], zero=True, height=240)
    drawn = f"<figure>{plot_svg(side)}{legend(series)}</figure><figure>{plot_svg(over)}</figure>"
    return section(
        f"What {picture.effect} does",
        paragraph(words),
        f'<div class="plots">{drawn}</div>',
        f"<p>{size}</p>" if size else "",
    )


def _tested(result: DiagnoseResult) -> str:
    """Return the section on what was tested, and how small it could have been seen."""
    rows = []
    for one in result.ranking:
        if one.judged_in == "flight" and one.parameters:
            seen = "<br>".join(
                f"{text(p.name)}: {number(3 * p.std_error, 2)}{unit_words(p.unit)}" for p in one.parameters[:3]
            )
            rows.append([text(one.effect), "flight", seen])
    for limit in result.contact_limits:
        sizes = "<br>".join(
            f"{text(name)}: {number(size, 2)}{unit_words(limit.units[name])}" for name, size in limit.sizes.items()
        )
        rows.append([text(limit.effect), "contact", sizes or "hardly detectable in these motions"])
    rows += [[text(name), "not tested", text(why)] for name, why in result.not_tested.items()]
    words = (
        "An effect smaller than the size in the last column would not have been seen, and the verdict says nothing "
        "about it. In flight it is three standard errors of the estimate, in contact the size from which the test "
        "would have named it."
    )
    if not rows:
        return ""
    header = ["effect", "in", "smallest size"]
    return section("What was tested, and how small it could have been seen", paragraph(words), table(header, rows))


def _next(result: DiagnoseResult, pictures: Pictures) -> str:
    """Return the section on the next experiment, drawn as a throw, and on the motions to record next for contact."""
    pieces = [*_next_throw(result, pictures), *_next_motions(result, pictures)]
    return section("What to measure next", *pieces) if pieces else ""


def _next_throw(result: DiagnoseResult, pictures: Pictures) -> list[str]:
    found = result.next_experiment
    if found is None:
        return []
    apart = f"It tells {listed(found.separates)} apart." if found.separates and found.initial_state else ""
    pieces = [paragraph(f"{found.what[:1].upper()}{found.what[1:]}. {apart}")]
    pieces.append(drawn_throw(pictures.throw))
    rows = [[str(one["rank"]), text(one["what"]), number(float(one["expected_gain_nats"]))] for one in found.ranked[:5]]
    if rows:
        pieces.append(table(["", "throw", "expected rise of the log-likelihood ratio"], rows, (2,)))
    return pieces


def asked_motions(found: NextMotions, then: str) -> list[str]:
    """Return the motions to record next for contact as a list, after a sentence on what they are for."""
    why = (
        f"These motions tell {listed(found.separates)} apart."
        if found.separates
        else "These motions show effects of contact that the data so far could not."
    )
    items = "".join(f"<li>{text(motion.what)}</li>" for motion in found.motions)
    return [paragraph(f"{why} {then}"), f"<ol>{items}</ol>"]


def _next_motions(result: DiagnoseResult, pictures: Pictures) -> list[str]:
    found = result.next_motions
    if found is None:
        return []
    pieces = asked_motions(found, "Record them as new episodes of the same capture, and add them to the split.")
    if pictures.paths:
        pieces.append(_drawn(pictures.paths, "from above: y [m]", "x [m]", True))
    rows = [
        [
            text(one.effect),
            "hardly" if one.seen_from is None else text(f"{number(one.seen_from, 2)} {one.unit}".removesuffix(" 1")),
            text(f"{number(one.then_from, 2)} {one.unit}".removesuffix(" 1")),
        ]
        for one in found.reveals
    ]
    return [*pieces, table(["effect", "seen from, now", "with these motions"], rows)] if rows else pieces


def _drawn(motions: Sequence[DrawnMotion], title: str, axis: str, named: bool) -> str:
    """Return the plot of motions, with a legend where they are named."""
    series = [
        Series(name=one.name, points=_pairs(*one.path.T), color=color)
        for one, color in zip(motions, _COLORS, strict=False)
    ]
    drawn = plot_svg(Plot(title=title, x=axis, series=series, equal=True))
    return f'<div class="plots"><figure style="max-width:40rem">{drawn}{legend(series) if named else ""}</figure></div>'


def drawn_throw(throw: Sequence[DrawnMotion]) -> str:
    """Return the drawing of the next experiment; empty where none is proposed."""
    return _drawn(throw, "from the side: height [m]", "along the throw [m]", False) if throw else ""


def _files(result: DiagnoseResult, place: Path, model: Path, capture: Path) -> str:
    rows = links_beside(place, [model], capture)
    if result.saved_law is not None:
        law = Path(result.saved_law.rpartition(":")[0])
        rows.append(("law", link(str(law), law, place)))
    return section("Files", facts(rows))

"""The verdict of a comparison in words, including whether there are enough episodes for one."""

from __future__ import annotations

import math
from collections.abc import Mapping

from ...schemas import CompareResult, ModelComparison, PairedDifference, PhaseFigures, ShortDifference
from ..report.page import number
from .paired_difference import LEAST_EPISODES

EXPLAINED = 1.2
"""Largest error of short predictions, in units of the noise, that counts as explained by the model."""
LEAST_FRAMES = 10
"""Minimum number of frames of a phase that the verdict mentions."""


def comparison_verdict(result: CompareResult, names: Mapping[str, str]) -> str:
    """Return the verdict of a comparison in one to three sentences.

    Args:
        result: The figures.
        names: Short name of each model, by its name in the figures.
    """
    last = result.models[-1]
    subject = next(model for model in result.models if model.model == result.best)
    if len(result.models) == 1:
        sentences = [_alone(last, result, names)]
    else:
        # the best model against the first; if the first is the best, against the last
        other = result.models[0] if subject is not result.models[0] else last
        pair = _pair(result, subject.model, other.model)
        sentences = _compared(pair, subject, other, result, names) if pair else [_alone(subject, result, names)]
    if result.episodes < LEAST_EPISODES:
        sentences.append(
            f"{_episodes(result.episodes)} {'is' if result.episodes == 1 else 'are'} too few to decide whether a "
            "difference of open-loop errors is more than chance."
            if len(result.models) > 1
            else f"{_episodes(result.episodes)} {'is' if result.episodes == 1 else 'are'} few to judge a model by."
        )
    sentences.append(_short(subject, names))
    return " ".join(sentence for sentence in sentences if sentence)


def _pair(result: CompareResult, model: str, than: str) -> PairedDifference | None:
    """Return the paired difference of two models, with the sign reversed if it is stored in the other order."""
    for pair in result.pairs:
        if (pair.model, pair.than) == (model, than):
            return pair
        if (pair.model, pair.than) == (than, model):
            span = pair.interval_95_m
            return PairedDifference(
                model=model,
                than=than,
                episodes=pair.episodes,
                better=pair.episodes - pair.better,
                median_difference_m=-pair.median_difference_m,
                interval_95_m=None if span is None else (-span[1], -span[0]),
                short=None if pair.short is None else _reversed(pair.short),
            )
    return None


def _reversed(short: ShortDifference) -> ShortDifference:
    """Return the same difference with the models exchanged."""
    span = short.interval_95
    return short.model_copy(
        update={
            "reduced_chi2": short.than_reduced_chi2,
            "than_reduced_chi2": short.reduced_chi2,
            "interval_95": None if span is None else (-span[1], -span[0]),
        }
    )


def _compared(
    pair: PairedDifference,
    model: ModelComparison,
    other: ModelComparison,
    result: CompareResult,
    names: Mapping[str, str],
) -> list[str]:
    """Return how two models differ in short predictions and over whole episodes."""
    short, whole = _in_short(pair, model, other, names), _versus(pair, model, other, result, names)
    if short and _disagree(pair):
        whole = f"Over whole episodes it is the other way round: {whole}"
    return [short, whole]


def _disagree(pair: PairedDifference) -> bool:
    """Return whether one model is better in short predictions and the other over whole episodes, both beyond chance."""
    spans = (pair.short.interval_95 if pair.short is not None else None), pair.interval_95_m
    signs = [0 if span is None or span[0] <= 0 <= span[1] else math.copysign(1, span[0]) for span in spans]
    return signs[0] * signs[1] < 0


def _in_short(pair: PairedDifference, model: ModelComparison, other: ModelComparison, names: Mapping[str, str]) -> str:
    """Return how two models differ in short predictions, and in which phase most; empty where nothing is known."""
    short = pair.short
    if short is None:
        return ""
    change = short.reduced_chi2 - short.than_reduced_chi2
    good, bad = (model, other) if change < 0 else (other, model)
    a, b = names[good.model], names[bad.model]
    least, most = sorted((short.reduced_chi2, short.than_reduced_chi2))
    figures = (
        f"over {short.frames} frames, the mean square error of {a} is {number(least)} times that of the noise, that of "
        f"{b} {number(most)}"
    )
    if short.interval_95 is None:
        return f"In short predictions, {figures}."
    low, high = sorted(abs(value) for value in short.interval_95)
    if short.interval_95[0] <= 0 <= short.interval_95[1]:
        return f"In short predictions the two cannot be told apart: {figures}."
    figures += f" (95 % interval of the difference: {number(low, 2)} to {number(high, 2)})"
    gains = {
        phase: (mine.reduced_chi2 - theirs.reduced_chi2) * mine.frames
        for phase, mine in good.by_phase.items()
        if mine is not None
        and (theirs := bad.by_phase.get(phase)) is not None
        and mine.reduced_chi2 is not None
        and theirs.reduced_chi2 is not None
    }
    where = f", most of all {_during(min(gains, key=lambda one: gains[one]))}" if gains else ""
    return f"{a} is better than {b} in short predictions{where}: {figures}."


def _alone(model: ModelComparison, result: CompareResult, names: Mapping[str, str]) -> str:
    median = model.translation_error_m.median
    words = (
        f"{names[model.model]} predicts {_episodes(result.episodes, result.split)} with a median error of {_mm(median)}"
    )
    zeros = [(name, _zero(model, name)) for name in ("frozen", "ballistic")]
    known = [(name, value) for name, value in zeros if value is not None]
    if not known:
        return words + "."
    name, nearest = min(known, key=lambda pair: pair[1])
    guess = "a body at rest" if name == "frozen" else "free flight"
    if nearest <= median:
        return f"{words}, no better than assuming {guess} ({_mm(nearest)})."
    return f"{words}; assuming {guess} gives {_mm(nearest)}."


def _zero(model: ModelComparison, name: str) -> float | None:
    return ((model.baselines.get(name) or {}).get("translation_error_m") or {}).get("median")


def _versus(
    pair: PairedDifference,
    model: ModelComparison,
    other: ModelComparison,
    result: CompareResult,
    names: Mapping[str, str],
) -> str:
    a, b = names[model.model], names[other.model]
    first, second = model.translation_error_m.median, other.translation_error_m.median
    counted = f"{pair.better} of {_episodes(pair.episodes, result.split)}"
    words = f"{a} predicts {counted} better than {b} (median {_mm(first)} instead of {_mm(second)})"
    if pair.interval_95_m is None:
        return words + "."
    if pair.interval_95_m[0] <= 0 <= pair.interval_95_m[1]:
        return words + ", which may be chance: the 95 % interval of the difference contains zero."
    return words + "."


def _short(model: ModelComparison, names: Mapping[str, str]) -> str:
    """Return the phase in which short predictions miss most beyond the noise, and by how much, as a sentence."""
    if model.reduced_chi2 is None:
        return "Short predictions are not judged: too few consecutive frames allow one."
    known = [
        (phase, figures.reduced_chi2**0.5, figures.position_rms_m, figures)
        for phase, figures in model.by_phase.items()
        if figures is not None and figures.reduced_chi2 is not None and figures.frames >= LEAST_FRAMES
    ]
    missed = sorted((item for item in known if item[1] > EXPLAINED), key=lambda item: -_excess(item[3]))
    name = names[model.model]
    if not missed:
        return f"Short predictions of {name} are within the noise in all phases."
    phase, times, size, _ = missed[0]
    within = [other for other, multiple, *_ in known if multiple <= EXPLAINED]
    words = f"Short predictions of {name} still have errors of {times:.1f} times the noise {_during(phase)}"
    words += f" ({_mm(size)})" if size is not None else ""
    return words + (f"; they are within the noise {' and '.join(map(_during, within))}." if within else ".")


def _excess(figures: PhaseFigures | None) -> float:
    """Return the sum of squares of a phase beyond the noise: a misfit of many frames counts more than one of few."""
    return 0.0 if figures is None else figures.frames * ((figures.reduced_chi2 or 1.0) - 1.0)


def _during(phase: str) -> str:
    return {"impact": "in impacts"}.get(phase, f"in {phase}")


def _episodes(count: int, split: str = "") -> str:
    return f"{count}{' ' + split if split else ''} episode{'' if count == 1 else 's'}"


def _mm(value: float) -> str:
    return f"{value * 1e3:.1f} mm" if value < 0.1 else f"{value * 1e3:.0f} mm"

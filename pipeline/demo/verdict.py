"""The verdict of a demo: its figures, their targets, and a summary in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...schemas import DemoTarget, ErrorSummary, EvalResult

TRANSLATION_TARGET_M = 0.015
ROTATION_TARGET_DEG = 15.0
PSNR_TARGET_DB = 20.0
FAR_BETTER = 2.0
"""Minimum ratio of the errors of both baselines to that of the model; below it the verdict says so."""


def targets_of(evaluation: EvalResult) -> tuple[DemoTarget, ...]:
    """Return the figures of the verdict: open-loop medians over the episodes, of the model and of the baselines."""
    return (
        _target(evaluation, "translation error", "translation_error_m", "m", TRANSLATION_TARGET_M, below=True),
        _target(evaluation, "rotation error", "rotation_error_deg", "deg", ROTATION_TARGET_DEG, below=True),
        _target(evaluation, "PSNR within the object", "psnr_object_db", "dB", PSNR_TARGET_DB, below=False),
    )


def shown(target: DemoTarget, value: float | None) -> str:
    """Write a value of a target with its unit, lengths in millimetres.

    >>> shown(DemoTarget(name="a", unit="m", value=0.1, target=0.015, better="below", met=False), 0.0123)
    '12.3 mm'
    """
    if value is None or not math.isfinite(value):
        return "–"
    scale, unit = (1e3, "mm") if target.unit == "m" else (1.0, target.unit)
    scaled = value * scale
    return f"{scaled:.0f} {unit}" if abs(scaled) >= 100 or target.target == value else f"{scaled:.1f} {unit}"


def verdict_text(evaluation: EvalResult, targets: Sequence[DemoTarget], warmup_s: float) -> str:
    """Return the verdict in words."""
    move, turn, image = targets
    errors = f"errors of {shown(move, move.value)}"
    if turn.value is not None:
        errors += f" and {shown(turn, turn.value)}"
    seen = f"Having seen {warmup_s:g} s of {_episodes(evaluation)}, the model predicts the rest of the motion"
    sentences = [f"{seen} with {errors} (medians)."]
    if image.value is not None:
        sentences.append(f"Rendered, the object agrees with the recorded frames to {shown(image, image.value)} PSNR.")
    missed = [target for target in targets if not target.met]
    if missed:
        sentences.append(f"Target missed: {'; '.join(_missed(target) for target in missed)}.")
    else:
        sentences.append(f"All targets are met ({', '.join(shown(target, target.target) for target in targets)}).")
    return " ".join(sentence for sentence in [*sentences, _against_baselines(move)] if sentence)


def _episodes(evaluation: EvalResult) -> str:
    if evaluation.episodes == 1:
        return "a test episode"
    return f"each of {evaluation.episodes} test episodes"


def _missed(target: DemoTarget) -> str:
    wanted = "below" if target.better == "below" else "at least"
    return f"{target.name} {shown(target, target.value)} (target: {wanted} {shown(target, target.target)})"


def _against_baselines(move: DemoTarget) -> str:
    others = [(name, value) for name, value in (("frozen", move.frozen), ("ballistic", move.ballistic)) if value]
    if not others or move.value is None:
        return ""
    name, nearest = min(others, key=lambda pair: pair[1])
    what = "does not move" if name == "frozen" else "flies on without contact"
    if nearest < FAR_BETTER * move.value:
        return f"This is hardly better than assuming that the object {what}, with an error of {shown(move, nearest)}."
    return f"Assuming that the object {what} gives an error of {shown(move, nearest)}."


def _target(evaluation: EvalResult, name: str, key: str, unit: str, target: float, below: bool) -> DemoTarget:
    summary: ErrorSummary | None = getattr(evaluation, key)
    value = None if summary is None else summary.median
    met = value is not None and (value < target if below else value >= target)
    frozen, ballistic = (_baseline(evaluation, which, key) for which in ("frozen", "ballistic"))
    return DemoTarget(
        name=name,
        unit=unit,
        value=value,
        target=target,
        better="below" if below else "above",
        met=met,
        frozen=frozen,
        ballistic=ballistic,
    )


def _baseline(evaluation: EvalResult, name: str, key: str) -> float | None:
    value = (evaluation.baselines.get(name, {}).get(key) or {}).get("median")
    return None if value is None or not math.isfinite(value) else float(value)

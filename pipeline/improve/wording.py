"""Sentences of a ladder: its outcome, why it ended, and the cautions."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ...schemas import DiagnoseResult, ErrorRatio, ImproveStep, ImproveTest, ImproveTrial, Remaining
from ..compare.paired_difference import LEAST_EPISODES
from ..diagnose.report.wording import organised
from ..physics.effects.registry import split_units
from ..report.page import listed, number
from .ladder import LEAST_FALL, Ladder

WHY = {
    "selected": "named by the diagnosis",
    "one_left_out": "those above, without one of them",
    "one_of_the_selected": "one of those that the diagnosis names",
    "first_of_the_ranking": "not named, but first of the ranking",
    "law": "law of the residual, found by regression",
}
"""In words, where a proposal comes from."""
_ALL = 0.999
"""Shares above it are not told from all."""
_WHOLE_FLIGHT_S = 0.9
"""Errors that change more slowly bend a whole flight."""
_GRAVITY_M_S2 = 9.81
AXES = 3**0.5
"""A distance over it is the error along each axis, as which noise is given."""


def sentence(ladder: Ladder, test: ImproveTest | None) -> str:
    """Return the outcome of a ladder in one to three sentences."""
    added = [", ".join(step.added) for step in ladder.steps if step.added]
    if not added:
        words = [f"Nothing was added to {ladder.models[0]}."]
    else:
        count = len(added)
        words = [f"Added in {count} step{'' if count == 1 else 's'}: {'; then '.join(added)}."]
    if test is not None and test.steps:
        overall = test.steps[-1]
        decided = _decided(ladder)
        for ratio, name, scale, unit in (
            (overall.flight if "flight" in decided else None, "prediction error in flight", 1.0, "times the noise"),
            (overall.contact if "contact" in decided else None, "prediction error in contact", 1.0, "times the noise"),
            (overall.translation_error_m, "open-loop error of whole episodes", 1e3, "mm"),
        ):
            if ratio is not None:
                words.append(
                    f"On test episodes the {name} goes from {number(ratio.before * scale)} to "
                    f"{number(ratio.after * scale)} {unit} (medians; {ratio_words(ratio)})."
                )
    worse = [] if test is None else worse_words(test)[-1:]
    return " ".join([*words, *worse, why_ended(ladder)])


def _decided(ladder: Ladder) -> set[str]:
    """Return in which of flight and contact the additions of a ladder predict unseen episodes better."""
    trials = [t for step in ladder.steps for t in step.tried if t.helps and t.effects == step.added]
    kinds = [(kind, one) for t in trials for kind, one in (("flight", t.flight), ("contact", t.contact))]
    return {kind for kind, one in kinds if one is not None and one.interval_95 and one.interval_95[1] < 1}


def ratio_words(ratio: ErrorRatio) -> str:
    """Return a ratio of errors with its interval in words."""
    span = ratio.interval_95
    words = f"ratio {ratio.ratio:.2f}"
    if span is not None:
        words += f", 95 % {span[0]:.2f} to {span[1]:.2f}"
    return f"{words}, smaller in {ratio.better} of {ratio.episodes}"


def why_ended(ladder: Ladder) -> str:
    """Return why a ladder ends."""
    if ladder.stopped == "steps":
        return "The ladder ends at its largest number of steps; --steps allows more."
    if ladder.stopped == "not_diagnosed":
        return f"The last model could not be diagnosed: {ladder.refusal}"
    other = "else " if any(step.added for step in ladder.steps) else ""
    if ladder.stopped == "nothing_helps":
        return f"Nothing {other}that the diagnosis proposes predicts unseen episodes better."
    return f"The diagnosis proposes nothing {other}".rstrip() + "."


def trial_words(trial: ImproveTrial) -> str:
    """Return the outcome of a trial in a few words."""
    if trial.failure:
        return "the fit failed"
    if trial.helps:
        return "helps"
    spans = [one.interval_95 for one in (trial.flight, trial.contact) if one is not None and one.interval_95]
    if not spans:
        return "too few episodes to tell"
    if any(low > 1 + LEAST_FALL for low, _ in spans):
        return "makes predictions worse"
    return "may be chance" if all(high >= 1 for _, high in spans) else f"less than {LEAST_FALL:.0%}"


def warnings_of(ladder: Ladder, test: ImproveTest | None, folds: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the cautions about a ladder."""
    count, found = sum(map(len, folds)), []
    if count < LEAST_EPISODES:
        found.append(
            f"{count} episodes decide: intervals are Student's t over so few, and only large improvements are accepted."
        )
    if test is None:
        found.append("there is no split 'test' beside these episodes: no error here is of episodes without influence.")
    else:
        found += worse_words(test)
    if test is not None and test.episodes < LEAST_EPISODES:
        found.append(f"the split 'test' has {test.episodes} episodes: few to judge a model by.")
    found += [
        f"{', '.join(trial.effects)} was added although the diagnosis does not name it: it describes the motion, and "
        "need not be the cause."
        for step in ladder.steps
        for trial in step.tried
        if trial.effects == step.added and trial.why in ("first_of_the_ranking", "law")
    ]
    failed = [t for step in ladder.steps for t in step.tried if t.failure]
    found += [f"{', '.join(t.effects)} could not be fitted: {t.failure}" for t in failed]
    found += [text for step in ladder.steps[:1] for text in step.warnings]
    return tuple(dict.fromkeys(found))


def worse_words(test: ImproveTest) -> list[str]:
    """Return which models predict the test episodes worse than the one before, beyond chance; empty for none."""
    found = []
    for step in test.steps:
        ratios = {
            "prediction error in flight": step.flight,
            "prediction error in contact": step.contact,
            "open-loop error": step.translation_error_m,
        }
        worse = [
            f"the {name} is {ratio.ratio:.2g} times as large (95 % {ratio.interval_95[0]:.2g} to "
            f"{ratio.interval_95[1]:.2g})"
            for name, ratio in ratios.items()
            if ratio is not None and ratio.interval_95 is not None and ratio.interval_95[0] > 1 + LEAST_FALL
        ]
        if worse:
            found.append(
                f"{step.model} predicts the test episodes worse than {step.than}, beyond chance: {listed(worse)}. What "
                "was added helps in the episodes that it was chosen by, and not in others: use "
                f"{step.than}, or record more motions."
            )
    return found


def not_added_words(step: ImproveStep) -> list[str]:
    """Return what a diagnosis names and was tried, and was not added; empty for nothing."""
    left = [name for name in step.selected if name not in step.added]
    if not left or not step.tried:
        return []
    named, was = listed(left), "was" if len(left) == 1 else "were"
    if step.added:
        return [f"{named} {was} named and not added: the others predict unseen episodes as well."]
    return [f"{named} {was} tried and not added: unseen episodes are not predicted better, beyond chance."]


def share_words(step: DiagnoseResult) -> list[str]:
    """Return how much of what repeats in flight the named effects explain; empty where they do not act there."""
    found = step.remaining
    named = [e.effect for e in step.ranking if e.effect in step.selected and e.judged_in == "flight"]
    if found is None or not named:
        return []
    share = found.share_explained
    percent = f"{100 * share:.1f}" if share < _ALL else f"more than {100 * _ALL:g}"
    verb = "explains" if len(named) == 1 else "explain"
    return [f"Of the force that repeats from episode to episode in flight, {listed(named)} {verb} {percent} %."]


def remaining_words(step: DiagnoseResult) -> list[str]:
    """Return in sentences what is left beside the effects that a diagnosis names.

    How large it is and in which phase, how fast it changes, whether it is common to all episodes, and what it follows.
    """
    words, found = [], step.remaining
    # values of each episode are no part of what the rest is measured against
    common = [name for name in step.selected if split_units(name)[1] is None]
    beside = f", with {listed(common)} added," if common else ""
    if found is None:
        words.append("Nothing was measured in flight, so that nothing can be said of it.")
    else:
        turned = found.rotation_rms_rad
        rotation = "" if turned is None else f" and rotations by {math.degrees(turned):.2g} degrees"
        noise = step.noise.get("position_m")
        scatter = "" if noise is None else f", where the noise from frame to frame is {1e3 * noise:.2g} mm"
        words.append(
            f"In flight{beside} positions differ from the model by {1e3 * found.position_rms_m / AXES:.2g} mm along "
            f"each axis{rotation}, root mean square over whole flights with the start of each fitted{scatter}."
        )
        words += [_slow(found), *_own(found), _common(found)]
    if step.contact_chi2 is not None:
        words.append(
            f"In contact, what short segments leave has a mean chi2 of {step.contact_chi2:.3g} (1: noise alone); "
            "what no rigid contact can do counts in it."
        )
    return words


def _slow(found: Remaining) -> str:
    if not found.slow_position_std_m or found.slow_time_s is None:
        return "No slow errors show: what is left changes from frame to frame, as noise does."
    time = "over a whole flight" if found.slow_time_s > _WHOLE_FLIGHT_S else f"within {1e3 * found.slow_time_s:.0f} ms"
    return (
        f"A part of it is slow: errors of {1e3 * found.slow_position_std_m:.2g} mm change {time}, and differ from "
        "episode to episode, as errors of the tracking do."
    )


def _own(found: Remaining) -> list[str]:
    own = found.own_acceleration_std_m_s2
    if not own:
        return []
    return [
        f"Each flight has an acceleration of its own across gravity, {own:.2g} m/s2 in standard deviation, as if "
        f"gravity leaned by {1e3 * own / _GRAVITY_M_S2:.2g} mrad."
    ]


def _common(found: Remaining) -> str:
    if found.repeats and found.coordinate is not None:
        return f"A part is common to all episodes. {organised(found.coordinate)}"
    return "Nothing of it is common to all episodes: no law predicts held-out episodes better than by chance."

"""Sentences of a ladder: its outcome, why it ended, and the cautions."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas import ErrorRatio, ImproveTest, ImproveTrial
from ..compare.paired_difference import LEAST_EPISODES
from .ladder import LEAST_FALL, Ladder

WHY = {
    "selected": "named by the diagnosis",
    "one_of_the_selected": "one of those that the diagnosis names",
    "first_of_the_ranking": "not named, but first of the ranking",
    "law": "law of the residual, found by regression",
}
"""In words, where a proposal comes from."""


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
        for ratio, name, scale, unit in (
            (overall.flight, "prediction error in flight", 1.0, "times the noise"),
            (overall.translation_error_m, "open-loop error of whole episodes", 1e3, "mm"),
        ):
            if ratio is not None:
                words.append(
                    f"Test episodes, {name}: {ratio.before * scale:.3g} before, {ratio.after * scale:.3g} "
                    f"{unit} after (medians; {ratio_words(ratio)})."
                )
    return " ".join([*words, why_ended(ladder)])


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
    if ladder.stopped == "nothing_helps":
        return "Nothing else that the diagnosis proposes predicts unseen episodes better."
    return "The diagnosis proposes nothing else."


def trial_words(trial: ImproveTrial) -> str:
    """Return the outcome of a trial in a few words."""
    if trial.failure:
        return "the fit failed"
    if trial.helps:
        return "helps"
    spans = [one.interval_95 for one in (trial.flight, trial.contact) if one is not None and one.interval_95]
    if not spans:
        return "too few episodes to tell"
    if any(low > 1 for low, _ in spans):
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
    elif test.episodes < LEAST_EPISODES:
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

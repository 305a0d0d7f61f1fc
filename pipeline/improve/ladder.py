"""The ladder of models: diagnose, try what is proposed on unseen episodes, add what helps, and fit the next model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode
from ...datasets.io.progress import note
from ...datasets.models.effect_files import effect_file
from ...datasets.models.model import Model, read_model
from ...schemas import (
    DiagnoseResult,
    ErrorRatio,
    FittedParameter,
    ImproveConfig,
    ImproveStep,
    ImproveTrial,
    InputDataError,
    NotConvergedError,
    PhysConfig,
    UsageError,
    read_json,
)
from ..diagnose.next_experiment.experiments import Experiment
from ..diagnose.stage import prepared_world, report
from ..fit import fit
from ..physics.effects.registry import effect_of
from ..physics.effects.trust import trust_effects
from ..runtime.resources import one_torch_thread
from ..segments.candidates import Candidate
from ..segments.prepare import Prepared
from .folds import fitted_without
from .held_out_errors import HeldOutErrors, error_ratio, prepared_episodes, typical_errors
from .ladder_files import LadderFiles
from .proposals import Proposal, proposals_of

LEAST_FALL = 0.02
"""Smallest fall of the error for an addition: parameters that are fitted to each unseen episode, like its state, take
away about one per cent of any error."""

Stopped = Literal["nothing_helps", "nothing_proposed", "steps", "not_diagnosed"]


@dataclass(frozen=True)
class Ladder:
    """A ladder that has ended."""

    steps: tuple[ImproveStep, ...]
    """The diagnosis of each model, and what was done about it."""
    models: tuple[str, ...]
    """Folders of the models."""
    stopped: Stopped
    """Why it ended."""
    refusal: str = ""
    """Why the last model could not be diagnosed."""


@dataclass(kw_only=True)
class Climb:
    """What all steps of a ladder share."""

    capture: Capture
    """The capture, restricted to the split."""
    split: str
    """Name of the split on which everything is decided."""
    files: LadderFiles
    """Where models and decisions are kept."""
    folds: tuple[tuple[str, ...], ...]
    """Episodes of each part of the cross-validation."""
    config: ImproveConfig
    """Numbers of steps and folds."""
    physics: PhysConfig
    """Settings of each fit."""
    library: Sequence[Candidate]
    """Candidates of the diagnosis."""
    throws: Sequence[Experiment]
    """Experiments to choose the next one from."""
    accept_units: bool
    """Whether the capture's units are right although its motion contradicts them."""
    prepared: dict[int, tuple[list[Episode], Prepared]] = field(default_factory=dict)
    """Segments of each fold, cut once for all models."""

    def run(self) -> Ladder:
        """Climb from the model `m0` until nothing helps, and return the ladder.

        Raises:
            InputDataError: If the first model cannot be diagnosed.
        """
        steps: list[ImproveStep] = []
        models, base = ["m0"], "m0"
        while True:
            number, name = len(steps), models[-1]
            note(f"improve: diagnose {name}")
            try:
                found = self.files.document(
                    f"diagnosis-{number}.json", DiagnoseResult, lambda name=name: self._diagnosis(name)
                )
            except InputDataError as error:
                if not steps:
                    raise
                return Ladder(tuple(steps), tuple(models), "not_diagnosed", error.found)
            step = ImproveStep(**found.model_dump(), model=name)
            if number == self.config.steps:
                return Ladder((*steps, step), tuple(models), "steps")
            tried, best = self._tried(number, base, found)
            if best is None:
                ended = "nothing_helps" if tried else "nothing_proposed"
                return Ladder((*steps, step.model_copy(update={"tried": tried})), tuple(models), ended)
            base, proposal = best
            added = self._next_model(number, name, proposal)
            update = {
                "tried": tried,
                "added": proposal.names,
                "next_model": added.root.name if added.root else None,
                "next_parameters": _parameters_of(added, proposal),
            }
            steps.append(step.model_copy(update=update))
            models.append(f"m{number + 1}")

    @one_torch_thread()
    def _diagnosis(self, name: str) -> DiagnoseResult:
        device, model = self.physics.device, read_model(self.files / name)
        world, prepared = prepared_world(model, self.capture, self.split, device, self.accept_units)
        return report(prepared, world, self.library, self.throws)

    def _tried(
        self, number: int, base: str, found: DiagnoseResult
    ) -> tuple[tuple[ImproveTrial, ...], tuple[str, Proposal] | None]:
        """Try the proposals of a diagnosis group by group, until an addition of one helps.

        Args:
            number: Number of the step.
            base: Name of the models that are fitted without a fold each, at this step.
            found: The diagnosis.

        Returns:
            All trials, and the best addition with the name of its models without a fold; None if none helps.
        """
        present = tuple(effect.name for effect in read_model(self.files / f"m{number}").file.effects)
        groups = proposals_of(found, present, self.files / f"law_{number}.py")
        tried: list[ImproveTrial] = []
        for group in groups:
            helping: list[tuple[str, ImproveTrial, Proposal]] = []
            for proposal in group:
                name = f"m{number}-{len(tried)}"
                trial = self._trial(base, name, proposal)
                tried.append(trial)
                if trial.helps:
                    helping.append((name, trial, proposal))
            if helping:
                best = self._needed(number, base, self._preferred(helping), tried)
                return tuple(tried), best
        return tuple(tried), None

    def _preferred(self, helping: Sequence[tuple[str, ImproveTrial, Proposal]]) -> tuple[str, Proposal]:
        """Return what is added of several additions that help, with the name of its models without a fold.

        An effect with a cause comes before the law of the residual, which describes the motion alone, unless the law
        predicts the same unseen episodes better, beyond chance.
        """
        causes = [one for one in helping if one[2].why != "law"] or list(helping)
        name, _, proposal = min(causes, key=lambda one: _least_ratio(one[1]))
        for law, _, described in helping:
            if described.why == "law" and proposal.why != "law" and helps(*self._ratios(name, law)):
                return law, described
        return name, proposal

    def _needed(
        self, number: int, base: str, best: tuple[str, Proposal], tried: list[ImproveTrial]
    ) -> tuple[str, Proposal]:
        """Return an addition without the effects that it does without: left out, no error rises by `LEAST_FALL`.

        Args:
            number: Number of the step.
            base: See :meth:`_tried`.
            best: The addition, with the name of its models without a fold.
            tried: Trials of the step; what is tried here is appended.
        """
        name, proposal = best
        for effect in reversed(proposal.effects):
            if len(proposal.effects) == 1:
                break
            fewer = Proposal(tuple(e for e in proposal.effects if e != effect), "one_left_out")
            other = f"m{number}-{len(tried)}"
            tried.append(self._trial(base, other, fewer))
            ratios = self._ratios(name, other)
            if tried[-1].helps and all(one.ratio < 1 + LEAST_FALL for one in ratios if one is not None):
                name, proposal = other, fewer
        return name, proposal

    def _ratios(self, before: str, after: str) -> tuple[ErrorRatio | None, ErrorRatio | None]:
        """Return the ratios of the errors in flight and in contact of two additions that were tried."""
        first, second = (read_json(self.files / f"errors-{one}.json", HeldOutErrors) for one in (before, after))
        return error_ratio(first.flight, second.flight), error_ratio(first.contact, second.contact)

    def _trial(self, base: str, name: str, proposal: Proposal) -> ImproveTrial:
        """Add effects to the models without a fold, and compare the errors on the folds."""
        note(f"improve: try {', '.join(proposal.names)} on unseen episodes")
        # models that an interrupted run has fitted with them are read, not fitted again
        trust_effects(found[0] for effect in proposal.effects if (found := effect_file(effect)) is not None)
        before = self._fold_errors(base, "m0", ())
        after = self._fold_errors(name, base, proposal.effects)
        failure = before.failure or after.failure
        flight = None if failure else error_ratio(before.flight, after.flight)
        contact = None if failure else error_ratio(before.contact, after.contact)
        return ImproveTrial(
            effects=proposal.names,
            why=proposal.why,
            flight=flight,
            contact=contact,
            helps=helps(flight, contact),
            failure=failure,
        )

    def _fold_errors(self, name: str, base: str, effects: Sequence[str]) -> HeldOutErrors:
        """Return the errors of models that are each fitted without a fold, from those without it at the step before."""
        return self.files.document(f"errors-{name}.json", HeldOutErrors, lambda: self._measured(name, base, effects))

    def _measured(self, name: str, base: str, effects: Sequence[str]) -> HeldOutErrors:
        errors = HeldOutErrors(flight={}, contact={})
        config = self.physics.model_copy(update={"effects": tuple(effects)})
        for number, fold in enumerate(self.folds):
            # the first models without a fold start from the first model, all others from the ones before them
            start = self.files / ("m0" if name == base else f"folds/{base}-{number}")
            try:
                model = fitted_without(
                    fold, read_model(start), self.capture, self.split, config, self.files / f"folds/{name}-{number}"
                )
                if number not in self.prepared:
                    self.prepared[number] = prepared_episodes(
                        read_model(self.files / f"folds/m0-{number}"), self.capture, fold
                    )
                errors = errors.joined(typical_errors(model, self.capture, *self.prepared[number]))
            except (NotConvergedError, InputDataError, UsageError) as error:
                return HeldOutErrors(flight={}, contact={}, failure=error.found)
        return errors

    def _next_model(self, number: int, name: str, proposal: Proposal) -> Model:
        """Fit the next model of the ladder to the whole split."""
        out = self.files / f"m{number + 1}"
        note(f"improve: fit {out.name} with {', '.join(proposal.names)}")
        config = self.physics.model_copy(update={"effects": proposal.effects})
        root: Path = self.capture.root
        fit(
            root, out, "phys-geo", self.files / name, self.split, None, config, resume=True,
            accept_units=self.accept_units,
        )  # fmt: skip
        return read_model(out)


def helps(flight: ErrorRatio | None, contact: ErrorRatio | None) -> bool:
    """Return whether an error falls beyond chance and by `LEAST_FALL`, in flight or in contact, and neither rises.

    A rise by less than `LEAST_FALL` is none: its interval reaches below it.
    """
    spans = [(one.ratio, one.interval_95) for one in (flight, contact) if one is not None]
    if any(span is not None and span[0] > 1 + LEAST_FALL for _, span in spans):
        return False
    return any(span is not None and span[1] < 1 and ratio <= 1 - LEAST_FALL for ratio, span in spans)


def _least_ratio(trial: ImproveTrial) -> float:
    return min(one.ratio for one in (trial.flight, trial.contact) if one is not None)


def _parameters_of(model: Model, proposal: Proposal) -> tuple[FittedParameter, ...]:
    """Return the parameters of added effects in a model."""
    names = {effect_of(e).name for e in model.file.effects if e.name.rpartition("/")[2] in proposal.names}
    return tuple(p for p in model.file.parameters if p.name.partition(".")[0] in names)

"""The stage compare (`cgwm compare`): where and when each model fails, on the same episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ...datasets.capture.capture import Capture
from ...datasets.capture.tracks import Episode
from ...datasets.io.atomic import new_file, sha256
from ...datasets.io.outputs import reads, refuse_output
from ...datasets.io.progress import note, progress
from ...datasets.models.fit_inputs import changed_since_fit
from ...datasets.models.model import Model, read_model
from ...schemas import CompareResult, InputDataError, PairedDifference, UsageError
from ...schemas.regular_files import real_path
from ..evaluate.evaluation import Evaluation
from ..evaluate.prediction import STATE_FIT_EPISODES
from ..evaluate.stage import check_bodies, evaluate_model
from ..evaluate.work import LESS, evaluation_parts
from ..physics.model_world import world_of_model
from ..physics.rollout_cost import durations, segment_part
from ..physics.state import State
from ..report.page_file import links_beside, short_names, shows_the_same
from ..runtime.device import resolve_device
from ..runtime.resources import one_torch_thread
from ..runtime.work_budget import motion_doubt, within_budget
from ..segments.prepare import Prepared, prepare
from ..segments.random_effects import with_fitted_groups
from ..segments.release_detection import after_release
from ..trajectories.frame_times import episodes_at_clock
from .frames import footage_of
from .model_comparison import ComparedModel
from .page import comparison_html, mark_of
from .paired_difference import paired_difference, short_difference
from .residual_wrenches import wrench_points
from .short_horizon_errors import beside_others, contact_fit, short_errors
from .verdict import comparison_verdict

REPORT_HTML = "compare.html"


@dataclass(frozen=True, eq=False)
class Comparison:
    """The figures of a comparison and the models and predictions that they come from."""

    result: CompareResult
    """The figures that `cgwm compare` prints."""
    models: tuple[ComparedModel, ...]
    """The compared models, in the order given."""


@reads("models", "capture")
def compare(
    models: Sequence[Path],
    capture: Path,
    split: str = "test",
    out: Path | None = None,
    warmup_s: float = 0.1,
    device: str = "auto",
    overwrite: bool = False,
    accept_units: bool = False,
) -> CompareResult:
    """Compare models on disk on the episodes of a capture, and write the page.

    Args:
        models: MODEL directories with fitted physics, the base first.
        capture: CAPTURE with tracks.
        split: Split whose episodes are compared.
        out: The page to write; None writes none.
        warmup_s: Length of the start of an episode that the models may see [s].
        device: Device that renders images: auto, cpu or cuda.
        overwrite: Replace what is at `out`; a page of the same models, capture and split is replaced in any case.
        accept_units: Do not refuse units and frames of the capture that its motion contradicts.

    Raises:
        UsageError: If a model is given twice, there is no such split, or `out` exists.
        InputDataError: If a model has other bodies than the capture, or no episode can be predicted.
        NotConvergedError: If a rollout diverges.
    """
    resolve_device(device)  # refuse a wrong device now, not after minutes
    mark = ""
    if out is not None:
        mark = mark_of(out, models, capture, split)
        overwrite = overwrite or shows_the_same(out, mark)
        refuse_output(out, "page", overwrite)
    _refuse_twice(models)
    loaded = [(str(path), read_model(path)) for path in models]
    accepted = accept_units or any(model.accepts_units for _, model in loaded)
    source = Capture.open(capture, splits=(split,), accept_units=accepted)
    with _checked_work(loaded, source, split):
        comparison = compare_models(loaded, source, split, warmup_s, device)
    if out is None:
        return comparison.result
    result = comparison.result.model_copy(update={"report": str(out)})
    footage = footage_of(comparison.models, source, device)
    with new_file(out, "page", overwrite) as path:
        files = links_beside(out, models, capture)
        path.write_text(comparison_html(result, comparison.models, footage, files, mark), encoding="utf-8")
    return result


def compare_models(
    models: Sequence[tuple[str, Model]],
    capture: Capture,
    split: str = "test",
    warmup_s: float = 0.1,
    device: str = "auto",
) -> Comparison:
    """Compare models, given with their names, on the episodes of a capture; see :func:`compare`."""
    for name, model in models:
        _check(name, model, capture)
    names = capture.episodes(split)
    if not names:
        raise InputDataError(
            f"{capture.root / 'capture.toml'}: split '{split}' has no episode.",
            "a split with episodes that the models have not seen.",
            f"list some under [splits] {split}, or name another split with --split.",
        )
    evaluations = []
    for name, model in models:
        note(f"compare: {name}")
        evaluations.append(evaluate_model(model, capture, split, warmup_s, device))
    shared = [name for name in names if all(any(e.errors.episode == name for e in ev.episodes) for ev in evaluations)]
    if not shared:
        raise InputDataError("no episode can be predicted by all models.", todo="run 'cgwm eval' with each model.")
    first, given = world_of_model(models[0][1]), capture.manifest.measurement
    bodies = [first.bodies[k].name for k in first.tracked]
    episodes, clocked = episodes_at_clock(capture, shared, bodies)
    prepared = prepare(first, episodes, (given.position_std_m, given.rotation_std_rad))
    compared = _with_short_predictions(models, evaluations, capture, episodes, prepared, bodies)
    figures = tuple(one.figures() for one in compared)
    best = min(figures, key=lambda one: one.translation_error_m.median)
    result = CompareResult(
        capture=str(capture.root),
        split=split,
        episodes=len(shared),
        verdict="",
        models=figures,
        best=best.model,
        pairs=tuple(_pairs(compared)),
        measurement_std={"position_m": prepared.noise.position_m, "rotation_rad": prepared.noise.rotation_rad},
        warnings=(
            *_fitted_to_them(compared, capture, shared),
            *_left_out(names, shared),
            *dict.fromkeys(text for _, model in models for text in changed_since_fit(model.file.provenance, capture)),
            *clocked,
            *prepared.warnings,
        ),
    )
    verdict = comparison_verdict(result, {one.name: one.short_name for one in compared})
    return Comparison(result.model_copy(update={"verdict": verdict}), tuple(compared))


def _with_short_predictions(
    models: Sequence[tuple[str, Model]],
    evaluations: Sequence[Evaluation],
    capture: Capture,
    episodes: Sequence[Episode],
    prepared: Prepared,
    bodies: Sequence[str],
) -> list[ComparedModel]:
    """Return the models with their short predictions and residual wrenches.

    Args:
        models: Names and models.
        evaluations: The open-loop evaluation of each.
        capture: The capture, for the groups of its episodes.
        episodes: The episodes that all models can predict.
        prepared: The same episodes, cut into segments once for all models.
        bodies: Names of the free bodies of the first model.
    """
    compared, shown = [], short_names([name for name, _ in models])
    worlds, contacts = [], []
    known: list[State] = []
    with one_torch_thread(), progress(desc="compare: short predictions", total=len(models), unit="model") as bar:
        flown = after_release(episodes, prepared.released_s)
        for _, model in models:
            # group-specific parameters come from the fit or from the same frames as the fitted states
            world = world_of_model(model)
            worlds.append(with_fitted_groups(world, flown, model.file, capture.groups, prepared.noise))
            contacts.append(contact_fit(worlds[-1], episodes, prepared, bodies, known))
            if contacts[-1] is not None:
                known.append(contacts[-1].observations.state)
            bar.update(1)
        every = zip(models, shown, evaluations, worlds, contacts, strict=True)
        for (name, model), short_name, evaluation, world, contact in every:
            fit = short_errors(world, episodes, prepared, bodies, beside_others(contact, known))
            points, covariates = wrench_points(world, fit, prepared)
            compared.append(
                ComparedModel(
                    name=name,
                    short_name=short_name,
                    model=model,
                    evaluation=evaluation,
                    noise=prepared.noise,
                    short=fit.errors,
                    wrenches=points,
                    covariates=covariates,
                )
            )
    return compared


@contextmanager
def _checked_work(models: Sequence[tuple[str, Model]], capture: Capture, split: str) -> Iterator[None]:
    """Refuse a comparison that this machine cannot finish; models that do not fit the capture are refused inside."""
    episodes = [Episode(name, tracks) for name in capture.episodes(split) if (tracks := capture.tracks(name))]
    spans, parts = durations(episodes), []
    for name, model in models:
        _check(name, model, capture)
        world = world_of_model(model)
        parts += evaluation_parts(world, episodes, STATE_FIT_EPISODES)
        parts.append(segment_part(f"short predictions of {name}", world, spans))
    with within_budget(parts, LESS, doubt=motion_doubt(spans)):
        yield


def _refuse_twice(models: Sequence[Path]) -> None:
    places = [real_path(path) for path in models]
    twice = next((path for k, path in enumerate(models) if places[k] in places[:k]), None)
    if twice is not None:
        raise UsageError(f"{twice}: this model is given twice.", "each model once.", "leave the second one out.")


def _check(name: str, model: Model, capture: Capture) -> None:
    """Raise InputDataError with the model's name if its bodies or physics do not fit the capture."""
    try:
        check_bodies(model, capture.body_names, str(capture.root))
        world_of_model(model)
    except InputDataError as error:
        found = error.found if error.found.startswith(name) else f"{name}: {error.found}"
        raise InputDataError(found, error.allowed, error.todo) from None


def _pairs(models: Sequence[ComparedModel]) -> list[PairedDifference]:
    """Return the differences of each model from the one before it and from the first."""
    wanted = [(k, k - 1) for k in range(1, len(models))] + [(k, 0) for k in range(2, len(models))]
    found = []
    for a, b in wanted:
        pair = paired_difference(models[a].name, models[b].name, models[a].errors_m, models[b].errors_m)
        if pair is not None:
            found.append(pair.model_copy(update={"short": short_difference(models[a].short, models[b].short)}))
    return found


def _fitted_to_them(models: Sequence[ComparedModel], capture: Capture, episodes: Sequence[str]) -> list[str]:
    """Return a warning for each model that was fitted to compared episodes, recognised by their tracks' hashes."""
    found = []
    for one in models:
        seen = one.model.file.provenance.input_sha256
        tracks = {name: capture.root / "tracks" / f"{name}.csv" for name in episodes}
        fitted = [name for name, path in tracks.items() if seen.get(f"tracks/{name}.csv") == sha256(path)]
        if fitted:
            share = f"{len(fitted)} of the {len(episodes)} episodes"
            found.append(f"{one.name} was fitted to {share}; its errors there are not predictions.")
    return found


def _left_out(names: Sequence[str], shared: Sequence[str]) -> list[str]:
    left_out = [name for name in names if name not in shared]
    if not left_out:
        return []
    listed = ", ".join(f"'{name}'" for name in left_out)
    return [f"not all models can predict {listed}; short predictions are compared on the other episodes."]

"""`cgwm compare`: where and when each model fails, side by side, on the same episodes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..datasets.atomic import new_file, refuse_existing, sha256
from ..datasets.capture import Capture
from ..datasets.models import Model, read_model
from ..datasets.progress import note, progress
from ..schemas import CompareResult, InputDataError, PairedDifference, UsageError
from .compared import ComparedModel
from .diagnosis.prepared import prepare
from .diagnosis.releases import after_release
from .eval import check_bodies, evaluate_model
from .own_worlds import with_fitted_numbers
from .paired import paired_difference
from .physics.world import World
from .prediction import Episode
from .reporting.compared_verdict import compared_verdict
from .reporting.comparison import comparison_html
from .reporting.footage import footage_of
from .sg_gs import resolve_device
from .short_errors import short_errors
from .threads import one_torch_thread
from .wrench_points import wrench_points

REPORT_HTML = "compare.html"


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `cgwm compare` prints, and the models with their predictions behind it."""

    result: CompareResult
    models: tuple[ComparedModel, ...]


def compare(
    models: Sequence[Path],
    capture: Path,
    split: str = "test",
    out: Path | None = None,
    warmup_s: float = 0.1,
    device: str = "auto",
    overwrite: bool = False,
) -> CompareResult:
    """Compare models on disk on the episodes of a capture, and write the page.

    Args:
        models: MODEL directories with fitted physics, the base first.
        capture: With tracks.
        split: The episodes.
        out: The page to write; None writes none.
        warmup_s: Length of the start of an episode that the models may see [s].
        device: Where images are rendered: auto, cpu or cuda.
        overwrite: Replace what is at `out`.

    Raises:
        UsageError: If a model is given twice, there is no such split, or `out` exists.
        InputDataError: If a model has other bodies than the capture, or no episode can be predicted.
        NotConvergedError: If a rollout diverges.
    """
    resolve_device(device)  # a wrong device is better told now than after minutes
    if out is not None:
        refuse_existing(out, overwrite)
    _refuse_twice(models)
    loaded = [(str(path), read_model(path)) for path in models]
    source = Capture.open(capture, splits=(split,))
    comparison = compare_models(loaded, source, split, warmup_s, device)
    if out is None:
        return comparison.result
    result = comparison.result.model_copy(update={"report": str(out)})
    footage = footage_of(comparison.models, source, device)
    with new_file(out, overwrite) as path:
        path.write_text(comparison_html(result, comparison.models, footage), encoding="utf-8")
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
        raise InputDataError("there is no episode that all models can predict.", todo="look at 'cgwm eval' of each.")
    episodes: list[Episode] = [(name, capture.tracks(name)) for name in shared]
    first, given = World.from_model(models[0][1]), capture.manifest.measurement
    prepared = prepare(first, episodes, (given.position_std_m, given.rotation_std_rad))
    bodies = [first.bodies[k].name for k in first.free]
    compared = []
    with one_torch_thread(), progress(desc="compare: short predictions", total=len(models), unit="model") as bar:
        for (name, model), short_name, evaluation in zip(models, _short_names(models), evaluations, strict=True):
            # of an episode's own numbers a short prediction knows as much as of its state
            world = World.from_model(model)
            flown = after_release(episodes, prepared.released_s)
            world = with_fitted_numbers(world, flown, model.file, capture.groups, prepared.noise)
            fit = short_errors(world, episodes, prepared, bodies)
            points, organisers = wrench_points(world, fit, prepared)
            compared.append(
                ComparedModel(name, short_name, model, evaluation, prepared.noise, fit.errors, points, organisers)
            )
            bar.update(1)
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
        measurement_std={"position_m": prepared.noise[0], "rotation_rad": prepared.noise[1]},
        warnings=(
            *_fitted_to_them(compared, capture, shared),
            *_left_out(names, shared),
            *prepared.warnings,
        ),
    )
    verdict = compared_verdict(result, {one.name: one.short_name for one in compared})
    return Comparison(result.model_copy(update={"verdict": verdict}), tuple(compared))


def _refuse_twice(models: Sequence[Path]) -> None:
    places = [path.resolve() for path in models]
    twice = next((path for k, path in enumerate(models) if places[k] in places[:k]), None)
    if twice is not None:
        raise UsageError(f"{twice}: this model is given twice.", "each model once.")


def _check(name: str, model: Model, capture: Capture) -> None:
    """Refuse a model that does not fit the capture, by its name: there are several of them."""
    try:
        check_bodies(model, capture.body_names, str(capture.root))
        World.from_model(model)
    except InputDataError as error:
        found = error.found if error.found.startswith(name) else f"{name}: {error.found}"
        raise InputDataError(found, error.allowed, error.todo) from None


def _short_names(models: Sequence[tuple[str, Model]]) -> list[str]:
    """Return the shortest ends of the models' paths that tell them apart.

    >>> _short_names([("a/m0", None), ("b/m1", None)]), _short_names([("a/m", None), ("b/m", None)])
    (['m0', 'm1'], ['a/m', 'b/m'])
    """
    parts = [os.path.normpath(name).split(os.sep) for name, _ in models]
    for length in range(1, max(map(len, parts))):
        ends = ["/".join(part[-length:]) for part in parts]
        if len(set(ends)) == len(ends):
            return ends
    return [name for name, _ in models]


def _pairs(models: Sequence[ComparedModel]) -> list[PairedDifference]:
    """Return each model against the one before it, and against the first."""
    wanted = [(k, k - 1) for k in range(1, len(models))] + [(k, 0) for k in range(2, len(models))]
    found = [
        paired_difference(models[a].name, models[b].name, models[a].errors_m, models[b].errors_m) for a, b in wanted
    ]
    return [pair for pair in found if pair is not None]


def _fitted_to_them(models: Sequence[ComparedModel], capture: Capture, episodes: Sequence[str]) -> list[str]:
    """Return a message on each model that was fitted to episodes on which it is now judged, told by their hashes."""
    found = []
    for one in models:
        seen = one.model.file.provenance.input_sha256
        tracks = {name: capture.root / "tracks" / f"{name}.csv" for name in episodes}
        own = [name for name, path in tracks.items() if seen.get(f"tracks/{name}.csv") == sha256(path)]
        if own:
            share = f"{len(own)} of the {len(episodes)} episodes"
            found.append(f"{one.name} was fitted to {share}: its errors there are no predictions.")
    return found


def _left_out(names: Sequence[str], shared: Sequence[str]) -> list[str]:
    left_out = [name for name in names if name not in shared]
    if not left_out:
        return []
    listed = ", ".join(f"'{name}'" for name in left_out)
    return [f"not all models can predict {listed}: short predictions are compared on the other episodes."]

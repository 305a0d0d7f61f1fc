"""The chain improve (`cgwm improve`): from a capture or model to a ladder of models, and the page that tells of it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...datasets.capture.capture import Capture
from ...datasets.io.atomic import copy_files, new_directory, sha256
from ...datasets.io.neighbours import clean_stale
from ...datasets.io.outputs import reads, refuse_output
from ...datasets.io.progress import note
from ...datasets.models.effect_files import effect_file
from ...datasets.models.fit_inputs import versions
from ...datasets.models.model import read_model, write_model
from ...schemas import (
    ImproveConfig,
    ImproveResult,
    ImproveTest,
    InterruptedWork,
    PhysConfig,
    SplatConfig,
    UsageError,
    read_json,
)
from ...schemas.printable import typed_path
from ..diagnose.next_experiment.experiments import DEFAULT, experiments_of, read_experiments
from ..diagnose.report.pictures import DrawnMotion, throw_of
from ..diagnose.stage import library_of
from ..fit import fit
from ..physics.model_world import world_of_model
from ..runtime.device import resolve_device
from .folds import folds_of
from .ladder import Climb, Ladder
from .ladder_files import LadderFiles, differing
from .page import PAGE, asking_step, ladder_html
from .test_split import TEST, has_test_split, tested
from .wording import sentence, warnings_of

DOCUMENT = "improve.json"


@dataclass(frozen=True, kw_only=True)
class _Request:
    """Arguments of an improvement."""

    capture: Capture
    """The capture, restricted to the split."""
    out: Path
    """Directory of the ladder."""
    parent: Path | None
    """Model to start from."""
    split: str
    """Split on which everything is decided."""
    config: ImproveConfig
    """Numbers of steps and folds."""
    splats: SplatConfig
    """Settings of sg-gs."""
    physics: PhysConfig
    """Settings of phys-geo."""
    candidates: tuple[str, ...]
    """Custom effects to test."""
    throws: Path | None
    """File of experiments to choose from."""
    accept_units: bool
    """Whether the capture's units are right although its motion contradicts them."""

    @property
    def settings(self) -> dict[str, str]:
        """What was asked for, by name."""
        return {
            "split": self.split,
            "improve": self.config.model_dump_json(),
            "sg-gs": self.splats.model_dump_json(),
            "phys-geo": self.physics.model_dump_json(),
            "candidates": ", ".join(self.candidates),
            "accept_units": str(self.accept_units).lower(),
        }

    def inputs(self) -> dict[str, str]:
        """Return the SHA-256 of the files that the decisions rest on, by name."""
        files = {"capture.toml": self.capture.root / "capture.toml"}
        names = self.capture.episodes(self.split)
        files |= {f"tracks/{name}.csv": self.capture.root / "tracks" / f"{name}.csv" for name in names}
        if self.parent is not None:
            files["first model"] = self.parent / "model.json"
        if self.throws is not None:
            files["throws"] = self.throws
        files |= {name: found[0] for name in self.candidates if (found := effect_file(name)) is not None}
        return {name: sha256(path) for name, path in files.items() if path.is_file()}


@reads("capture", "parent", "throws")
def improve(
    capture: Path,
    out: Path,
    parent: Path | None = None,
    split: str = "train",
    config: ImproveConfig | None = None,
    splat_config: SplatConfig | None = None,
    phys_config: PhysConfig | None = None,
    candidates: Sequence[str] = (),
    throws: Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    accept_units: bool = False,
) -> ImproveResult:
    """Fit a model, diagnose it, add what helps to predict unseen episodes, and repeat until nothing does.

    All decisions rest on cross-validation within one split; the split `test` is opened once, after the last step.

    A complete ladder that was made of the same inputs and settings is kept, and nothing is done.

    Args:
        capture: The capture, with tracks.
        out: The directory to write: the models `m0`, `m1`, ..., `improve.json` and the page; it appears when complete.
        parent: A model to start from, which becomes `m0`; None fits one.
        split: The episodes to fit and to diagnose.
        config: Numbers of steps and folds.
        splat_config: Settings of sg-gs, for the first model.
        phys_config: Settings of phys-geo, for all models; its effects are those of the first model.
        candidates: Effects to test in addition to the built-in ones, `file.py:Class` or names of entry points.
        throws: TOML file with the throws to choose the next experiment from; None for throws that can be made by hand.
        overwrite: Replace an existing ladder.
        resume: Continue an interrupted ladder.
        accept_units: Do not refuse units and frames of the capture that its motion contradicts.

    Returns:
        The content of `improve.json`.

    Raises:
        UsageError: If `out` holds something else, or a ladder that was made of something else, the split does not
            exist, or the fits are not supervised by tracks.
        InputDataError: If the capture lacks what a fit or a diagnosis needs.
        NotConvergedError: If the fit of a model of the ladder diverges.
    """
    out, physics = Path(out), phys_config or PhysConfig()
    clean_stale(out)
    finished = (out / DOCUMENT).is_file()
    if not finished:
        refuse_output(out, "ladder", overwrite)
    _refuse_early(capture, parent, physics)
    experiments = experiments_of(DEFAULT) if throws is None else read_experiments(throws)
    library = library_of(candidates)
    accepted = accept_units or (parent is not None and read_model(parent).accepts_units)
    request = _Request(
        capture=Capture.open(capture, splits=(split,), accept_units=accepted),
        out=out,
        parent=parent,
        split=split,
        config=config or ImproveConfig(),
        splats=splat_config or SplatConfig(),
        physics=physics,
        candidates=tuple(candidates),
        throws=throws,
        accept_units=accepted,
    )
    episodes = request.capture.episodes(split)
    inputs = request.inputs()
    if finished and (resume or not overwrite) and (kept := _kept(request, inputs, overwrite)) is not None:
        note(f"improve: {out} is already the result of this command")
        return kept
    refuse_output(out, "ladder", overwrite)
    made_of = {**inputs, **request.settings, "versions": json.dumps(versions())}
    files = LadderFiles(out, made_of, resume, overwrite)
    climb = Climb(
        capture=request.capture,
        split=split,
        files=files,
        folds=folds_of(episodes, request.config.folds),
        config=request.config,
        physics=physics.model_copy(update={"effects": ()}),
        library=library,
        throws=experiments,
        accept_units=accepted,
    )
    try:
        _first_model(request, files)
        ladder = climb.run()
        result = _result(request, climb, ladder, inputs)
    except KeyboardInterrupt:
        raise InterruptedWork(f"{files.path} holds what is done; --resume goes on with it.") from None
    _write(request, files, result, overwrite)
    files.remove()
    return result


def _refuse_early(capture: Path, parent: Path | None, physics: PhysConfig) -> None:
    """Refuse settings that no ladder can have, before any work."""
    resolve_device(physics.device)
    if physics.supervise != "tracks":
        raise UsageError(
            f"phys-geo.supervise is {physics.supervise}: a ladder is judged on measured tracks.", "tracks.",
            "leave it out; for videos run fit and diagnose step by step.",
        )  # fmt: skip
    if parent is not None and physics.effects:
        raise UsageError(
            f"phys-geo.effects with a model to start from: {', '.join(physics.effects)}.",
            "the effects of that model, to which the ladder adds.",
            f"run 'cgwm fit {typed_path(capture)} --from {typed_path(parent)} --effects NAME --out MODEL' first, and "
            "start from MODEL.",
        )


def _first_model(request: _Request, files: LadderFiles) -> None:
    """Fit the first model, or copy the one to start from."""
    place = files / "m0"
    if (place / "model.json").is_file():
        return
    if request.parent is None:
        note("improve: fit m0")
        root = request.capture.root
        accepted = request.accept_units
        fit(
            root, place, "all", None, request.split, request.splats, request.physics, resume=True, accept_units=accepted
        )
        return
    model = read_model(request.parent)
    source = model.file.provenance
    if source.parent is not None:  # a relative path from the new place
        above = os.path.relpath(request.parent.parent / source.parent, request.out)
        moved = model.file.model_copy(update={"provenance": source.model_copy(update={"parent": above})})
        model = replace(model, file=moved)
    write_model(place, model)


def _kept(request: _Request, inputs: dict[str, str], overwrite: bool) -> ImproveResult | None:
    """Return a complete ladder that was made of the same; None if it is to be made anew.

    Raises:
        UsageError: If it was made of something else, and `overwrite` is not set.
    """
    made = read_json(request.out / DOCUMENT, ImproveResult)
    found = {name: digest for name, digest in made.input_sha256.items() if not name.startswith(f"{TEST}: ")}
    names = differing({**found, **made.settings}, {**inputs, **request.settings})
    if not names:
        files = LadderFiles.path_of(request.out)
        if (files / "made_of.json").is_file():  # left by a process that was killed at its end
            LadderFiles(request.out, {}, resume=False, overwrite=True).remove()
        return made
    if overwrite:
        return None
    raise UsageError(
        f"{request.out} is complete, and was made with other values of {', '.join(names)}.",
        todo="choose another --out, or pass --overwrite to make this ladder anew.",
    )


def _result(request: _Request, climb: Climb, ladder: Ladder, inputs: dict[str, str]) -> ImproveResult:
    """Open the split `test`, and return the document of a ladder."""
    root, files, test = request.capture.root, climb.files, None
    hashes = dict(inputs)
    if has_test_split(request.capture, request.split):
        note("improve: open the split 'test'")
        test = files.document(
            "test.json",
            ImproveTest,
            lambda: tested(files.path, ladder.models, root, request.physics.device, request.accept_units),
        )
        for name in request.capture.manifest.splits[TEST]:
            path = root / "tracks" / f"{name}.csv"
            hashes |= {f"{TEST}: tracks/{name}.csv": sha256(path)} if path.is_file() else {}
    return ImproveResult(
        capture=str(root),
        split=request.split,
        episodes=len(request.capture.episodes(request.split)),
        folds=climb.folds,
        models=ladder.models,
        model_sha256={name: sha256(files / name / "model.json") for name in ladder.models},
        sentence=sentence(ladder, test),
        stopped=ladder.stopped,
        steps=ladder.steps,
        refusal=ladder.refusal,
        test=test,
        page=PAGE,
        input_sha256=hashes,
        versions=versions(),
        settings=request.settings,
        warnings=warnings_of(ladder, test, climb.folds),
    )


def _write(request: _Request, files: LadderFiles, result: ImproveResult, overwrite: bool) -> None:
    """Write the complete ladder."""
    with new_directory(request.out, "ladder", overwrite) as folder:
        for name in result.models:
            copy_files(files / name, folder / name)
        (folder / DOCUMENT).write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
        (folder / PAGE).write_text(ladder_html(result, request.out, _asked(result, files)), encoding="utf-8")


def _asked(result: ImproveResult, files: LadderFiles) -> tuple[DrawnMotion, ...]:
    """Return the experiment that the ladder asks for, as it would fly with what was added since; empty for none."""
    step = asking_step(result.steps)
    if step is None or step.next_experiment is None:
        return ()
    return throw_of(world_of_model(read_model(files / (step.next_model or step.model))), step.next_experiment)

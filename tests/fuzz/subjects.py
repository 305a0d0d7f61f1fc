"""Valid inputs of every kind, small, and the commands that read them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .captures import (
    filmed,
    photographed,
    settings,
    shaped,
    throws,
    tracks,
    video_file,
    with_colmap,
    with_transforms,
    write_toss_capture,
)
from .models import bare, custom, dataset, hand, merged, model, plan, run, task
from .recordings import (
    arkitscenes,
    balldrops,
    board_photos,
    bodies_csv,
    calibration,
    colmap,
    contactnets_npz,
    contactnets_pt,
    csv,
    elbow,
    hdf5,
    jointed,
    jointed_mjcf,
    jugglebot,
    nerfstudio,
    phone_photos,
    pinwm,
    polycam,
    realsense_bag,
    realsense_db3,
    record3d,
    rosbag,
    stray,
    things,
    tum,
    walk,
)

FAST_FIT = (
    *("--set", "phys-geo.step_s=0.003", "--set", "phys-geo.population=8"),
    *("--set", "phys-geo.generations=2", "--set", "phys-geo.iterations=1"),
)
FAST_SPLATS = (
    *("--stage", "sg-gs", "--set", "sg-gs.iterations=2", "--set", "sg-gs.max_body_spheres=40"),
    *("--set", "sg-gs.max_scene_spheres=40", "--set", "sg-gs.image_size=32", "--set", "sg-gs.turntable=false"),
)
TINY_IMAGES = ("--set", "synthesize.width=20", "--set", "synthesize.height=16", "--set", "synthesize.duration_s=0.1")
SYNTHESIZE = (*TINY_IMAGES, "--rollouts", "1", "--no-preview")


@dataclass(frozen=True)
class Command:
    """A command as a user types it in the folder of a subject; OUT is its output, beside the inputs."""

    words: tuple[str, ...]
    weight: float = 1.0
    """How often it is tried, relative to others: less where it is slow."""
    changes: tuple[str, ...] = ()
    """Patterns of what it may write among its inputs, if it succeeds."""
    serves: bool = False
    """Whether it runs until it is interrupted."""


def command(text: str, *more: str, weight: float = 1.0, changes: tuple[str, ...] = (), serves: bool = False) -> Command:
    return Command((*text.split(), *more), weight, changes, serves)


@dataclass(frozen=True)
class Subject:
    """A folder of inputs and what reads them."""

    name: str
    kind: str
    """The class that it is counted under."""
    build: Callable[[Path], None]
    commands: tuple[Command, ...]
    files: tuple[str, ...] = ("**/*",)
    """Patterns of the files that are mutated."""
    weight: float = 1.0


VALIDATE = command("validate capture", weight=3)
FIT = command("fit capture --out OUT --stage phys-geo", *FAST_FIT, weight=0.5)
EVAL = command("eval model capture")
COMPARE = command("compare model capture --out OUT.html", weight=0.7)
DIAGNOSE = command("diagnose model capture --split look --page OUT.html", weight=0.3)
IMPROVE = command("improve capture --from model --split look --steps 1 --out OUT", *FAST_FIT, weight=0.1)
MASK = command("mask capture --out OUT", weight=0.5)
BOX = command("mask capture --out OUT --box 4,4,40,40", weight=0.5)
SPLATS = command("fit capture --out OUT", *FAST_SPLATS, weight=0.3)
FIT_IMAGES = command(
    "fit capture --out OUT --stage phys-geo --from model --supervise images --set phys-geo.image_size=32",
    *FAST_FIT,
    weight=0.1,
)
ON_MODELS = (
    command("validate model", weight=3),
    command("synthesize model --out OUT", *SYNTHESIZE),
    command("export model --to mjcf --out OUT.xml --duration 0.1", weight=0.5),
    command("export model --to urdf --out OUT", weight=0.3),
    command("export model --to sdf --out OUT", weight=0.3),
    command("export model --to usd --out OUT.usda", weight=0.3),
    command("export model --to mesh --out OUT.glb", weight=0.3),
    command("export model --to ply --out OUT", weight=0.5),
    command("export model --to glb --out OUT.glb", weight=0.5),
    command("synthesize model --print-plan", weight=0.5),
    command("view model --port 0 --no-open", weight=0.5, serves=True),
)
ON_DATASETS = (
    command("validate dataset", weight=3),
    command("export dataset --to bop --out OUT", weight=0.5),
    command("export dataset --to nerfstudio --out OUT", weight=0.5),
    command("export dataset --to lerobot --out OUT", weight=0.3),
    command("export dataset --to rerun --out OUT.rrd", weight=0.3),
    command("merge dataset --out OUT.h5", weight=0.7),
    command("eval model dataset --split train", weight=0.5),
    command("view dataset --port 0 --no-open", weight=0.5, serves=True),
)


def imports(words: str) -> tuple[Command, ...]:
    return (command(f"import {words} --out OUT"),)


SUBJECTS = {
    subject.name: subject
    for subject in (
        Subject("tracks", "captures", tracks, (VALIDATE, FIT, EVAL, COMPARE, DIAGNOSE, IMPROVE), ("capture/**/*",), 3),
        Subject("photos", "captures", photographed, (VALIDATE, SPLATS, MASK, BOX), ("capture/**/*",), 2),
        Subject("jointed", "captures", jointed, (VALIDATE,), ("capture/**/*",), 0.5),
        Subject("jointed mjcf", "captures", jointed_mjcf, (VALIDATE,), ("capture/elbow.xml",), 0.5),
        Subject("filmed", "captures", filmed, (VALIDATE, FIT_IMAGES), ("capture/**/*",), 1),
        Subject("video file", "captures", video_file, (VALIDATE, FIT_IMAGES), ("capture/videos/**/*.mp4",), 0.5),
        Subject(
            "shapes",
            "captures",
            shaped,
            tuple(
                made
                for name in ("obj", "stl", "ply")
                for made in (
                    command(f"validate {name}"),
                    command(f"fit {name} --out OUT --stage phys-geo", *FAST_FIT, weight=0.3),
                )
            ),
            ("*/box.*", "*/capture.toml"),
            0.7,
        ),
        Subject(
            "calibration",
            "captures",
            calibration,
            (
                command(
                    "calibrate capture --set calibrate.max_features=300 --set calibrate.retries=0",
                    changes=("capture/cameras.json", "capture/calibration.json", "capture/sparse*"),
                ),
            ),
            weight=0.15,
        ),
        Subject(
            "calibration target",
            "captures",
            board_photos,
            (
                command("calibrate board --target charuco --overwrite", changes=("board/intrinsics.json",)),
                command("validate board/intrinsics.json"),
                command(
                    "calibrate capture --intrinsics board/intrinsics.json --set calibrate.retries=0",
                    weight=0.3,
                    changes=("capture/cameras.json", "capture/calibration.json", "capture/sparse*"),
                ),
            ),
            ("board/*",),
            weight=0.3,
        ),
        Subject("model", "models", model, (*ON_MODELS,), ("model/**/*",), 3),
        Subject(
            "tracked model",
            "models",
            tracks,
            (
                EVAL,
                COMPARE,
                DIAGNOSE,
                command("fit capture --out OUT --from model --stage phys-geo", *FAST_FIT, weight=0.5),
            ),
            ("model/**/*",),
            1,
        ),
        Subject(
            "custom effect",
            "models",
            custom,
            (*ON_MODELS, EVAL, COMPARE, command("effects show model/effects/lift.py:Other", weight=0)),
            ("model/**/*",),
            1,
        ),
        Subject("dataset", "datasets", dataset, ON_DATASETS, ("dataset/*", "dataset/model/*"), 2.5),
        Subject(
            "dataset without images",
            "datasets",
            bare,
            tuple(c for c in ON_DATASETS if c.words[0] != "export"),
            ("dataset/*",),
            1.5,
        ),
        Subject("merged dataset", "datasets", merged, ON_DATASETS, ("dataset/*",), 1),
        Subject(
            "plan",
            "plans",
            plan,
            (command("synthesize model --plan plan.toml --out OUT", *SYNTHESIZE),),
            ("plan.toml",),
            1.5,
        ),
        Subject(
            "task",
            "tasks",
            task,
            (command("control model task.toml --out OUT --clock ideal", weight=0.5),),
            ("task.toml",),
            1.0,
        ),
        Subject(
            "hand",
            "hands",
            hand,
            (command("control model task.toml --out OUT --clock ideal", weight=0.5),),
            ("task.toml",),
            0.7,
        ),
        Subject("run", "runs", run, (command("validate run"),), ("run/*",), 0.7),
        Subject(
            "throws",
            "throws",
            throws,
            (command("diagnose model capture --split look --throws throws.toml"),),
            ("throws.toml",),
            0.7,
        ),
        Subject(
            "settings of fit",
            "settings",
            settings,
            (
                command("fit capture --out OUT --stage phys-geo --config fit.toml", weight=0.5),
                command("fit photos/capture --out OUT --stage sg-gs --config fit.toml", weight=0.2),
            ),
            ("fit.toml",),
            0.7,
        ),
        Subject(
            "settings of synthesize",
            "settings",
            settings,
            (command("synthesize model --out OUT --no-preview --config synthesize.toml"),),
            ("synthesize.toml",),
            0.7,
        ),
        Subject("transforms.json", "cameras", with_transforms, (VALIDATE, SPLATS), ("capture/transforms.json",), 0.7),
        Subject(
            "cameras.json",
            "cameras",
            photographed,
            (VALIDATE, SPLATS, command("export model --to colmap --capture capture --out OUT")),
            ("capture/cameras.json",),
            0.7,
        ),
        Subject("COLMAP text", "cameras", with_colmap, (VALIDATE,), ("capture/sparse/0/*",), 0.5),
        Subject(
            "COLMAP binary", "cameras", lambda root: with_colmap(root, True), (VALIDATE,), ("capture/colmap/*",), 0.5
        ),
        Subject("csv", "importers", csv, imports("csv csv"), weight=0.7),
        Subject("csv of bodies", "importers", bodies_csv, imports("csv two.csv"), weight=0.5),
        Subject("tum", "importers", tum, imports("tum poses.txt"), weight=0.5),
        Subject("hdf5", "importers", hdf5, imports("hdf5 poses.h5"), weight=1.0),
        Subject("rosbag", "importers", rosbag, imports("rosbag bag"), weight=0.5),
        Subject(
            "contactnets npz",
            "importers",
            contactnets_npz,
            imports("contactnets tosses --train 2 --test 1"),
            weight=0.5,
        ),
        Subject(
            "contactnets pt", "importers", contactnets_pt, imports("contactnets tosses --train 2 --test 1"), weight=0.5
        ),
        Subject("elbow", "importers", elbow, imports("elbow elbow"), weight=0.5),
        Subject("pinwm", "importers", pinwm, imports("pinwm pushes --train 4"), weight=0.5),
        Subject("jugglebot", "importers", jugglebot, imports("jugglebot throws"), weight=0.5),
        Subject("phone photos", "importers", phone_photos, imports("photos photos"), weight=0.5),
        Subject("walk", "importers", walk, imports("video walk.mp4 --photos 4"), weight=0.3),
        Subject("nerfstudio", "importers", nerfstudio, imports("nerfstudio scene"), weight=0.5),
        Subject("colmap", "importers", colmap, imports("colmap scene --length-unit m"), weight=0.5),
        Subject("polycam", "importers", polycam, imports("polycam scan"), weight=0.5),
        Subject("record3d", "importers", record3d, imports("record3d scan --photos 4"), weight=0.5),
        Subject("stray", "importers", stray, imports("arkit scan --photos 4"), weight=0.5),
        Subject("arkitscenes", "importers", arkitscenes, imports("arkit scan --photos 4"), weight=0.5),
        Subject("realsense bag", "importers", realsense_bag, imports("realsense walk.bag"), weight=0.5),
        Subject("realsense db3", "importers", realsense_db3, imports("realsense walk.db3"), weight=0.5),
        Subject("tosses", "captures", write_toss_capture, (), weight=0),
        Subject("things", "outputs", things, (), weight=0),
        Subject("nothing", "captures", lambda root: None, (), weight=0),
        Subject("balldrops", "importers", balldrops, imports("balldrops drops"), weight=0.5),
    )
}


class Library:
    """The valid inputs, each built once, and copied for each case."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def built(self, name: str) -> Path:
        """Return the inputs of a subject, to be read only."""
        made = self.root / name.replace(" ", "-")
        if not made.exists():
            made.mkdir(parents=True)
            SUBJECTS[name].build(made)
        return made

    def copy(self, name: str, to: Path) -> None:
        """Copy the inputs of a subject into a new directory."""
        shutil.copytree(self.built(name), to, symlinks=True)

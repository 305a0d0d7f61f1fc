"""Commands for `kill_run`, with inputs so small that a run takes a second or two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.calibrate.target.intrinsics import one_opencv_thread
from cgwm.pipeline.phys_geo.images import pose_search, pose_tracking
from cgwm.pipeline.phys_geo.tracks import contact_shooting
from cgwm.pipeline.runtime.checkpoint import Checkpoint
from cgwm.pipeline.sg_gs import bodies
from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement
from cgwm.schemas import task_toml
from helpers.pushing import push_task
from helpers.small_model import write_small_model
from helpers.target_photos import write_photos
from helpers.thrown_cube import write_capture
from helpers.tiny_capture import FAST, model_of, thrown, write_tiny_capture
from pipeline.sg_gs.test_sg_gs import make_capture

from datasets.importers import test_photo_importers, test_sensor_importers
from pipeline.calibrate import test_calibrate
from pipeline.mask import test_mask


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command that writes one output, in a folder that holds its inputs."""

    words: list[str]
    """The arguments after `cgwm`."""
    out: tuple[str, ...]
    """The names of what it writes, in the folder."""
    again: tuple[str, ...] = ()
    """Further arguments of the run after a kill."""
    before: tuple[list[str], ...] = ()
    """Commands that make inputs."""
    first: list[str] | None = None
    """A command that makes an older output, to be replaced."""
    check: tuple[list[str], ...] = ()
    """Commands that accept the complete output."""
    grows: bool = False
    """Whether the output may be there in part: whole shards."""


def _settings(*pairs: str) -> list[str]:
    return [word for pair in pairs for word in ("--set", pair)]


def _replacing(case: Callable[[Path], Command], *older: str) -> Callable[[Path], Command]:
    """Return the case with `--overwrite`, where an older output is, made with other settings."""

    def replacing(folder: Path) -> Command:
        command = case(folder)
        return replace(command, words=[*command.words, "--overwrite"], first=[*command.words, *older])

    return replacing


def _calibrate(folder: Path) -> Command:
    root = folder / "capture"
    (root / "images").mkdir(parents=True)
    floor, wall = test_calibrate._floor(), test_calibrate._texture(640, 1)[:400]
    for index, pose in enumerate(test_calibrate._poses(5)):
        image = test_calibrate._render(pose, floor, wall)
        cv2.imwrite(str(root / "images" / f"{index}.png"), image[:, :, ::-1])
    (root / "capture.toml").write_text(test_calibrate.MANIFEST + test_calibrate.MARKERS)
    words = ["calibrate", str(root), *_settings("calibrate.max_features=500", "calibrate.retries=0")]
    out = tuple(f"capture/{name}" for name in ("cameras.json", "calibration.json", "sparse_points.ply"))
    return Command(words=words, out=out, check=(["validate", str(root)],))


def _mask(folder: Path) -> Command:
    test_mask.folder(folder / "photos", test_mask.scene("one colour")[0])
    words = ["mask", str(folder / "photos"), "--out", str(folder / "out")]
    return Command(words=words, out=("out",), check=(["validate", str(folder / "out")],))


def _mask_videos(folder: Path) -> Command:
    test_mask.films(folder / "capture")
    words = ["mask", str(folder / "capture"), "--empty", "empty", "--out", str(folder / "out")]
    return Command(words=words, out=("out",), check=(["validate", str(folder / "out")],))


def _target(folder: Path) -> Command:
    with one_opencv_thread():  # a command that is forked from here would wait for threads that it has not
        write_photos(folder / "board", 9)
    out = "board/intrinsics.json"
    words = ["calibrate", str(folder / "board"), "--target", "charuco"]
    return Command(words=words, out=(out,), check=(["validate", str(folder / out)],))


def _photos(folder: Path) -> Command:
    make_capture(folder / "capture")
    few = ("iterations=6", "max_body_spheres=60", "max_scene_spheres=80", "max_collision_spheres=20", "image_size=48")
    words = ["fit", str(folder / "capture"), "--stage", "sg-gs", "--out", str(folder / "out"), "--device", "cpu"]
    words += _settings(*(f"sg-gs.{one}" for one in few), "sg-gs.turntable=false", "sg-gs.joint=false")
    return Command(words=words, out=("out",), again=("--resume",), check=(["validate", str(folder / "out")],))


def _tracks(folder: Path) -> Command:
    capture, model = write_capture(folder / "capture", 2), write_small_model(folder / "model")
    words = ["fit", str(capture), "--from", str(model), "--split", "test", "--out", str(folder / "out"), *FAST]
    return Command(words=words, out=("out",), again=("--resume",), check=(["validate", str(folder / "out")],))


def _images(folder: Path) -> Command:
    track = thrown()
    assert track.quat_wxyz is not None
    short = Track(track.time_s[:6], track.position_m[:6], track.quat_wxyz[:6])
    root = write_tiny_capture(folder / "capture", short)
    words = ["fit", str(root), "--from", str(model_of(root)), "--supervise", "images", "--stage", "phys-geo"]
    words += ["--out", str(folder / "out"), "--device", "cpu", *FAST, *_settings("phys-geo.image_size=32")]
    return Command(words=words, out=("out",), again=("--resume",), check=(["validate", str(folder / "out")],))


_SMALL = _settings("synthesize.duration_s=0.2", "synthesize.width=32", "synthesize.height=24")


def _synthesis(folder: Path, out: str) -> list[str]:
    if not (folder / "model").exists():
        write_small_model(folder / "model")
    return [
        "synthesize",
        str(folder / "model"),
        "--out",
        str(folder / out),
        "--rollouts",
        "4",
        "--shards",
        "2",
        *_SMALL,
    ]


def _synthesize(folder: Path) -> Command:
    check = (["validate", str(folder / "out")],)
    return Command(words=_synthesis(folder, "out"), out=("out",), again=("--resume",), check=check, grows=True)


def _of_dataset(*verb: str, check: bool = False) -> Callable[[Path], Command]:
    def case(folder: Path) -> Command:
        words = [verb[0], str(folder / "dataset"), *verb[1:], "--out", str(folder / "out")]
        made = _synthesis(folder, "dataset")
        checks = (["validate", str(folder / "out")],) if check else ()
        return Command(words=words, out=("out",), before=([*made, "--no-preview"],), check=checks)

    return case


def _mjcf(folder: Path) -> Command:
    model = write_small_model(folder / "model")
    words = ["export", str(model), "--to", "mjcf", "--out", str(folder / "out.xml"), "--duration", "0.1"]
    return Command(words=words, out=("out.xml",))


def _urdf(folder: Path) -> Command:
    model = write_small_model(folder / "model")
    return Command(words=["export", str(model), "--to", "urdf", "--out", str(folder / "out")], out=("out",))


def _sdf(folder: Path) -> Command:
    model = write_small_model(folder / "model")
    return Command(words=["export", str(model), "--to", "sdf", "--out", str(folder / "out")], out=("out",))


def _usd(folder: Path) -> Command:
    model = write_small_model(folder / "model")
    return Command(words=["export", str(model), "--to", "usd", "--out", str(folder / "out.usda")], out=("out.usda",))


def _improve(folder: Path) -> Command:
    capture, model = write_capture(folder / "capture", 3), write_small_model(folder / "model")
    words = ["improve", str(capture), "--from", str(model), "--split", "test", "--steps", "1"]
    words += ["--out", str(folder / "out"), *FAST, *_settings("improve.folds=2")]
    return Command(words=words, out=("out",), again=("--resume",), check=(["validate", str(folder / "out")],))


def _page(verb: str, option: str) -> Callable[[Path], Command]:
    def case(folder: Path) -> Command:
        capture, model = write_capture(folder / "capture", 3), write_small_model(folder / "model")
        words = [verb, str(model), str(capture), "--split", "test", option, str(folder / "out.html")]
        return Command(words=words, out=("out.html",))

    return case


def _import(folder: Path) -> Command:
    capture = write_capture(folder / "source", 6)
    words = ["import", "csv", str(capture / "tracks"), "--out", str(folder / "out")]
    return Command(words=words, out=("out",))


def _import_video(folder: Path) -> Command:
    test_photo_importers.write_walk(folder / "walk.mp4", 12)
    words = ["import", "video", str(folder / "walk.mp4"), "--photos", "4", "--out", str(folder / "out")]
    return Command(words=words, out=("out",), check=(["validate", str(folder / "out")],))


def _import_arkit(folder: Path) -> Command:
    test_sensor_importers.write_arkitscenes(folder / "scan")
    words = ["import", "arkit", str(folder / "scan"), "--out", str(folder / "out")]
    return Command(words=words, out=("out",), check=(["validate", str(folder / "out")],))


def _control(folder: Path) -> Command:
    write_small_model(folder / "model", visible=False)
    (folder / "task.toml").write_text(task_toml(push_task()))
    words = ["control", str(folder / "model"), str(folder / "task.toml"), "--out", str(folder / "out")]
    words += ["--clock", "ideal", "--seeds", "2"]
    return Command(words=words, out=("out",), again=("--resume",), check=(["validate", str(folder / "out")],))


# not `export --to rerun`: Rerun stamps what it writes with the time, so that no two runs give the same bytes
CASES: dict[str, Callable[[Path], Command]] = {
    "mask": _mask,
    "mask --empty": _mask_videos,
    "mask --overwrite": _replacing(_mask, "--box", "30,20,90,70"),
    "calibrate": _calibrate,
    "calibrate --overwrite": _replacing(_calibrate, "--seed", "5", "--set", "calibrate.max_features=600"),
    "calibrate target": _target,
    "fit photos": _photos,
    "fit photos --overwrite": _replacing(_photos, "--seed", "5"),
    "fit tracks": _tracks,
    "fit tracks --overwrite": _replacing(_tracks, "--seed", "5"),
    "fit images": _images,
    "synthesize": _synthesize,
    "merge": _of_dataset("merge", check=True),
    "export bop": _of_dataset("export", "--to", "bop"),
    "export bop --overwrite": _replacing(_of_dataset("export", "--to", "bop"), "--every", "2"),
    "export mjcf": _mjcf,
    "export mjcf --overwrite": _replacing(_mjcf, "--seed", "5"),
    "export urdf": _urdf,
    "export sdf": _sdf,
    "export usd": _usd,
    "import csv": _import,
    "import video": _import_video,
    "import arkit": _import_arkit,
    "improve": _improve,
    "control": _control,
    "control --overwrite": _replacing(_control, "--draws", "2"),
    "compare": _page("compare", "--out"),
    "diagnose": _page("diagnose", "--page"),
    "eval": _page("eval", "--page"),
}


def without_waiting() -> None:
    """Write a checkpoint after every step, and leave out what takes long and writes nothing."""
    Checkpoint.__init__.__defaults__ = (0.0,)
    contact_shooting.SHOT_ITERATIONS = 1
    pose_search.ROTATIONS, pose_search.KEPT, pose_search.DESCENT_ITERATIONS = 6, 1, 1
    pose_tracking.KEYFRAMES, pose_tracking.BEAM, pose_tracking.CARRY_ITERATIONS = 1, 1, 1
    bodies.refine = lambda hull, *_: (hull, Refinement(0.0, 0.0, 0.0))


def names(chosen: Sequence[str]) -> list[str]:
    """Return the cases that begin with one of the words, or all; after `--only`, the one of that very name."""
    if chosen and chosen[0] == "--only":
        return [chosen[1]]
    return [name for name in CASES if not chosen or name.startswith(tuple(chosen))]

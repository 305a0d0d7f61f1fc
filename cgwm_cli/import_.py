"""The verb `cgwm import`: convert recordings in other formats to a capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .execution import Emit
from .options import Overwrite
from .usage import refuse_foreign
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import ImportResult

_SPLITS = ("train", "test", "seed")
_TRACKS = ("body", "up", *_SPLITS)
_OPTIONS: dict[str, tuple[str, ...]] = {
    "contactnets": _SPLITS,
    "pinwm": ("train",),
    "jugglebot": ("only", *_SPLITS),
    "balldrops": ("only",),
    "pushes": ("only", *_SPLITS),
    "elbow": _SPLITS,
    "csv": ("columns", "length_unit", "time_unit", "frame_rate", "euler", "angle_unit", "spin_frame", *_TRACKS),
    "tum": ("length_unit", "time_unit", *_TRACKS),
    "hdf5": ("columns", "length_unit", "time_unit", *_TRACKS),
    "rosbag": ("topic", *_TRACKS),
    "photos": (),
    "video": ("photos",),
    "nerfstudio": ("length_unit",),
    "colmap": ("length_unit",),
    "polycam": (),
    "record3d": ("photos",),
    "arkit": ("photos",),
    "realsense": ("photos",),
}
"""Options that each format takes."""


@verb
def import_capture(
    emit: Emit,
    format_: Annotated[
        Literal[
            "photos",
            "video",
            "nerfstudio",
            "colmap",
            "polycam",
            "record3d",
            "arkit",
            "realsense",
            "csv",
            "tum",
            "hdf5",
            "rosbag",
            "contactnets",
            "pinwm",
            "jugglebot",
            "balldrops",
            "pushes",
            "elbow",
        ],
        typer.Argument(
            metavar="FORMAT",
            help="photos: a folder of photos (.heic, too); video: a walk around the scene, whose sharp frames become "
            "photos; nerfstudio, colmap: photos with cameras (transforms.json, also Blender's; a COLMAP model); "
            "polycam, record3d: scans of a phone; arkit: a recording of Stray Scanner or a scene of ARKitScenes; "
            "realsense: a .bag or .db3 of a RealSense camera; csv, tum, hdf5, rosbag: your own poses; contactnets: "
            "tosses of a cube (.pt files or .npz); pinwm: pushes of a block, with frames and masks; jugglebot: throws "
            "of a ball; balldrops: falling balls; pushes: a robot's finger that pushes an object, with forces (.txt of "
            "MLab_EXP, .json or .h5 of MIT push, or a .tar.xz of them); elbow: tosses of two links with a hinge "
            "(folder or .tar.xz of .pt files and a URDF).",
            show_default=False,
        ),
    ],
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="What to import.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="CAPTURE", help="The directory to write.", show_default=False)
    ],
    train: Annotated[
        int | None,
        typer.Option(
            "--train",
            min=1,
            help="Episodes of the split 'train' (contactnets: 50, else 60 %); pinwm: frames of each episode (12).",
            show_default=False,
        ),
    ] = None,
    test: Annotated[
        int | None,
        typer.Option(
            "--test",
            min=0,
            help="Episodes of the split 'test' (contactnets: 100, else the others).",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the permutation before splitting (0).", show_default=False),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            "--only",
            metavar="GROUP",
            help="jugglebot: one session; balldrops: one ball; pushes: one file.",
            show_default=False,
        ),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            "--columns",
            metavar="KEY=NAME,...",
            help="csv: names of columns that are not recognised (time, take, body, px .. pz, qw .. qz, roll, pitch, "
            "yaw, wx .. wz); hdf5: names of datasets (time, position, quat_wxyz, quat_xyzw).",
            show_default=False,
        ),
    ] = None,
    length_unit: Annotated[
        Literal["m", "cm", "mm", "in"] | None,
        typer.Option(
            "--length-unit",
            help="csv, tum, hdf5: unit of positions (m); nerfstudio, colmap: unit of the poses (none: unscaled).",
            show_default=False,
        ),
    ] = None,
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None,
        typer.Option("--time-unit", help="csv, tum, hdf5: unit of times (s).", show_default=False),
    ] = None,
    frame_rate: Annotated[
        float | None,
        typer.Option(
            "--frame-rate",
            metavar="HZ",
            help="csv: the column of times counts frames (or is called frame, or is missing), at this rate.",
            show_default=False,
        ),
    ] = None,
    euler: Annotated[
        str | None,
        typer.Option(
            "--euler",
            metavar="ORDER",
            help="csv: read roll, pitch, yaw (angles about x, y, z); their turns, first to last, about fixed axes "
            "(xyz: roll, pitch, yaw of robots) or about the body's (XYZ).",
            show_default=False,
        ),
    ] = None,
    angle_unit: Annotated[
        Literal["deg", "rad"] | None,
        typer.Option("--angle-unit", help="csv: unit of these angles, if the names do not say it.", show_default=False),
    ] = None,
    spin_frame: Annotated[
        Literal["world", "body"] | None,
        typer.Option("--spin-frame", help="csv: axes of measured angular velocities beside orientations."),
    ] = None,
    body: Annotated[
        str | None, typer.Option("--body", help="Name of the body, if the data have none.", show_default=False)
    ] = None,
    up: Annotated[
        Literal["z", "y"] | None, typer.Option("--up", help="The axis that points up (z).", show_default=False)
    ] = None,
    topic: Annotated[
        str | None,
        typer.Option("--topic", help="rosbag: topic of the poses; for transforms /tf:CHILD_FRAME.", show_default=False),
    ] = None,
    photos: Annotated[
        int | None,
        typer.Option(
            "--photos", min=3, help="video, record3d, arkit, realsense: most photos to take (60).", show_default=False
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Convert recordings in another format to a capture."""
    given = {"train": train, "test": test, "seed": seed, "only": only, "columns": columns, "body": body, "up": up}
    given |= {"length_unit": length_unit, "time_unit": time_unit, "topic": topic, "spin_frame": spin_frame}
    given |= {"photos": photos, "frame_rate": frame_rate, "euler": euler, "angle_unit": angle_unit}
    words = {name: value for name, value in given.items() if value is not None}
    refuse_foreign(words, _OPTIONS[format_], format_, "omit it.")
    emit(_imported(format_, source, out, words, overwrite), _summary)


def _imported(format_: str, source: Path, out: Path, given: dict[str, Any], overwrite: bool) -> ImportResult:
    """Import with the given options and the importer's defaults for all others."""
    from .. import datasets

    renamed = {"train": "n_train", "test": "n_test", "frame_rate": "frame_rate_hz"}
    units = ("length_unit", "time_unit")
    words = {renamed.get(name, name): value for name, value in given.items() if name not in units}
    if "columns" in words:
        words["columns"] = _named(words["columns"])
    if "length_unit" in _OPTIONS[format_]:
        words["units"] = datasets.Units(given.get("length_unit"), given.get("time_unit"))
    return getattr(datasets, f"import_{format_}")(source, out, **words, overwrite=overwrite)


def _named(text: str) -> dict[str, str]:
    """Parse the value of `--columns` into names by key."""
    from ..schemas import UsageError

    named = {}
    for part in text.split(","):
        key, sign, name = part.partition("=")
        if not (sign and key.strip() and name.strip()):
            raise UsageError(f"--columns: '{part}' is not KEY=NAME.", "KEY=NAME,KEY=NAME.", "for example time=t,px=X.")
        named[key.strip()] = name.strip()
    return named


def _summary(result: ImportResult) -> str:
    from ..schemas.printable import typed_path
    from .output import warnings

    if result.photos and not result.episodes:
        cameras = "with their cameras" if result.posed else f"(next: cgwm calibrate {typed_path(result.capture)})"
        return "\n".join([f"Wrote {result.capture}: {result.photos} photos {cameras}.", *warnings(result.warnings)])
    splits = ", ".join(f"{name} {count}" for name, count in result.splits.items())
    wrote = f"Wrote {result.capture}: {result.episodes} episodes ({splits}) with {result.samples} poses."
    return "\n".join([wrote, *warnings(result.warnings), *_next(Path(result.capture))])


def _next(capture: Path) -> list[str]:
    """Return what to do with a capture of motions: give its bodies shapes, or fit it; empty where it is elsewhere."""
    from ..schemas import CaptureManifest
    from ..schemas.base import read_toml
    from ..schemas.printable import typed_path

    manifest = capture / "capture.toml"
    if not manifest.is_file():
        return []
    fit = f"cgwm fit {typed_path(str(capture))} --out MODEL"
    lacking = [f"'{body.name}'" for body in read_toml(manifest, CaptureManifest).bodies if body.shape is None]
    if not lacking or (capture / "masks").is_dir():
        return [f"Next: {fit}"]
    return [
        f"Next: give {' and '.join(lacking)} a shape in {manifest}, below the name, for example "
        f"shape = {{ sphere = {{ radius_m = 0.02 }} }}; then {fit}"
    ]

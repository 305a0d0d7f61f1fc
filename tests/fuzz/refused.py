"""What has to be refused: captures, cameras, importers, and outputs that would destroy inputs."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from .edits import FIT, Columns, Edit, Row, field, kind_of, nothing, rolled, scaled, text, tracks, written

VALIDATE = ("validate", "capture")
MANIFEST = "capture/capture.toml"
DEEP = "[" * 100_000 + "]" * 100_000
DIGITS = "9" * 5000
HALF = np.sqrt(0.5)


def rows() -> Iterator[Row]:
    """Yield the tables."""
    yield from _both("captures", "tosses", PHYSICS)
    yield from _both("captures", "tosses", EPISODES)
    for name, edit in MANIFESTS:
        yield Row(name, "captures", "tosses", edit, VALIDATE)
    for name, edit in PHOTOS:
        yield Row(name, "cameras", "cameras.json", edit, VALIDATE)
    yield Row("a mesh that is a sheet", "captures", "shapes", _sheet, ("validate", "obj"))
    for name, subject, words, edit in IMPORTS:
        yield Row(f"import {name}", "importers", subject, edit, ("import", *words.split(), "--out", "OUT"))
    for words in OVERWRITES:
        yield Row(words, "outputs", "things", nothing, tuple(words.split()))


def _sheet(root: Path) -> None:
    """Make the box of a capture 0.1 um thick."""
    path = root / "obj" / "box.obj"
    lines = [line.split() for line in path.read_text().splitlines()]
    flat = [[*words[:3], repr(float(words[3]) * 1e-6)] if words[:1] == ["v"] else words for words in lines]
    path.write_text("\n".join(map(" ".join, flat)) + "\n")


def _both(kind: str, subject: str, table: tuple[tuple[str, Edit], ...]) -> Iterator[Row]:
    for name, edit in table:
        yield Row(f"{name}: validate", kind, subject, edit, VALIDATE)
        yield Row(f"{name}: fit", kind, subject, edit, FIT)


def _y_up(columns: Columns) -> None:
    y, z = columns["py_m"], columns["pz_m"]
    columns["py_m"], columns["pz_m"] = -z, y
    w, x, yy, zz = (columns[key].copy() for key in ("qw", "qx", "qy", "qz"))
    columns["qw"], columns["qx"] = HALF * (w + x), HALF * (x - w)
    columns["qy"], columns["qz"] = HALF * (yy - zz), HALF * (yy + zz)


def _shifted(name: str, by: float) -> Edit:
    def change(columns: Columns) -> None:
        columns[name] = columns[name] + by

    return tracks(change)


POSITION = "px_m py_m pz_m"
PHYSICS: tuple[tuple[str, Edit], ...] = (
    ("gravity up", field(MANIFEST, "world gravity_m_s2", "[0.0, 0.0, 9.81]")),
    ("gravity of -981", field(MANIFEST, "world gravity_m_s2", "[0.0, 0.0, -981.0]")),
    ("gravity in mm/s2", field(MANIFEST, "world gravity_m_s2", "[0.0, 0.0, -9810.0]")),
    ("gravity along y", field(MANIFEST, "world gravity_m_s2", "[0.0, -9.81, 0.0]")),
    ("times in ms", tracks(scaled("time_s", 1000))),
    ("times at twice the frame rate", tracks(scaled("time_s", 0.5))),
    ("times at half the frame rate", tracks(scaled("time_s", 2))),
    ("tracks in mm", tracks(scaled(POSITION, 1000))),
    ("tracks in cm", tracks(scaled(POSITION, 100))),
    ("tracks with y up", tracks(_y_up)),
    ("mirrored z", tracks(scaled("pz_m", -1))),
    ("quaternions x y z w under this header", tracks(rolled("qw qx qy qz", "qx qy qz qw"))),
    ("3 m below the ground", _shifted("pz_m", -3.0)),
    ("ground above the body", field(MANIFEST, "world ground", "{ normal = [0.0, 0.0, 1.0], offset_m = 3.0 }")),
    ("ground's normal down", field(MANIFEST, "world ground", "{ normal = [0.0, 0.0, -1.0], offset_m = 0.0 }")),
    ("ground's normal sideways", field(MANIFEST, "world ground", "{ normal = [1.0, 0.0, 0.0], offset_m = 0.0 }")),
    ("a box of 50 m", field(MANIFEST, "bodies 0 shape", "{ box = { half_extents_m = [50.0, 50.0, 50.0] } }")),
    ("a box in mm", field(MANIFEST, "bodies 0 shape", "{ box = { half_extents_m = [50, 50, 50] } }")),
)
"""Mistakes of units and axes, which one named mistake explains far better than the file as written."""

_T = "capture/tracks/001.csv"
EPISODES: tuple[tuple[str, Edit], ...] = (
    ("a track that is a broken link", kind_of(_T, "nowhere.csv")),
    ("a track that is a link to itself", kind_of(_T, "itself")),
    ("a track that is a folder", kind_of(_T, "directory")),
    ("a track that is a named pipe", kind_of(_T, "fifo")),
    ("a track that is a device", kind_of(_T, "/dev/zero")),
    ("a track that is listed and is not there", kind_of(_T, "removed")),
    ("a track that is empty", written(_T, "")),
)


def _body(name: str, raw: str) -> tuple[str, Edit]:
    return f"{name} = {raw[:30]}", field(MANIFEST, f"bodies 0 {name}", raw)


MANIFESTS: tuple[tuple[str, Edit], ...] = (
    _body("mass_kg", "true"),
    _body("mass_kg", '"0.37"'),
    _body("mass_kg", "0.0"),
    _body("mass_kg", "-1.0"),
    _body("mass_kg", "nan"),
    _body("mass_kg", "inf"),
    _body("mass_kg", "1e30"),
    _body("mass_kg", DIGITS),
    _body("inertia_kg_m2", "[1.0, 1.0]"),
    _body("inertia_kg_m2", "[1.0, 1.0, 5.0]"),
    _body("inertia_kg_m2", "[0.0, 0.0, 0.0]"),
    _body("com_m", "[5.0, 0.0, 0.0]"),
    _body("com_m", DEEP),
    _body("name", '"cu\\u001bbe"'),
    _body("name", '"../cube"'),
    _body("motion", '"flying"'),
    _body("shape", '{ mesh = { path = "/etc/passwd" } }'),
    _body("shape", '{ mesh = { path = "../model/model.json" } }'),
    _body("shape", '{ mesh = { path = "/dev/zero" } }'),
    _body("shape", "{ sphere = { radius_m = 0.0 } }"),
    _body("shape", "{ box = { half_extents_m = [true, true, true] } }"),
    ("gravity as texts", field(MANIFEST, "world gravity_m_s2", '["0", "0", "-9.81"]')),
    ("gravity of zeros and true", field(MANIFEST, "world gravity_m_s2", "[false, false, true]")),
    ("normal of length 2", field(MANIFEST, "world ground", "{ normal = [0.0, 0.0, 2.0], offset_m = 0.0 }")),
    ("position_std_m negative", field(MANIFEST, "measurement position_std_m", "-0.001")),
    ("position_std_m zero", field(MANIFEST, "measurement position_std_m", "0.0")),
    ("a split that names no episode", field(MANIFEST, "splits train", '["000", "nowhere"]')),
    ("a split that names an episode twice", field(MANIFEST, "splits train", '["000", "000"]')),
    ("an episode in train and test", field(MANIFEST, "splits test", '["000"]')),
    ("an episode outside", field(MANIFEST, "splits train", '["../../etc/passwd"]')),
    ("facts about no episode", field(MANIFEST, "episodes", '{ nowhere = { group = "a" } }')),
    ("a frame rate of 0", field(MANIFEST, "video", "{ frame_rate_hz = 0.0 }")),
    ("a key twice", text(MANIFEST, "[world]", "[world]\ngravity_m_s2 = [0.0, 0.0, -9.81]")),
    ("another format", text(MANIFEST, "cgwm-capture/1", "cgwm-capture/9")),
    ("no TOML", written(MANIFEST, b"\x00\xff\xfe")),
    ("a manifest that is a named pipe", kind_of(MANIFEST, "fifo")),
    ("a manifest that is a device", kind_of(MANIFEST, "/dev/zero")),
    ("nested tables without end", written(MANIFEST, 'format = "cgwm-capture/1"\nx = ' + DEEP)),
    ("a time that is no number", text(_T, "\n0.01,", "\nsoon,")),
    ("a time twice", text(_T, "\n0.01,", "\n0.0,")),
    ("a time that is infinite", text(_T, "\n0.01,", "\ninf,")),
    ("a body that is unknown", text(_T, ",box,", ",mug,")),
    ("a body with control characters", text(_T, ",box,", ",\x1b[31mbox,")),
    ("quaternions of norm 2", tracks(scaled("qw qx qy qz", 2))),
    ("quaternions of zeros", tracks(scaled("qw qx qy qz", 0))),
    ("a header without z", text(_T, "pz_m", "pz")),
    ("a header twice", text(_T, "py_m", "px_m")),
)

_C = "capture/cameras.json"
PHOTOS: tuple[tuple[str, Edit], ...] = (
    *(
        (f"fx = {raw[:20]}", field(_C, "cameras c fx", raw))
        for raw in ("0.0", "-70.0", "NaN", "1e400", '"70"', "true", DIGITS)
    ),
    ("width = 0", field(_C, "cameras c width", "0")),
    ("width of another picture", field(_C, "cameras c width", "640")),
    ("a principal point far outside of the picture", field(_C, "cameras c cx", "1e9")),
    ("a pose of zeros", field(_C, "images walk/0.png T_world_cam", str([[0.0] * 4] * 4))),
    ("a scale twice", text(_C, '"scale":', '"scale": {"kind": "unscaled"},\n "scale":')),
    ("deep nesting", field(_C, "cameras", DEEP)),
    ("null cameras", field(_C, "cameras", "null")),
    ("a mask of another size", lambda root: _picture(root / "capture/masks/walk/0.png", 32, 24)),
    ("a mask with a label of no body", lambda root: _picture(root / "capture/masks/walk/0.png", 64, 48, 9)),
    ("a photo of another size", lambda root: _picture(root / "capture/images/walk/0.png", 32, 24)),
    ("a photo that is a device", kind_of("capture/images/walk/0.png", "/dev/zero")),
    ("a photo that is a text", written("capture/images/walk/0.png", "a picture")),
    ("a photo_box upside down", text(MANIFEST, "min_m = [-0.08, -0.08, 0.0]", "min_m = [-0.08, -0.08, 0.5]")),
)


def _picture(path: Path, width: int, height: int, value: int = 1) -> None:
    from PIL import Image

    Image.new("L", (width, height), value).save(path)


def _poses(change: dict[str, np.ndarray]) -> Edit:
    def edit(root: Path) -> None:
        with h5py.File(root / "poses.h5", "r+") as file:
            for name, value in change.items():
                del file["data/demo_0"][name]
                file["data/demo_0"][name] = value

    return edit


def _linked(root: Path) -> None:
    with h5py.File(root / "poses.h5", "r+") as file:
        del file["data/demo_1"]
        file["data/demo_1"] = h5py.ExternalLink("nowhere.h5", "/data/demo_1")


def _vast(root: Path) -> None:
    with h5py.File(root / "poses.h5", "r+") as file:
        for name, shape in (("time", ()), ("position", (3,)), ("quat_wxyz", (4,))):
            del file["data/demo_0"][name]
            file["data/demo_0"].create_dataset(name, (10**12, *shape), "f8", chunks=(1 << 14, *shape))


_LINE = "\n0.020000,"
_PUSH = "pushes/dataset/push_a/dynamic_train0.json"
_PINWM = ("pinwm", "pinwm pushes --train 4")
_THROWS = ("jugglebot", "jugglebot throws --only b")
_DROPS = ("balldrops", "balldrops drops")
_ELBOW = ("elbow", "elbow elbow")
_URDF = "elbow/elbow.urdf"
_SCENE = "scene/transforms.json"
_ODOMETRY, _MATRIX = "scan/odometry.csv", "scan/camera_matrix.csv"
_NO_POSE = "1, 0, " + "0, " * 7 + "\n2, 9, "
_HEIC = b"\0\0\0\x18ftypheic" + bytes(40)
_ARCHIVE = b"PK\x03\x04" + bytes(60)
_SCAN = "scan/keyframes/cameras/100.json"
_NO_TURN = '"poses": [[0, 0, 0, 0, 1, 1, 1], ['
_NET = "contactnets tosses --train 2 --test 1"
IMPORTS: tuple[tuple[str, str, str, Edit], ...] = (
    ("csv: times in ms", "csv", "csv csv", lambda root: _csv(root, "t", 1000)),
    ("csv: positions in mm", "csv", "csv csv", lambda root: _csv(root, "xyz", 1000)),
    ("csv: norm 2", "csv", "csv csv", lambda root: _csv(root, ("qw", "qx", "qy", "qz"), 2)),
    ("csv: a time that is no number", "csv", "csv csv", text("csv/a.csv", _LINE, "\nsoon,")),
    ("csv: a time of 5000 digits", "csv", "csv csv", text("csv/a.csv", _LINE, f"\n{DIGITS},")),
    ("csv: a spin of two parts", "csv", "csv csv", text("csv/a.csv", "qw,qx,qy,qz", "wx,wy,a,b")),
    ("csv: a rate of frames of 0", "csv", "csv csv --frame-rate 0", lambda _: None),
    ("csv: an order of one axis", "csv", "csv csv --euler xxx", lambda _: None),
    ("csv: angles without a unit", "csv", "csv csv --euler xyz", text("csv/a.csv", "qw,qx,qy,qz", "a,roll,pitch,yaw")),
    ("csv: a time twice", "csv", "csv csv", text("csv/a.csv", _LINE, "\n0.0,")),
    ("csv: a broken link", "csv", "csv csv", kind_of("csv/b.csv", "nowhere")),
    ("csv: a named pipe", "csv", "csv csv", kind_of("csv/b.csv", "fifo")),
    ("csv: a device", "csv", "csv csv", kind_of("csv/b.csv", "/dev/zero")),
    ("csv: a folder", "csv", "csv csv", kind_of("csv/b.csv", "directory")),
    ("csv: a body called ../up", "csv of bodies", "csv two.csv", text("two.csv", ",cup,", ",../up,")),
    ("csv: a body with control characters", "csv of bodies", "csv two.csv", text("two.csv", ",cup,", ",\x1b[31mcup,")),
    ("csv: binary", "csv of bodies", "csv two.csv", written("two.csv", bytes(range(256)))),
    ("tum: a row too short", "tum", "tum poses.txt", text("poses.txt", "\n0.020000 ", "\n0.02 1 2\n0.03 ")),
    ("tum: a device", "tum", "tum poses.txt", kind_of("poses.txt", "/dev/zero")),
    ("hdf5: lengths that differ", "hdf5", "hdf5 poses.h5", _poses({"time": np.arange(5) / 50})),
    ("hdf5: two columns", "hdf5", "hdf5 poses.h5", _poses({"position": np.zeros((26, 2))})),
    ("hdf5: no numbers", "hdf5", "hdf5 poses.h5", _poses({"time": np.array([b"a"] * 26)})),
    ("hdf5: quaternions of zeros", "hdf5", "hdf5 poses.h5", _poses({"quat_wxyz": np.zeros((26, 4))})),
    ("hdf5: times that fall", "hdf5", "hdf5 poses.h5", _poses({"time": -np.arange(26) / 50})),
    ("hdf5: times in ms", "hdf5", "hdf5 poses.h5", _poses({"time": np.arange(26) * 20.0})),
    ("hdf5: a dangling external link", "hdf5", "hdf5 poses.h5", _linked),
    ("hdf5: 10^12 zeros", "hdf5", "hdf5 poses.h5", _vast),
    ("hdf5: a text", "hdf5", "hdf5 poses.h5", written("poses.h5", "poses")),
    ("hdf5: a named pipe", "hdf5", "hdf5 poses.h5", kind_of("poses.h5", "fifo")),
    ("rosbag: no metadata", "rosbag", "rosbag bag", kind_of("bag/metadata.yaml", "removed")),
    ("rosbag: no YAML", "rosbag", "rosbag bag", written("bag/metadata.yaml", "[" * 5000)),
    ("rosbag: a device", "rosbag", "rosbag bag", kind_of("bag/metadata.yaml", "/dev/zero")),
    ("pinwm: a time of text", *_PINWM, text(_PUSH, '"time": 0.0', '"time": "0"')),
    ("pinwm: a pose of zeros", *_PINWM, text(_PUSH, "[[1, 0, 0, 0.1]", "[[0, 0, 0, 0.1]")),
    ("pinwm: K of zero", *_PINWM, text(_PUSH, '"intrinsic": [[50,', '"intrinsic": [[0,')),
    ("pinwm: no mesh", *_PINWM, kind_of("pushes/envs/asset/cube_t/it.obj", "removed")),
    ("jugglebot: a frequency of 0", *_THROWS, text("throws/b.json", "300.0", "0.0")),
    ("jugglebot: a frequency that is negative", *_THROWS, text("throws/b.json", "300.0", "-300.0")),
    ("jugglebot: a key twice", *_THROWS, text("throws/b.json", '{"Frequency"', '{"Frequency": 1.0, "Frequency"')),
    ("jugglebot: deep nesting", *_THROWS, written("throws/b.json", DEEP)),
    ("balldrops: a height of text", *_DROPS, text("drops/ball_drops.csv", ",48.0,", ",high,")),
    ("balldrops: a time twice", *_DROPS, text("drops/ball_drops.csv", "0.06666666666666667", "0.0")),
    ("contactnets: pickled objects", "contactnets npz", _NET, lambda root: _pickled(root / "tosses/a.npz")),
    ("elbow: a pickle as .pt", *_ELBOW, written("elbow/tosses/0.pt", pickle.dumps({"a": 1}))),
    ("elbow: a mimic joint", *_ELBOW, text(_URDF, "</joint>", '<mimic joint="a"/></joint>')),
    ("elbow: a loop", *_ELBOW, text(_URDF, '<child link="lower"/>', '<child link="upper"/>')),
    ("elbow: no XML", *_ELBOW, written(_URDF, "<robot>")),
    ("photos: a photo cut off", "phone photos", "photos photos", written("photos/a.jpg", b"\xff\xd8\xff")),
    ("photos: a text as HEIC", "phone photos", "photos photos", written("photos/c.heic", b"heic")),
    ("photos: a named pipe", "phone photos", "photos photos", kind_of("photos/b.png", "fifo")),
    ("photos: each as HEIC and as JPEG", "phone photos", "photos photos", written("photos/a.heic", _HEIC)),
    ("photos: HEIC as PNG", "phone photos", "photos photos", written("photos/b.png", _HEIC)),
    ("photos: an archive", "phone photos", "photos photos.zip", written("photos.zip", _ARCHIVE)),
    ("video: a device", "walk", "video walk.mp4", kind_of("walk.mp4", "/dev/zero")),
    ("video: a playlist", "walk", "video walk.mp4", written("walk.mp4", b"#EXTM3U\n/etc/passwd\n")),
    ("nerfstudio: no pose", "nerfstudio", "nerfstudio scene", text(_SCENE, '"transform_matrix"', '"matrix"')),
    ("nerfstudio: deep nesting", "nerfstudio", "nerfstudio scene", written(_SCENE, DEEP)),
    ("nerfstudio: an archive", "nerfstudio", "nerfstudio scene.zip", written("scene.zip", _ARCHIVE)),
    ("nerfstudio: photos of another size", "nerfstudio", "nerfstudio scene", text(_SCENE, '"w": 64', '"w": 128')),
    ("colmap: a camera that is not there", "colmap", "colmap scene", text("scene/sparse/0/cameras.txt", "1 S", "2 S")),
    ("polycam: a focal length of 0", "polycam", "polycam scan", text(_SCAN, '"fx": 60.0', '"fx": 0')),
    ("polycam: a pose of zeros", "polycam", "polycam scan", text(_SCAN, '"t_00": ', '"t_00": 9')),
    ("polycam: an archive", "polycam", "polycam scan.zip", written("scan.zip", _ARCHIVE)),
    ("polycam: a recording of another", "record3d", "polycam scan", nothing),
    ("record3d: an archive", "record3d", "record3d scan.r3d", written("scan.r3d", _ARCHIVE)),
    ("record3d: a scan of another", "polycam", "record3d scan", nothing),
    ("record3d: a quaternion of zeros", "record3d", "record3d scan", text("scan/metadata", '"poses": [[', _NO_TURN)),
    ("record3d: K of text", "record3d", "record3d scan", text("scan/metadata", '"K": [60.0', '"K": ["60"')),
    ("arkit: a quaternion of zeros", "stray", "arkit scan", text(_ODOMETRY, "100.0, 000000, ", _NO_POSE)),
    ("arkit: a focal length of 0", "stray", "arkit scan", text(_MATRIX, "150.0, 0.0, 80.0", "0, 0, 80")),
    ("arkit: no numbers in a .traj", "arkitscenes", "arkit scan", text("scan/lowres_wide.traj", "10.0004", "x")),
    ("contactnets: a pickle as .pt", "contactnets pt", _NET, lambda root: _pickled(root / "tosses/0.pt")),
)  # fmt: skip


def _csv(root: Path, names: str | tuple[str, ...], factor: float) -> None:
    for path in (root / "csv").glob("*.csv"):
        rows = [line.split(",") for line in path.read_text().splitlines()]
        for k, name in enumerate(rows[0]):
            if name in tuple(names):
                for row in rows[1:]:
                    row[k] = repr(float(row[k]) * factor)
        path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def _pickled(path: Path) -> None:
    from .mutations import apply

    apply(path.parents[1], {"op": "array", "file": f"tosses/{path.name}", "name": "pos", "what": "pickled"})


OVERWRITES = (
    "fit capture --out capture --stage phys-geo --overwrite",
    "fit data/capture --out data --stage phys-geo --overwrite",
    "fit capture --out capture/tracks --stage phys-geo --overwrite",
    "fit capture --out docs --stage phys-geo --overwrite",
    "fit capture --out model --from model --effects nothing --overwrite",
    "improve capture --out capture --overwrite",
    "improve capture --out docs --overwrite",
    "improve capture --from model --out model --overwrite",
    "improve capture --out capture/tracks/ladder --overwrite",
    "synthesize model --out model --rollouts 1 --overwrite",
    "synthesize model --out docs --rollouts 1 --overwrite",
    "synthesize model --out capture --rollouts 1 --overwrite",
    "import csv csv --out csv --overwrite",
    "import csv csv/a.csv --out csv --overwrite",
    "import csv capture/tracks --out capture --overwrite",
    "import hdf5 poses.h5 --out poses.h5 --overwrite",
    "import csv csv --out docs --overwrite",
    "compare model capture --out capture/capture.toml --overwrite",
    "compare model capture --out notes.html --overwrite",
    "compare model capture --out model/model.json --overwrite",
    "merge dataset --out dataset/rollouts-0000-of-0001.h5 --overwrite",
    "merge dataset --out dataset/dataset.json --overwrite",
    "merge dataset --out poses.h5 --overwrite",
    "export model --to ply --out model --overwrite",
    "export model --to glb --out notes.html --overwrite",
    "export model --to mjcf --out model/model.json --overwrite",
    "export dataset --to bop --out dataset --overwrite",
    "export dataset --to nerfstudio --out docs --overwrite",
    "export dataset --to lerobot --out capture --overwrite",
    "diagnose model capture --split look --page notes.html --overwrite",
    "diagnose model capture --split look --page model/model.json --overwrite",
    "diagnose model capture --split look --page capture/capture.toml --overwrite",
    "diagnose model capture --split look --save-law model/model.json --overwrite",
    "effects new notes.html --overwrite",
)
"""Commands that would replace an input, or what is not their own."""

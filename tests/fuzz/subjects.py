"""Valid inputs of every kind, small, and the commands that read them."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

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


MANIFEST = """format = "cgwm-capture/1"
[world]
gravity_m_s2 = [0.0, 0.0, -9.81]
ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }
[[bodies]]
name = "cube"
motion = "free"
mass_kg = 0.37
inertia_kg_m2 = [0.000617, 0.000617, 0.000617]
com_m = [0.0, 0.0, 0.0]
shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }
photo_pose = { position_m = [0.0, 0.0, 0.05], quat_wxyz = [1.0, 0.0, 0.0, 0.0] }
[measurement]
position_std_m = 0.0005
rotation_std_rad = 0.002
[splits]
train = ["000", "001"]
test = ["002"]
look = ["000", "001", "002"]
[episodes]
"001" = { group = "a", start_s = 0.0, end_s = 10.0 }
[video]
frame_rate_hz = 30.0
"""


def tracks(root: Path) -> None:
    """Write a capture of three throws of a cube, and a model of it."""
    from cgwm.datasets.capture.tracks import write_tracks
    from cgwm.datasets.models.model import write_model
    from thrown_cube import measured, thrown, truth

    capture = root / "capture"
    (capture / "tracks").mkdir(parents=True)
    (capture / "capture.toml").write_text(MANIFEST)
    for seed, name in enumerate(("000", "001", "002")):
        write_tracks(capture / "tracks" / f"{name}.csv", {"cube": measured(*thrown(seed), seed)})
    write_model(root / "model", truth())


def throws(root: Path) -> None:
    """Write the capture and model of `tracks`, and throws to choose from."""
    tracks(root)
    (root / "throws.toml").write_text(
        "[[throws]]\nspeed_m_s = [1.0, 3.0]\nelevation_deg = [0.0]\nheight_m = [0.5]\nspin_rad_s = [0.0]\n"
        'spin_axis = ["up"]\nduration_s = 0.4\n[[throws]]\non_ground = true\nspeed_m_s = [0.5]\nheading_deg = [0.0]\n'
    )


def settings(root: Path) -> None:
    """Write a capture, a model, and settings of all stages, a file for each verb."""
    photographed(root)
    (root / "photos").mkdir()
    (root / "capture").rename(root / "photos" / "capture")
    shutil.rmtree(root / "model")
    tracks(root)
    (root / "fit.toml").write_text(
        "[phys-geo]\nseed = 0\nstep_s = 0.003\npopulation = 8\ngenerations = 2\niterations = 1\nwarmup_s = 0.1\n"
        'image_size = 320\ngeometry = true\nsupervise = "tracks"\neffects = []\nmass_distribution = false\n'
        "[sg-gs]\niterations = 2\nimage_size = 32\nturntable = false\nmax_body_spheres = 40\n"
        "max_scene_spheres = 40\nmax_collision_spheres = 20\ntest_every = 2\nradius_factor = 2.0\n"
    )
    (root / "synthesize.toml").write_text(
        "[synthesize]\nseed = 0\nrollouts = 1\nduration_s = 0.1\nframe_rate_hz = 30.0\nwidth = 20\nheight = 16\n"
        'compression = "gzip"\nbatch = 1\nshard = 0\nshards = 1\n'
    )


def plan(root: Path) -> None:
    """Write a model and a sampling plan that has every kind of entry."""
    model(root)
    (root / "plan.toml").write_text(
        "height_m = [0.02, 0.15]\nhorizontal_speed_m_s = [0.0, 1.0]\nview_elevation_deg = { normal = [35.0, 5.0] }\n"
        "view_azimuth_deg = [0.0, 180.0]\nview_shift_deg = [-20.0, 20.0]\nlight_gain = [0.7, 1.2]\n"
        "exposure_gain = { log_uniform = [0.8, 1.25] }\nspin_rad_s = { choice = [0.0, 1.0] }\nparameter_spread = 2.0\n"
        '[reject]\nattempts = 20\noff_table_m = 5.0\n[parameters]\n"cube.mass_kg" = { choice = [0.2, 0.4] }\n'
    )


def photographed(root: Path) -> None:
    """Write a capture of a cube in six photos with masks and cameras, and a model of it."""
    from cgwm.datasets.capture.cameras import to_intrinsics
    from cgwm.datasets.capture.images import write_image
    from cgwm.datasets.models.model import write_model
    from cgwm.pipeline.rendering.label_renderer import LabelRenderer
    from cgwm.schemas import CamerasFile, PosedImage, Scale
    from small_model import HALF
    from tiny_capture import camera, tiny_model

    capture = root / "capture"
    views = {f"walk/{k}.png": camera(60.0 * k) for k in range(6)}
    pose = (np.array([[[0.0, 0.0, HALF]]]), np.array([[[1.0, 0.0, 0.0, 0.0]]]))
    for name, view in views.items():
        (block,) = LabelRenderer(tiny_model(), {"one": view}).blocks(*pose)
        for folder, picture in (("images", block.image[0]), ("masks", block.mask[0])):
            path = capture / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if folder == "images":
                path = path.with_suffix(".jpg" if name.endswith("1.png") else ".png")
            write_image(path, np.asarray(picture).astype(np.uint8))
    names = sorted(p.relative_to(capture / "images").as_posix() for p in (capture / "images").rglob("*.*"))
    poses = {n: tuple(map(tuple, views[n.replace(".jpg", ".png")].T_world_cam.tolist())) for n in names}
    file = CamerasFile(
        scale=Scale(kind="metric", source="known", relative_std=0.01),
        cameras={"c": to_intrinsics(views["walk/0.png"])},
        images={name: PosedImage(camera="c", T_world_cam=pose) for name, pose in poses.items()},  # pyright: ignore
    )
    (capture / "cameras.json").write_text(json.dumps(json.loads(file.model_dump_json()), indent=1))
    (capture / "capture.toml").write_text(
        'format = "cgwm-capture/1"\n[world]\nground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }\n'
        f'[[bodies]]\nname = "cube"\nmass_kg = 0.37\nphoto_pose = {{ position_m = [0.0, 0.0, {HALF}] }}\n'
        "photo_box = { min_m = [-0.08, -0.08, 0.0], max_m = [0.08, 0.08, 0.12] }\n"
    )
    write_model(root / "model", tiny_model())


def with_transforms(root: Path) -> None:
    """Write the photos with cameras in nerfstudio's file."""
    photographed(root)
    file = json.loads((root / "capture" / "cameras.json").read_text())
    k = file["cameras"]["c"]
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"./images/{name}", "transform_matrix": (np.array(entry["T_world_cam"]) @ flip).tolist()}
        for name, entry in file["images"].items()
    ]
    sizes = {"fl_x": k["fx"], "fl_y": k["fy"], "cx": k["cx"], "cy": k["cy"], "w": k["width"], "h": k["height"]}
    text = json.dumps({**sizes, "k1": 0.0, "k2": 0.0, "camera_model": "OPENCV", "frames": frames}, indent=1)
    (root / "capture" / "transforms.json").write_text(text)
    (root / "capture" / "cameras.json").unlink()
    manifest = root / "capture" / "capture.toml"
    manifest.write_text(manifest.read_text() + "[calibration]\nsupplied_in_metres = true\n")


def with_colmap(root: Path, binary: bool = False) -> None:
    """Write the photos with cameras in COLMAP's files."""
    photographed(root)
    capture = root / "capture"
    file = json.loads((capture / "cameras.json").read_text())
    (capture / "cameras.json").unlink()
    manifest = capture / "capture.toml"
    manifest.write_text(manifest.read_text() + "[calibration]\nsupplied_in_metres = true\n")
    k = file["cameras"]["c"]
    lens = (k["fx"], k["fy"], k["cx"], k["cy"], 0.01, 0.0, 0.0, 0.0)
    rows = []
    for name, entry in file["images"].items():
        T = np.linalg.inv(np.array(entry["T_world_cam"]))
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        rows.append((name, (w, x, y, z, *T[:3, 3])))
    folder = capture / ("colmap" if binary else "sparse/0")
    folder.mkdir(parents=True)
    if binary:
        (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 7, 4, k["width"], k["height"], *lens))
        data = struct.pack("<Q", len(rows))
        for number, (name, pose) in enumerate(rows, 1):
            data += struct.pack("<i7di", number, *pose, 7) + name.encode() + b"\0" + struct.pack("<Qddq", 1, 1, 2, -1)
        (folder / "images.bin").write_bytes(data)
        return
    (folder / "cameras.txt").write_text(f"# c\n7 OPENCV {k['width']} {k['height']} {' '.join(map(repr, lens))}\n")
    lines = [
        f"{n} {' '.join(repr(float(v)) for v in pose)} 7 {name}\n1 2 -1\n" for n, (name, pose) in enumerate(rows, 1)
    ]
    (folder / "images.txt").write_text("# c\n" + "".join(lines))


def filmed(root: Path) -> None:
    """Write a capture of a cube that two cameras film, with masks, and a model to fit from."""
    from tiny_capture import thrown, with_tracks, write_tiny_capture

    write_tiny_capture(root / "capture")
    with_tracks(root / "capture", thrown())
    (root / "capture-model").rename(root / "model")


def video_file(root: Path) -> None:
    """Write the capture of `filmed` with one camera whose frames are in one file."""
    from cgwm.datasets.capture.images import read_rgb

    filmed(root)
    import cv2

    folder = root / "capture" / "videos" / "left" / "000"
    pictures = [read_rgb(path) for path in sorted(folder.iterdir())]
    shutil.rmtree(folder)
    writer = cv2.VideoWriter(str(folder.with_suffix(".mp4")), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 48))
    for picture in pictures:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()


def shaped(root: Path) -> None:
    """Write captures whose bodies have their shape in files: .obj, .stl and .ply."""
    import test_meshes
    from cgwm.datasets.shapes.ply import write_splats
    from small_model import collision_splats

    tracks(root)
    capture = root / "capture"
    box = test_meshes.box((0.05, 0.05, 0.05))
    (capture / "box.obj").write_text(test_meshes.obj_text(box))
    (capture / "box.stl").write_bytes(test_meshes.stl_binary(box))
    write_splats(capture / "box.ply", collision_splats(2))
    shapes = {"obj": "mesh", "stl": "mesh", "ply": "splats"}
    text = MANIFEST.replace(
        "shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }", 'shape = { KIND = { path = "box.EXT" } }'
    )
    for extension, kind in shapes.items():
        shutil.copytree(capture, root / extension)
        (root / extension / "capture.toml").write_text(text.replace("KIND", kind).replace("EXT", extension))
    shutil.rmtree(capture)


def model(root: Path) -> None:
    """Write a model with two bodies, an effect, correlations, a light and an exposure."""
    from cgwm.datasets.models.model import write_model
    from cgwm.schemas import Correlation, EffectModel, Exposure, Light, Solver
    from small_model import small_model, table_splats

    made = small_model(driven=True)
    change = {
        "effects": (EffectModel(name="quadratic_drag", parameters={"k": 0.001}),),
        "correlations": (Correlation(parameters=("friction", "damping_ratio"), matrix=((1.0, -0.5), (-0.5, 1.0))),),
        "exposures": {"left": Exposure(gain_rgb=(0.8, 0.9, 0.95))},
        "light": Light(lamp=(0.0, 0.0, 0.5), sky=0.1),
        "solver": Solver(step_s=0.004, sweeps=2),
    }
    known = {name: value for name, value in change.items() if name in type(made.file).model_fields}
    write_model(root / "model", replace(made, file=made.file.model_copy(update=known), scene=table_splats(8)))


CANARY = "CANARY"


def custom(root: Path) -> None:
    """Write a stranger's model with an effect of its own, which leaves a witness when it is run."""
    from cgwm.datasets.models.model import write_model
    from cgwm.schemas import EffectModel
    from small_model import small_model

    text = Path(__file__).parents[2].joinpath("pipeline/physics/effects/template.py").read_text(encoding="utf-8")
    text = text.replace("from .effect import", "from cgwm.pipeline.physics.effects import")
    source = root / "lift.py"
    source.write_text(f"{text}\n\nfrom pathlib import Path\n\nPath({str(root.resolve())!r}, {CANARY!r}).touch()\n")
    made = small_model()
    effect = EffectModel(name=f"{source}:MyEffect", parameters={"w": 0.5, "r": 0.2})
    write_model(root / "model", replace(made, file=made.file.model_copy(update={"effects": (effect,)})))
    source.unlink()
    tracks(root / "other")
    (root / "other" / "capture").rename(root / "capture")
    shutil.rmtree(root / "other")


def dataset(root: Path) -> None:
    """Write a dataset of two rollouts with images."""
    _synthesize(root, small=False)


def bare(root: Path) -> None:
    """Write a dataset of two rollouts without images."""
    _synthesize(root, small=True)


def merged(root: Path) -> None:
    """Write a dataset of two shards, with its index."""
    from cgwm.pipeline.synthesize import merge
    from cgwm.pipeline.synthesize.shards import synthesize_shards
    from cgwm.schemas import SynthesizeConfig
    from small_model import write_small_model

    write_small_model(root / "model")
    config = SynthesizeConfig(rollouts=2, duration_s=0.2, width=48, height=36, shards=2)
    synthesize_shards(root / "model", root / "dataset", config)
    merge([root / "dataset"])


def _synthesize(root: Path, small: bool) -> None:
    from cgwm.pipeline.synthesize import synthesize
    from cgwm.schemas import SynthesizeConfig
    from small_model import write_small_model

    write_small_model(root / "model", visible=not small)
    synthesize(root / "model", root / "dataset", SynthesizeConfig(rollouts=2, duration_s=0.2, width=48, height=36))


def _motion() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from thrown_cube import measured, thrown

    track = measured(*thrown(0), 0)
    assert track.quat_wxyz is not None
    return track.time_s, track.position_m, track.quat_wxyz


def csv(root: Path) -> None:
    """Write two recordings as CSV files."""
    time, position, quat = _motion()
    (root / "csv").mkdir()
    for name in ("a", "b"):
        rows = [",".join(f"{value:.6f}" for value in row) for row in np.c_[time, position, quat]]
        (root / "csv" / f"{name}.csv").write_text("\n".join(["t,x,y,z,qw,qx,qy,qz", *rows]) + "\n")


def bodies_csv(root: Path) -> None:
    """Write a recording of two bodies as a CSV file."""
    time, position, _ = _motion()
    rows = [
        f"{t:.4f},{body},{','.join(f'{value:.6f}' for value in row)}"
        for t, row in zip(time, position, strict=True)
        for body in ("cup", "ball")
    ]
    (root / "two.csv").write_text("\n".join(["time,body,px,py,pz", *rows]) + "\n")


def tum(root: Path) -> None:
    """Write a trajectory in TUM's format."""
    time, position, quat = _motion()
    rows = [" ".join(f"{value:.6f}" for value in row) for row in np.c_[time, position, quat[:, [1, 2, 3, 0]]]]
    (root / "poses.txt").write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *rows]) + "\n")


def hdf5(root: Path) -> None:
    """Write two recordings in one HDF5 file."""
    time, position, quat = _motion()
    with h5py.File(root / "poses.h5", "w") as file:
        for name in ("data/demo_0", "data/demo_1"):
            group = file.create_group(name)
            group["time"], group["position"], group["quat_wxyz"] = time, position, quat
            group.attrs["note"] = "a throw"


def rosbag(root: Path) -> None:
    """Write a ROS bag of poses."""
    import test_track_importers

    test_track_importers.write_bag(root / "bag", {"/pose": "geometry_msgs/msg/PoseStamped"})


def contactnets_npz(root: Path) -> None:
    """Write tosses as one .npz."""
    import test_contactnets

    (root / "tosses").mkdir()
    test_contactnets.write_npz(root / "tosses" / "a.npz", [0, 1, 2])


def contactnets_pt(root: Path) -> None:
    """Write tosses as .pt files."""
    import test_contactnets

    test_contactnets.write_pt(root / "tosses", [0, 1, 2])


def pinwm(root: Path) -> None:
    """Write pushes as PIN-WM publishes them."""
    import test_pinwm

    test_pinwm.write_source(root / "pushes")


def jugglebot(root: Path) -> None:
    """Write throws in both of Jugglebot's formats."""
    import test_track_importers

    made = [test_track_importers.thrown(seed) for seed in (0, 1)]
    rows = np.concatenate([np.c_[time + 1 / 300, position] for time, position in made])
    (root / "throws").mkdir()
    np.savez(root / "throws" / "a.npz", offsets=600 * np.arange(3), txyz=rows)
    markers = [
        {"Parts": [{"Range": {"Start": 1}, "Values": [[*row, 0.5] for row in (1000 * position).round(2).tolist()]}]}
        for _, position in made
    ]
    text = json.dumps({"Timebase": {"Frequency": 300.0}, "Markers": markers})
    (root / "throws" / "b.json").write_text(text)


def balldrops(root: Path) -> None:
    """Write falling balls as they were published."""
    import test_track_importers

    test_track_importers.write_drops(root / "drops")


def calibration(root: Path) -> None:
    """Write nine photos of a floor with markers."""
    import cv2
    import test_calibrate as scene

    folder = root / "capture" / "images"
    folder.mkdir(parents=True)
    floor, wall = scene._floor(), scene._texture(round(0.8 * scene.PIXELS_PER_M), 1)[: round(0.5 * scene.PIXELS_PER_M)]
    for index, pose in enumerate(scene._poses(4)):
        cv2.imwrite(str(folder / f"{index}.png"), scene._render(pose, floor, wall)[:, :, ::-1])
    (root / "capture" / "capture.toml").write_text(scene.MANIFEST + scene.MARKERS)


def write_toss_capture(
    root: Path,
    gravity: float = 9.81,
    ramp_deg: float = 0.0,
    size: float = 1.0,
    mass_kg: float = 0.4,
    length_s: float = 0.5,
) -> None:
    """Write six tosses of a box of 10 cm times a size, which tumbles and lands, as `root/capture`.

    Args:
        root: The folder.
        gravity: Its magnitude [m/s2], along -z.
        ramp_deg: Slope of the ground [deg], about y.
        size: Of the box.
        mass_kg: Its mass.
        length_s: Length of a toss [s].
    """
    import torch
    from cgwm.datasets.capture.tracks import Track, write_tracks
    from cgwm.pipeline.geometry.rotation import quat_exp, quat_multiply
    from cgwm.pipeline.physics import State, simulate
    from worlds import F64, box_body, law, world_of

    rng, half, count = np.random.default_rng(3), 0.05 * size, 6
    normal = np.array([np.sin(np.radians(ramp_deg)), 0.0, np.cos(np.radians(ramp_deg))])
    body = box_body((half, half, half), mass=mass_kg, radius=0.02 * size / 2)
    world = world_of(body, contact=law(0.3, 0.004, 0.4), gravity=gravity, step_s=0.002)
    world = replace(world, ground_normal=torch.as_tensor(normal, dtype=F64))
    speed = np.sqrt(gravity * size / 9.81)
    position = rng.uniform(-0.1, 0.1, (count, 1, 3)) * size + normal * size * rng.uniform(0.2, 0.4, (count, 1, 1))
    quat = rng.standard_normal((count, 1, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    heading = rng.uniform(0, 2 * np.pi, count)
    velocity = speed * np.stack([np.cos(heading), np.sin(heading), rng.uniform(0.2, 1.0, count)], -1)[:, None]
    omega = rng.uniform(4, 10, (count, 1, 1)) * quat[..., 1:] / np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    omega *= np.sqrt(gravity / 9.81 / size)
    times = torch.arange(round(length_s * 100) + 1, dtype=F64) / 100
    with torch.no_grad():
        made = simulate(world, State(*map(torch.as_tensor, (position, quat, velocity, omega))), times)
    (root / "capture" / "tracks").mkdir(parents=True)
    turns = quat_multiply(
        made.quat_wxyz[:, :, 0], quat_exp(torch.as_tensor(2e-3 * rng.standard_normal((count, len(times), 3))))
    )
    for k in range(count):
        moved = made.position_m[k, :, 0].numpy() + 5e-4 * size * rng.standard_normal((len(times), 3))
        track = Track(times.numpy().round(4), moved, turns[k].numpy())
        write_tracks(root / "capture" / "tracks" / f"{k:03d}.csv", {"box": track})
    (root / "capture" / "capture.toml").write_text(
        f'format = "cgwm-capture/1"\n[world]\ngravity_m_s2 = [0.0, 0.0, {-gravity}]\n'
        f"ground = {{ normal = {[float(x) for x in normal]}, offset_m = 0.0 }}\n"
        f'[[bodies]]\nname = "box"\nmass_kg = {mass_kg}\nshape = {{ box = {{ half_extents_m = [{half}, {half}, {half}] }} }}\n'
        '[splits]\ntrain = ["000", "001", "002", "003"]\ntest = ["004", "005"]\n'
    )


def things(root: Path) -> None:
    """Write one of everything, and what is the user's own."""
    csv(root)
    hdf5(root)
    tracks(root)
    shutil.copytree(root / "capture", root / "data" / "capture")
    shutil.rmtree(root / "model")
    _synthesize(root, small=False)
    (root / "docs").mkdir()
    (root / "docs" / "thesis.txt").write_text("years of work")
    (root / "notes.html").write_text("<!doctype html>mine")


VALIDATE = command("validate capture", weight=3)
FIT = command("fit capture --out OUT --stage phys-geo", *FAST_FIT, weight=0.5)
EVAL = command("eval model capture")
COMPARE = command("compare model capture --out OUT.html", weight=0.7)
DIAGNOSE = command("diagnose model capture --split look", weight=0.3)
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
    command("merge dataset --out OUT.h5", weight=0.7),
    command("eval model dataset --split train", weight=0.5),
    command("view dataset --port 0 --no-open", weight=0.5, serves=True),
)


def imports(words: str) -> tuple[Command, ...]:
    return (command(f"import {words} --out OUT"),)


SUBJECTS = {
    subject.name: subject
    for subject in (
        Subject("tracks", "captures", tracks, (VALIDATE, FIT, EVAL, COMPARE, DIAGNOSE), ("capture/**/*",), 3),
        Subject("photos", "captures", photographed, (VALIDATE, SPLATS), ("capture/**/*",), 2),
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
        Subject("pinwm", "importers", pinwm, imports("pinwm pushes --train 4"), weight=0.5),
        Subject("jugglebot", "importers", jugglebot, imports("jugglebot throws"), weight=0.5),
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

"""Valid captures, with models of them, plans, throws and settings: small, and made by our own engine and renderer."""

from __future__ import annotations

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
    from helpers.thrown_cube import measured, thrown, truth

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
        'length_scale = "auto"\n'
        "[sg-gs]\niterations = 2\nimage_size = 32\nturntable = false\nmax_body_spheres = 40\n"
        "max_scene_spheres = 40\nmax_collision_spheres = 20\ntest_every = 2\nradius_factor = 2.0\n"
    )
    (root / "synthesize.toml").write_text(
        "[synthesize]\nseed = 0\nrollouts = 1\nduration_s = 0.1\nframe_rate_hz = 30.0\nwidth = 20\nheight = 16\n"
        'compression = "gzip"\nbatch = 1\nshard = 0\nshards = 1\n'
    )


def photographed(root: Path) -> None:
    """Write a capture of a cube in six photos with masks and cameras, and a model of it."""
    from cgwm.datasets.capture.cameras import to_intrinsics
    from cgwm.datasets.capture.images import write_image
    from cgwm.datasets.models.model import write_model
    from cgwm.pipeline.rendering.label_renderer import LabelRenderer
    from cgwm.schemas import CamerasFile, PosedImage, Scale
    from helpers.small_model import HALF
    from helpers.tiny_capture import camera, tiny_model

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
    from helpers.tiny_capture import thrown, with_tracks, write_tiny_capture

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
    from cgwm.datasets.shapes.ply import write_splats
    from helpers.small_model import collision_splats

    from datasets.shapes import test_meshes

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
    from helpers.worlds import F64, box_body, law, world_of

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
        f'[[bodies]]\nname = "box"\nmass_kg = {mass_kg}\n'
        f"shape = {{ box = {{ half_extents_m = [{half}, {half}, {half}] }} }}\n"
        '[splits]\ntrain = ["000", "001", "002", "003"]\ntest = ["004", "005"]\n'
    )

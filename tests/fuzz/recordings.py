"""Valid recordings in all formats that are imported, photos to calibrate, and one of everything."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np

from .captures import tracks
from .models import synthesize_small


def _motion() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from helpers.thrown_cube import measured, thrown

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
    from datasets.importers import test_track_importers

    test_track_importers.write_bag(root / "bag", {"/pose": "geometry_msgs/msg/PoseStamped"})


def phone_photos(root: Path) -> None:
    """Write photos as a phone does, one of them HEIC where pillow-heif is installed."""
    from datasets.importers import test_photo_importers

    test_photo_importers._photos(root / "photos", ["a.jpg", "b.png"])
    try:
        import pillow_heif  # pyright: ignore[reportMissingImports]
        from PIL import Image
    except ImportError:
        return
    pillow_heif.from_pillow(Image.new("RGB", (64, 48), (90, 120, 30))).save(root / "photos" / "c.heic")


def walk(root: Path) -> None:
    """Write a video of a walk."""
    from datasets.importers import test_photo_importers

    test_photo_importers.write_walk(root / "walk.mp4", 12)


def nerfstudio(root: Path) -> None:
    """Write a transforms.json with its photos."""
    from datasets.importers import test_photo_importers

    test_photo_importers.write_transforms(root / "scene", ["images/a.png", "images/b.png", "images/c.png"])


def colmap(root: Path) -> None:
    """Write a COLMAP model with its photos."""
    from datasets.importers import test_photo_importers

    test_photo_importers.write_colmap(root / "scene")


def polycam(root: Path) -> None:
    """Write a raw export of Polycam."""
    from datasets.importers import test_photo_importers

    test_photo_importers.write_polycam(root / "scan")


def record3d(root: Path) -> None:
    """Write a recording of Record3D."""
    from datasets.importers import test_photo_importers

    test_photo_importers.write_record3d(root / "scan")


def stray(root: Path) -> None:
    """Write a recording of Stray Scanner."""
    from datasets.importers import test_sensor_importers

    test_sensor_importers.write_stray(root / "scan", 4)


def arkitscenes(root: Path) -> None:
    """Write a scene of ARKitScenes."""
    from datasets.importers import test_sensor_importers

    test_sensor_importers.write_arkitscenes(root / "scan", 4)


def realsense_bag(root: Path) -> None:
    """Write a .bag of librealsense."""
    from datasets.importers import test_sensor_importers

    test_sensor_importers.write_realsense_bag(root / "walk.bag")


def realsense_db3(root: Path) -> None:
    """Write a .db3 of librealsense."""
    from datasets.importers import test_sensor_importers

    test_sensor_importers.write_realsense_db3(root / "walk.db3")


def contactnets_npz(root: Path) -> None:
    """Write tosses as one .npz."""
    from datasets.importers import test_contactnets

    (root / "tosses").mkdir()
    test_contactnets.write_npz(root / "tosses" / "a.npz", [0, 1, 2])


def contactnets_pt(root: Path) -> None:
    """Write tosses as .pt files."""
    from datasets.importers import test_contactnets

    test_contactnets.write_pt(root / "tosses", [0, 1, 2])


def elbow(root: Path) -> None:
    """Write tosses of two links with a hinge."""
    from helpers.elbow import write_tosses

    write_tosses(root / "elbow", [0, 1, 2])


MJCF = """<mujoco><worldbody><body name="upper"><freejoint/><geom type="box" size="0.05 0.025 0.025" mass="0.4"/>
<body name="lower" pos="-0.035 0.06 0"><joint name="hinge" axis="0 1 0" range="-2 2"/>
<geom type="box" size="0.05 0.025 0.025" pos="0.035 0 0" mass="0.3"/></body></body></worldbody></mujoco>
"""


def jointed(root: Path) -> None:
    """Write a capture of tosses of two links with a hinge, described by a URDF."""
    from cgwm.datasets import import_elbow

    elbow(root)
    import_elbow(root / "elbow", root / "capture")


def jointed_mjcf(root: Path) -> None:
    """Write the same capture with an MJCF."""
    jointed(root)
    (root / "capture" / "elbow.urdf").unlink()
    (root / "capture" / "elbow.xml").write_text(MJCF, encoding="utf-8")
    manifest = root / "capture" / "capture.toml"
    manifest.write_text(manifest.read_text("utf-8").replace('urdf = "elbow.urdf"', 'mjcf = "elbow.xml"'), "utf-8")


def pinwm(root: Path) -> None:
    """Write pushes as PIN-WM publishes them."""
    from datasets.importers import test_pinwm

    test_pinwm.write_source(root / "pushes")


def jugglebot(root: Path) -> None:
    """Write throws in both of Jugglebot's formats."""
    from datasets.importers import test_track_importers

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
    from datasets.importers import test_track_importers

    test_track_importers.write_drops(root / "drops")


def calibration(root: Path) -> None:
    """Write nine photos of a floor with markers."""
    import cv2

    from pipeline.calibrate import test_calibrate as scene

    folder = root / "capture" / "images"
    folder.mkdir(parents=True)
    floor, wall = scene._floor(), scene._texture(round(0.8 * scene.PIXELS_PER_M), 1)[: round(0.5 * scene.PIXELS_PER_M)]
    for index, pose in enumerate(scene._poses(4)):
        cv2.imwrite(str(folder / f"{index}.png"), scene._render(pose, floor, wall)[:, :, ::-1])
    (root / "capture" / "capture.toml").write_text(scene.MANIFEST + scene.MARKERS)


def board_photos(root: Path) -> None:
    """Write photos of the calibration target, their intrinsics, and a capture of three of the photos."""
    from cgwm.pipeline.calibrate import calibrate_target
    from helpers.target_photos import write_photos

    write_photos(root / "board", 10)
    calibrate_target(root / "board")
    (root / "capture" / "images").mkdir(parents=True)
    for photo in sorted((root / "board").glob("*.png"))[:3]:
        shutil.copyfile(photo, root / "capture" / "images" / photo.name)
    (root / "capture" / "capture.toml").write_text('format = "cgwm-capture/1"\n')


def things(root: Path) -> None:
    """Write one of everything, and what is the user's own."""
    csv(root)
    hdf5(root)
    tracks(root)
    shutil.copytree(root / "capture", root / "data" / "capture")
    shutil.rmtree(root / "model")
    synthesize_small(root, small=False)
    (root / "docs").mkdir()
    (root / "docs" / "thesis.txt").write_text("years of work")
    (root / "notes.html").write_text("<!doctype html>mine")

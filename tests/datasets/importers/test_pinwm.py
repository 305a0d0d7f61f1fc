"""Import of PIN-WM's pushes: frames, masks, camera, poses and what is assumed of the pusher."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.cli import main
from cgwm.datasets import Capture, import_pinwm
from cgwm.datasets.importers.pinwm import MARGIN_M, hull, pusher_track, widened, write_obj
from cgwm.datasets.shapes.meshes import Mesh, mass_properties, read_mesh
from cgwm.schemas import InputDataError, UsageError

SHARED = Path(os.environ.get("CGWM_SHARED_DATA", Path(__file__).parents[4] / "shared" / "data"))
PINWM = SHARED / "pinwm"
FRAMES = 6
START, GOAL = (0.05, 0.04), (-0.01, 0.02)
CUBE = Mesh(
    np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * [0.05, 0.04, 0.025],
    np.array(
        [
            *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
            *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
        ]
    ),
)
URDF = (
    '<robot name="r"><link name="empty"/><link name="l"><inertial><origin xyz="0 0 0"/><mass value="1.5"/></inertial>'
    '<collision><geometry><!-- <mesh filename="old.obj"/> --><mesh filename="it.obj"/></geometry></collision></link>'
    "</robot>"
)


def write_source(root: Path, pictures: bool = True) -> Path:
    for folder, name in (("cube_t", "cube_t_mesh.urdf"), ("ee", "ee.urdf")):
        place = root / "envs" / "asset" / folder
        place.mkdir(parents=True)
        (place / name).write_text(URDF)
        write_obj(place / "it.obj", CUBE)
    c2w = [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.9]]  # looks down, x to the right, y up
    for name in ("push_a", "push_b"):
        folder = root / "dataset" / name
        (folder / "train0").mkdir(parents=True)
        images = [
            {"time": k / 24, "c2w": c2w, "intrinsic": [[50, 0, 16], [0, 50, 12], [0, 0, 1]]}
            | {"file_path": f"train0/r_0_{k}.png"}
            for k in range(-1, FRAMES)
        ]
        poses = [
            [0.01 * k, 0.0, 0.025, 0.0, 0.0, float(np.sin(0.1 * k)), float(np.cos(0.1 * k))] for k in range(FRAMES)
        ]
        push = {"ee_init_position": START, "ee_goal_position": GOAL, "image_datas": images, "pose_datas": poses}
        (folder / "dynamic_train0.json").write_text(json.dumps(push))
        if name == "push_b" or not pictures:
            continue
        for k in range(-1, FRAMES):
            picture = np.full((24, 32, 4), 100 + k, np.uint8)
            picture[..., 3] = 0
            picture[8:12, 10 : 12 + k, 3] = 255
            cv2.imwrite(str(folder / "train0" / f"r_0_{k}.png"), picture[..., :3])
            if k >= 0:
                cv2.imwrite(str(folder / "train0" / f"m_0_{k}.png"), picture)
    return root


def test_a_push_becomes_a_capture(tmp_path: Path) -> None:
    result = import_pinwm(write_source(tmp_path / "source"), tmp_path / "out", n_train=4)
    assert (result.episodes, result.splits) == (3, {"train": 1, "test": 2})
    capture = Capture.open(tmp_path / "out")
    assert capture.manifest.splits == {"train": ("push_a-first",), "test": ("push_a", "push_b")}
    block, pusher = capture.manifest.bodies
    assert (block.mass_kg, block.com_m, block.inertia_kg_m2, pusher.motion) == (1.5, (0, 0, 0), None, "driven")
    assert capture.manifest.world.ground is not None and capture.manifest.world.ground.offset_m == 2 * MARGIN_M
    # what the fit may see ends with its frames
    assert len(capture.frame_times("cam", "push_a-first")) == 4 and len(capture.frame_times("cam", "push_a")) == FRAMES
    assert [len(track) for track in capture.tracks("push_a-first").values()] == [4, 4]
    assert capture.videos("push_b") == [] and len(capture.tracks("push_b")["block"]) == FRAMES
    track = capture.tracks("push_a")["block"]
    assert track.quat_wxyz is not None
    np.testing.assert_allclose(track.time_s, np.arange(FRAMES) / 24)
    np.testing.assert_allclose(track.position_m[:, 0], 0.01 * np.arange(FRAMES))
    np.testing.assert_allclose(track.quat_wxyz[:, 3], np.sin(0.1 * np.arange(FRAMES)), atol=1e-12)
    masks = capture.video_masks("cam", "push_a")
    assert masks is not None and masks.max() == 1
    assert [int(mask.sum()) for mask in masks] == [4 * (2 + k) for k in range(FRAMES)]
    assert [int(frame[0, 0, 0]) for frame in capture.video_frames("cam", "push_a")] == [100 + k for k in range(FRAMES)]


def test_the_camera_looks_where_opengl_says(tmp_path: Path) -> None:
    import_pinwm(write_source(tmp_path / "source"), tmp_path / "out", n_train=4)
    camera = Capture.open(tmp_path / "out").video_camera("cam", "push_a")
    pixels, depth = camera.project(np.array([[0.1, 0.2, 0.0], [0.19, 0.2, 0.0], [0.1, 0.29, 0.0]]))
    np.testing.assert_allclose(depth, 0.9)
    np.testing.assert_allclose(pixels, [[16, 12], [21, 12], [16, 7]])


def test_the_pusher_takes_the_same_share_of_its_way_in_each_frame() -> None:
    track = pusher_track(START, GOAL, 40)
    left = np.linalg.norm(track.position_m[:, :2] - GOAL, axis=1)
    np.testing.assert_allclose(left[1:] / left[:-1], 1 - 5 / 24)
    np.testing.assert_allclose(track.position_m[0], [*START, 0.05])


def test_widened_hull(tmp_path: Path) -> None:
    hollow = Mesh(np.r_[CUBE.vertices, [[0.0, 0.0, 0.01]]], CUBE.faces)
    found = hull(hollow)
    assert len(found.vertices) == 8
    assert mass_properties(found).volume_m3 == pytest.approx(mass_properties(CUBE).volume_m3)
    wide = widened(found, 0.002)
    np.testing.assert_allclose(wide.vertices.max(0), [0.052, 0.042, 0.025])
    write_obj(tmp_path / "a.obj", wide)
    np.testing.assert_allclose(read_mesh(tmp_path / "a.obj").vertices.min(0), [-0.052, -0.042, -0.025])


def test_faults_leave_nothing_behind(tmp_path: Path) -> None:
    def fault(source: Path, **options: int) -> str:
        with pytest.raises(InputDataError) as caught:
            import_pinwm(source, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
        return str(caught.value).replace(str(tmp_path), "T").splitlines()[0]

    assert fault(tmp_path / "absent") == "T/absent: no such directory."
    assert fault(write_source(tmp_path / "bare", pictures=False)).startswith("T/bare/dataset: no push has its pictures")
    source = write_source(tmp_path / "source")
    assert fault(source, n_train=6) == "T/source/dataset: 6 frames to fit on; the shortest push with pictures has 6."
    pictures = source / "dataset" / "push_a" / "train0"
    (pictures / "m_0_3.png").unlink()
    assert fault(source, n_train=4) == "T/source/dataset/push_a/train0/m_0_3.png: no such file."
    (pictures / "r_0_3.png").unlink()
    assert fault(source, n_train=4) == "T/source/dataset/push_a: 5 pictures for 6 poses."
    (source / "envs" / "asset" / "ee" / "ee.urdf").write_text("<robot")
    (pictures / "r_0_3.png").write_bytes((pictures / "r_0_2.png").read_bytes())
    assert "ee.urdf: cannot be read" in fault(source, n_train=4)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("time", "0", "image_datas.3.time: input should be a valid number"),
        ("c2w", [[0, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.9]], "image_datas.3.c2w: the pose is no rotation"),
        ("c2w", [[-1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.9]], "it mirrors"),
        ("intrinsic", [[0, 0, 16], [0, 50, 12], [0, 0, 1]], "r_0_2.png': the focal lengths in K are 0 and 50 px"),
        ("intrinsic", [[50, 0, 16], [0, 50, 12], [0, 0, 2]], "r_0_2.png': K is not of the form"),
    ],
)
def test_cameras_that_cannot_be_are_refused(tmp_path: Path, key: str, value: object, message: str) -> None:
    file = write_source(tmp_path / "source") / "dataset" / "push_a" / "dynamic_train0.json"
    data = json.loads(file.read_text())
    data["image_datas"][3][key] = value
    file.write_text(json.dumps(data))
    with pytest.raises(InputDataError) as caught:
        import_pinwm(tmp_path / "source", tmp_path / "out", n_train=4)
    assert caught.value.found.startswith(str(file)) and message in caught.value.found
    assert not (tmp_path / "out").exists()


def test_options_of_another_format_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    source = write_source(tmp_path / "source")
    with pytest.raises(SystemExit) as ended:
        main(["import", "pinwm", str(source), "--out", str(tmp_path / "out"), "--seed", "3"])
    assert ended.value.code == 2 and "--seed does not apply to pinwm" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_existing_output_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with pytest.raises(UsageError, match="exists"):
        import_pinwm(tmp_path / "absent", tmp_path / "out")


@pytest.mark.skipif(not PINWM.is_dir(), reason="PIN-WM's pushes are not on this machine")
def test_published_pushes(tmp_path: Path) -> None:
    """The masks are those of the block's mesh at its poses, seen by the camera as it was read."""
    import torch
    from cgwm.pipeline.geometry.mesh import read_mesh as closed_mesh
    from cgwm.pipeline.phys_geo.images.crops import Window
    from cgwm.pipeline.phys_geo.images.silhouettes import Outline, covered
    from cgwm.pipeline.phys_geo.images.video_frames import load_footage

    result = import_pinwm(PINWM, tmp_path / "out")
    assert (result.episodes, result.samples, result.splits) == (3, 152, {"train": 1, "test": 2})
    capture = Capture.open(tmp_path / "out")
    (video,) = load_footage(capture, "sim_push_t2-first", 200).videos
    assert video.covers is not None and len(video.frames) == 12
    track, mesh = capture.tracks("sim_push_t2-first")["block"], closed_mesh(tmp_path / "out" / "block.obj")
    outline = Outline(0, torch.as_tensor(mesh.vertices), mesh.faces, 0.05)
    window = Window(torch.arange(12), torch.zeros(12, 2, dtype=torch.int64), video.size)
    at = torch.as_tensor(track.position_m)[:, None], torch.as_tensor(track.quat_wxyz)[:, None]
    mine, true = covered(video, window, [outline], 1, *at, 1e-3)[..., 0] > 0.5, video.covers[:, 0] > 0.5
    overlap = (mine & true).sum((1, 2)) / (mine | true).sum((1, 2))
    assert float(overlap.min()) > 0.975

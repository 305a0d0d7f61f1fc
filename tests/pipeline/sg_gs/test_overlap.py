"""Cameras that do not see what they are said to see are refused, with the share that they see."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.sparse_points import read_points, write_points
from cgwm.pipeline.sg_gs.stage import fit_scene
from cgwm.schemas import InputDataError
from pipeline.sg_gs.test_sg_gs import CONFIG, PLACE, RADIUS, make_capture

BALL = f"shape = {{ sphere = {{ radius_m = {RADIUS} }} }}"
QUICK = CONFIG.model_copy(update={"iterations": 2, "bare_ground": False, "flat_faces": False, "image_size": 48})


def points(count: int = 200) -> np.ndarray:
    return PLACE + np.random.default_rng(0).uniform(-0.05, 0.05, (count, 3))


def write(capture: Capture, positions: np.ndarray) -> None:
    write_points(capture.root / "sparse_points.ply", positions, np.zeros((len(positions), 3), np.uint8), "metre")


def test_points_behind_every_camera(tmp_path: Path) -> None:
    """OpenGL's camera axes turn every camera round."""
    capture = make_capture(tmp_path / "capture")
    write(capture, points())
    path = capture.root / "cameras.json"
    cameras = json.loads(path.read_text())
    for image in cameras["images"].values():
        image["T_world_cam"] = (np.array(image["T_world_cam"]) @ np.diag([1.0, -1, -1, 1])).tolist()
    path.write_text(json.dumps(cameras))
    for mask in (capture.root / "masks").iterdir():
        mask.unlink()
    (capture.root / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    with pytest.raises(InputDataError) as caught:
        fit_scene(Capture.open(capture.root, check=False), QUICK)
    assert str(caught.value).startswith(
        f"{capture.root / 'sparse_points.ply'}: 0% of its 200 points lie in view of any of the 9 photos.\n"
        "Allowed: at least 5%.\nNext: compare the conventions: "
    )


def test_points_of_which_few_are_in_view_are_told(tmp_path: Path) -> None:
    capture = make_capture(tmp_path / "capture", shape=BALL)
    shutil.rmtree(capture.root / "masks")
    write(capture, np.concatenate([points(60), points(140) + np.array([100.0, 0, 0])]))
    result = fit_scene(capture, QUICK)
    assert "Only 30% of the points of sparse_points.ply lie in view of any photo." in result.warnings


@pytest.mark.parametrize(
    ("place", "found"), [((0.0, 0.0, 30.0), "0% of"), ((PLACE[0], PLACE[1] + 0.1, PLACE[2] + 0.1), "[1-9]\\d% of")]
)
def test_a_shape_that_stands_elsewhere_than_the_masks_show(
    tmp_path: Path, place: tuple[float, float, float], found: str
) -> None:
    pose = f"photo_pose = {{ position_m = {list(map(float, place))}, quat_wxyz = [1.0, 0.0, 0.0, 0.0] }}"
    capture = make_capture(tmp_path / "capture", shape=f"{BALL}\n{pose}")
    with pytest.raises(InputDataError, match="photo_pose") as caught:
        fit_scene(capture, QUICK)
    assert re.match(
        f"body 'ball': {found} the surface of its shape lies in view of the 9 photos whose masks show it, and "
        r"\d% of that inside those masks\.\nAllowed: at least 10%\.",
        str(caught.value),
    )


def test_sparse_points_that_are_not_finite(tmp_path: Path) -> None:
    positions = points()
    positions[[3, 7], 1] = np.nan, np.inf
    path = tmp_path / "sparse_points.ply"
    write_points(path, positions, np.zeros((200, 3), np.uint8), "metre")
    with pytest.raises(InputDataError) as caught:
        read_points(path)
    assert str(caught.value).splitlines()[0] == f"{path}: 2 of 200 points are not finite."

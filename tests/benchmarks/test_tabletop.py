"""The captures of the benchmark Fall and Push (benchmarks/tabletop)."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from cgwm.datasets import Capture
from cgwm.datasets.capture.check import check_capture
from cgwm.datasets.shapes.meshes import Mesh, mass_properties
from cgwm.datasets.synthetic import read_truth
from cgwm.datasets.synthetic.dynamics import STEPS_PER_S, ContactTruth, build_model, matrix_from_quat, simulate
from cgwm.datasets.synthetic.objects import extrude
from cgwm.schemas import InputDataError, UsageError
from scipy.spatial import ConvexHull

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = pytest.mark.evidence
SMALL = {"tests": 1, "video_size": (96, 72), "photo_size": (96, 72), "photos": 4}


@pytest.fixture(scope="module")
def tabletop() -> ModuleType:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        import tabletop
        import tabletop.capture
        import tabletop.distance
        import tabletop.objects
        import tabletop.paint
        import tabletop.scans
        import tabletop.tosses
    finally:
        sys.path.remove(str(BENCHMARKS))
    return tabletop


@pytest.fixture(scope="module")
def fall(tabletop: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tabletop.make_capture(tmp_path_factory.mktemp("tabletop") / "fall", "box", "wood", "fall", **SMALL)


@pytest.fixture(scope="module")
def push(tabletop: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tabletop.make_capture(tmp_path_factory.mktemp("tabletop") / "push", "box", "wood", "push", **SMALL)


def test_captures_are_valid_and_hold_true_cameras(fall: Path, push: Path) -> None:
    for path in (fall, push):
        capture, truth = Capture.open(path), read_truth(path)
        check_capture(capture)
        assert capture.episodes("train") == ["000"] and capture.episodes("test") == ["001"]
        assert capture.cameras == truth.cameras
        for camera in ("left", "right"):
            assert capture.video_frames(camera, "000").shape == (15, 72, 96, 3)
            masks = capture.video_masks(camera, "001")
            assert masks is not None and masks.shape == (60, 72, 96)
            assert all((mask == 1).any() for mask in masks)
        for motion in truth.episodes.values():
            assert len(motion.velocity_m_s) == len(motion.omega_body_rad_s) == len(motion.time_s)
        assert np.linalg.norm(truth.episodes["001"].velocity_m_s[-1]) < 0.01


def test_photos_depend_on_neither_task_nor_ground(fall: Path, push: Path) -> None:
    for photo in sorted((fall / "images").iterdir()):
        assert photo.read_bytes() == (push / "images" / photo.name).read_bytes()


def test_training_toss_flies_hits_and_slides(tabletop: ModuleType, fall: Path) -> None:
    motion, solid = read_truth(fall).episodes["000"], tabletop.read_solid(fall)
    assert motion.first_contact_s is not None and 0.10 < motion.first_contact_s < 0.17
    slipped = 0.0
    for place, quat, velocity, omega in zip(
        motion.position_m, motion.quat_wxyz, motion.velocity_m_s, motion.omega_body_rad_s, strict=True
    ):
        turn = matrix_from_quat(np.array(quat))
        arms = solid.vertices @ turn.T
        low = arms[arms[:, 2].argmin()]
        if place[2] + low[2] < 0.0005:
            slipped += float(np.linalg.norm((velocity + np.cross(turn @ omega, low))[:2])) / 120
    assert slipped > 0.025


def test_pushed_object_slides_on_after_the_fingertip_has_stopped(push: Path) -> None:
    for name, wanted in (("000", 0.01), ("001", 0.0)):
        motion, tip = read_truth(push).episodes[name], Capture.open(push).tracks(name)["fingertip"]
        moving = np.linalg.norm(np.diff(tip.position_m, axis=0), axis=1) > 1e-9
        stopped = int(np.flatnonzero(moving)[-1]) + 1
        assert motion.time_s[stopped] < 0.28
        assert 0.3 < np.linalg.norm(np.diff(tip.position_m, axis=0), axis=1).max() * 120 < 0.91
        place = np.array(motion.position_m)[:, :2]
        assert np.linalg.norm(place[-1] - place[0]) > 0.03
        assert np.linalg.norm(place[-1] - place[stopped]) > wanted


def test_the_true_model_can_be_built_again(tabletop: ModuleType, fall: Path) -> None:
    solid, truth = tabletop.read_solid(fall), read_truth(fall)
    law = truth.contact
    assert tabletop.MATERIALS["wood"] == ContactTruth(
        friction=law.friction,
        friction_fingertip=tabletop.MATERIALS["wood"].friction_fingertip,
        natural_time=law.natural_time_s,
        damping_ratio=law.damping_ratio,
        impedance=law.impedance,
    )
    assert truth.object.mass_kg == solid.mass and sum(map(len, solid.parts)) == 8
    motion = truth.episodes["001"]
    start = np.array([*motion.position_m[0], *motion.quat_wxyz[0]])
    speed = np.array([*motion.velocity_m_s[0], *motion.omega_body_rad_s[0]])
    again = simulate(build_model(solid, tabletop.MATERIALS["wood"], False), start, speed, 0.0, motion.time_s[-1])
    rows = again.qpos[:: STEPS_PER_S // 120, :3]
    np.testing.assert_allclose(rows, motion.position_m, atol=1e-5)


def test_same_arguments_same_motion_and_photos(tabletop: ModuleType, fall: Path) -> None:
    capture = tabletop.capture
    item = tabletop.objects.load_item("box")
    plan, left_out = capture.plan_capture(item, "box", "wood", "fall", 0, 1)
    truth = read_truth(fall)
    for episode in plan.episodes:
        rows = episode.motion.qpos[episode.motion.rows(np.array(truth.episodes[episode.name].time_s))]
        np.testing.assert_array_equal(rows[:, :3], truth.episodes[episode.name].position_m)
    assert set(left_out) >= {"chaotic", "out of view"}


def test_distance_of_two_boxes_is_the_gap_between_them(tabletop: ModuleType) -> None:
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 50
    inner, outer = (Mesh(*extrude(outline * scale, 0.04 * scale)) for scale in (1.0, 1.05))
    assert tabletop.distance.distance_to_mesh(np.array([[0, 0, 0.03], [0.03, 0.03, 0.0]]), inner) == pytest.approx(
        [0.01, 0.01 * 2**0.5], abs=1e-9
    )
    out = tabletop.distance.surface_distance(inner, outer, 4000)
    assert out.mean_m == pytest.approx(0.001, abs=1e-9) and out.max_m == pytest.approx(0.001, abs=1e-9)
    back = tabletop.distance.surface_distance(outer, inner, 4000)
    assert 0.001 < back.p99_m < back.max_m < 0.001 * 3**0.5 + 1e-9


def test_unknown_names_are_refused(tabletop: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="unknown object 'bax'"):
        tabletop.make_capture(tmp_path / "x", "bax", "wood", "fall")
    with pytest.raises(UsageError, match="unknown material 'ice'"):
        tabletop.make_capture(tmp_path / "x", "box", "ice", "fall")
    monkeypatch.setenv("CGWM_TABLETOP_CACHE", str(tmp_path))
    with pytest.raises(InputDataError, match=r"mug\.npz: missing"):
        tabletop.make_capture(tmp_path / "x", "mug", "wood", "fall")


def test_scans_in_the_cache_are_closed_coloured_and_the_union_of_their_parts(tabletop: ModuleType) -> None:
    names = [name for name in tabletop.objects.SCANS if tabletop.scans.cache_path(name).exists()]
    if not names:
        pytest.skip(f"no scan in {tabletop.scans.cache_folder()}: 'python -m tabletop.prepare' makes them")
    for name in names:
        assert tabletop.scans.cache_path(name).stat().st_size < 1.5e6
        scan = tabletop.scans.read_scan(name)
        solid = scan.solid
        union = Mesh(solid.vertices, solid.faces)
        np.testing.assert_allclose(mass_properties(union, name).com_m, solid.com, atol=1e-6)
        points, _, _ = tabletop.distance.sample_surface(union, 2000, np.random.default_rng(0))
        hulls = [ConvexHull(part).equations for part in solid.parts]
        outside = np.min([(points @ one[:, :3].T + one[:, 3]).max(axis=1) for one in hulls], axis=0)
        assert np.abs(outside).max() < 1e-6, "a surface point that lies inside a part, or outside all of them"
        scanned, colours = scan.colours(2000)
        assert np.ptp(colours) > 0.2
        assert tabletop.distance.distance_to_mesh(scanned, union).mean() < 0.0006

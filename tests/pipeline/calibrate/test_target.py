"""Intrinsics from photos of the printed board: true, as certain as stated, refused where the photos do not tell."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.pipeline.calibrate import calibrate_target, print_target
from cgwm.pipeline.calibrate.given_intrinsics import read_intrinsics
from cgwm.pipeline.calibrate.photos import gather
from cgwm.pipeline.calibrate.target import intrinsics
from cgwm.pipeline.calibrate.target.board import charuco_board
from cgwm.pipeline.validate import validate
from cgwm.schemas import InputDataError, IntrinsicsFile, OutputExistsError, UsageError, read_json
from helpers.exif import add_exif, tiff
from helpers.target_photos import HEIGHT, LENS, SCALE, WIDTH, K, poses, sheet, write_photos


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("board") / "photos"
    write_photos(folder, 12)
    return folder


@pytest.fixture(scope="module")
def file(board: Path) -> IntrinsicsFile:
    return calibrate_target(board)


def test_the_same_photos_keep_their_intrinsics_and_others_are_not_replaced(board: Path, file: IntrinsicsFile) -> None:
    path = board / "intrinsics.json"
    made = path.stat().st_mtime_ns
    assert (calibrate_target(board), path.stat().st_mtime_ns) == (file, made)
    text = path.read_text()
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        calibrate_target(board)
    assert path.read_text() == "mine"
    path.write_text(text)


def test_the_printed_sheet_is_opencvs_board() -> None:
    corners, identifiers, _, _ = cv2.aruco.CharucoDetector(charuco_board()).detectBoard(sheet())
    assert len(identifiers) == 54
    places = np.asarray(charuco_board().getChessboardCorners())[np.ravel(identifiers)][:, :2]
    assert np.asarray(corners).reshape(-1, 2) == pytest.approx((places + np.array([18.5, 14.0])) * SCALE - 0.5, abs=0.1)


@pytest.mark.parametrize("suffix", [".svg", ".pdf"])
def test_a_board_is_printed_in_true_size_and_again_with_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"board{suffix}"
    assert (print_target(path).width_mm, print_target(path).square_mm) == (260.0, 26.0)
    text = path.read_text(encoding="latin-1")
    if suffix == ".svg":
        assert ElementTree.fromstring(text).attrib["width"] == "297mm"
    else:
        assert "/MediaBox [0 0 841.8898 595.2756]" in text  # 297 x 210 mm in points of 1/72 inch
        for number in range(1, 6):
            start = int(text[text.index("xref\n0 6\n") + 9 + 20 * number :][:10])
            assert text[start:].startswith(f"{number} 0 obj\n")
    path.write_text("mine")
    with pytest.raises(OutputExistsError):
        print_target(path)
    with pytest.raises(UsageError, match="is no calibration target of cgwm"):
        print_target(path, overwrite=True)


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError) as caught:
        print_target(tmp_path / "board.png")
    assert str(caught.value).startswith(f"{tmp_path / 'board.png'}: a board is printed from .pdf or .svg.")


def test_what_is_no_folder_of_photos_is_told(tmp_path: Path) -> None:
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone" / "1.HEIC").write_bytes(b"photo")
    for name, words in (("board.png", "no such folder"), ("phone", r"0 photo\(s\), and files \.HEIC\.")):
        with pytest.raises(InputDataError, match=f"{name}: {words}"):
            calibrate_target(tmp_path / name)
    with pytest.raises(InputDataError, match=r"cgwm import photos .*phone --out BOARD"):
        calibrate_target(tmp_path / "phone")


def test_the_intrinsics_are_true_within_what_they_state(board: Path, file: IntrinsicsFile) -> None:
    camera = file.camera
    assert (camera.width, camera.height, camera.model) == (WIDTH, HEIGHT, "OPENCV")
    # corners of a noisy photo share errors of some hundredths of a pixel, which the scatter does not show
    assert camera.fx == pytest.approx(K[0, 0], abs=4 * file.fx_std_px + 0.5)
    assert camera.cx == pytest.approx(K[0, 2] + 0.5, abs=4 * file.cx_std_px + 0.5)
    assert camera.cy == pytest.approx(K[1, 2] + 0.5, abs=4 * file.cy_std_px + 0.5)
    assert camera.distortion[0] == pytest.approx(LENS[0], abs=4 * file.distortion_std[0] + 0.003)
    assert file.rms_px < 0.4  # of corners in pictures that were drawn bilinearly
    assert file.held_out_rms_px < 1.5 * file.rms_px
    assert read_json(board / "intrinsics.json", IntrinsicsFile) == file
    assert validate(board / "intrinsics.json").passed
    assert read_intrinsics(board / "intrinsics.json") == (camera,)


def test_the_stated_deviation_is_the_scatter_of_fits() -> None:
    places, rng = np.asarray(charuco_board().getChessboardCorners(), float), np.random.default_rng(0)
    drawn = [cv2.projectPoints(places, turn, shift, K, LENS)[0][:, 0] for turn, shift in poses(10)]
    focals, stated = [], []
    for _ in range(16):
        noisy = [intrinsics._Seen(str(k), places, xy + rng.normal(0, 0.2, xy.shape)) for k, xy in enumerate(drawn)]
        fit = intrinsics._fitted(noisy, (WIDTH, HEIGHT))
        focals.append(fit.K[0, 0])
        stated.append(fit.stds[0])
    # 16 draws: the standard error of a standard deviation is 18 %
    assert np.std(focals) == pytest.approx(np.median(stated), rel=0.55)


def test_photos_without_the_board_and_of_two_cameras_are_refused(board: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    names = sorted(path.name for path in board.glob("*.png"))
    for name in names[:7]:
        (folder / name).write_bytes((board / name).read_bytes())
    with pytest.raises(InputDataError, match=r"photos: 7 photo\(s\)\."):
        calibrate_target(folder)
    cv2.imwrite(str(folder / "wall.png"), np.full((HEIGHT, WIDTH), 90, np.uint8))
    with pytest.raises(InputDataError, match="7 of 8 photos show 12 corners of the board or more"):
        calibrate_target(folder)
    (folder / "wall.png").unlink()
    for name, focal in ((names[7], 9.0), (names[8], 12.0)):
        (folder / name).write_bytes((board / name).read_bytes())
        add_exif(folder / name, tiff(focal_mm=focal))
    with pytest.raises(InputDataError, match="photos of more than one lens"):
        calibrate_target(folder)
    assert not (folder / "intrinsics.json").exists()


def test_a_capture_takes_the_intrinsics_of_its_photos_size(file: IntrinsicsFile, board: Path, tmp_path: Path) -> None:
    root = tmp_path / "capture"
    (root / "images").mkdir(parents=True)
    (root / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    cv2.imwrite(str(root / "images" / "0.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    given = board / "intrinsics.json"
    assert gather(Capture.open(root), tmp_path / "a", given).known == {"photos": file.camera}
    cv2.imwrite(str(root / "images" / "0.png"), np.zeros((WIDTH, HEIGHT, 3), np.uint8))
    with pytest.raises(InputDataError, match="are of photos of 640x480, and no photo or video has that size"):
        gather(Capture.open(root), tmp_path / "b", given)
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"format": "cgwm-model/1"}))
    with pytest.raises(InputDataError):
        read_intrinsics(other)

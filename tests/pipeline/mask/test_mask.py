"""Masks of a body in photos without cameras: by one colour behind it, by what turns, and by a box in one photo."""

from __future__ import annotations

import json
import shutil
import struct
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.cli.mask import _summary
from cgwm.datasets.capture.exif import turned_as_file, turned_upright, upright_in_file, upright_size
from cgwm.datasets.capture.images import read_label, write_image
from cgwm.pipeline.mask import mask, mask_videos
from cgwm.pipeline.mask.doubts import doubts
from cgwm.pipeline.mask.stage import masks_report
from cgwm.pipeline.validate import validate
from cgwm.schemas import InputDataError, NotConvergedError, OutputExistsError, UsageError

HEIGHT, WIDTH, COUNT = 90, 120, 6
BOX = (40.0, 23.0, 88.0, 68.0)
"""About the disc in the first photo."""


def texture(seed: int, low: float, high: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(low, high, (HEIGHT // 6, WIDTH // 6, 3)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def scene(behind: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return photos of a reddish disc that moves a little before something that is not, and where it is."""
    rng, photos, discs = np.random.default_rng(0), [], []
    for k in range(COUNT):
        center = (64 + round(7 * np.sin(1.3 * k)), 45)
        disc = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), center, 19, 1, cv2.FILLED)
        body = texture(k, 20, 90) + np.array([140.0, 0.0, 0.0])
        back = {"one colour": np.full((HEIGHT, WIDTH, 3), 250.0), "what stands": texture(90, 0, 160),
                "what moves": texture(90 + k, 0, 160)}[behind] * np.array([0.6, 1.0, 1.0])  # fmt: skip
        image = np.where(disc[..., None] > 0, body, back) + rng.normal(0, 2, (HEIGHT, WIDTH, 3))
        photos.append(image.clip(0, 255).astype(np.uint8))
        discs.append(disc.astype(bool))
    return photos, discs


def folder(root: Path, photos: list[np.ndarray]) -> Path:
    root.mkdir(parents=True)
    for k, photo in enumerate(photos):
        write_image(root / f"{k}.png", photo)
    return root


@pytest.mark.parametrize(
    ("behind", "box", "method", "least"),
    [("one colour", None, "plain", 0.95), ("what stands", None, "turntable", 0.9), ("what moves", BOX, "box", 0.9)],
)
def test_the_body_is_cut_out(tmp_path: Path, behind: str, box: None, method: str, least: float) -> None:
    photos, discs = scene(behind)
    report = mask(folder(tmp_path / "photos", photos), tmp_path / "masks", box)
    assert report.method == method and report.label == 1 and not report.doubtful
    for k, disc in enumerate(discs):
        found = read_label(tmp_path / "masks" / f"{k}.png")
        assert set(np.unique(found)) == {0, 1}
        assert ((found > 0) & disc).sum() / ((found > 0) | disc).sum() > least
    assert validate(tmp_path / "masks").faults == ()


def test_photos_that_another_tool_has_cut_out_tell_the_body(tmp_path: Path) -> None:
    photos, discs = scene("what moves")
    (tmp_path / "photos").mkdir()
    for k, (photo, disc) in enumerate(zip(photos, discs, strict=True)):
        cut = np.dstack([photo[:, :, ::-1], np.where(disc, 255, 0).astype(np.uint8)])
        cv2.imwrite(str(tmp_path / "photos" / f"{k}.png"), cut)
    report = mask(tmp_path / "photos", tmp_path / "masks")
    assert report.method == "opacity" and "what is opaque in the photos" in str(report)
    for k, disc in enumerate(discs):
        assert ((read_label(tmp_path / "masks" / f"{k}.png") > 0) == disc).all()
    cv2.imwrite(str(tmp_path / "photos" / "9.png"), np.dstack([photos[0], np.full((HEIGHT, WIDTH), 255, np.uint8)]))
    with pytest.raises(InputDataError, match="the photos do not tell the body"):  # one is not cut out
        mask(tmp_path / "photos", tmp_path / "others")


def turn(path: Path, orientation: int) -> None:
    """Give a JPEG an EXIF orientation."""
    entry = struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, orientation, 0, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<I", 8) + entry
    data = path.read_bytes()
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_as_viewers_turn_them(tmp_path: Path, orientation: int) -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    image[8:20, 30:54] = 255
    write_image(path := tmp_path / "turned.jpg", image)
    turn(path, orientation)
    shown = cv2.imread(str(path), cv2.IMREAD_COLOR)  # OpenCV turns a photo as viewers do
    assert shown is not None and upright_size(path, (60, 40)) == shown.shape[1::-1]
    assert ((turned_upright(path, image) > 128) == (shown > 128)).all()
    assert (turned_as_file(path, shown[..., 0] > 128) == (image[..., 0] > 128)).all()
    right, lower = (np.array(side) for side in upright_in_file(path))
    # the middle of what is bright lies right of and above the middle of the picture, or as the file is turned
    in_file = np.array([42, 14]) - [30, 20]
    y, x = (values.mean() for values in np.nonzero(shown[..., 0] > 128))
    middle = np.array([x + 0.5, y + 0.5]) - np.array(shown.shape[1::-1]) / 2
    assert (in_file @ right, in_file @ lower) == pytest.approx(tuple(middle))


def test_a_box_holds_the_body_in_photos_whose_files_are_turned_differently(tmp_path: Path) -> None:
    photos, discs = scene("what moves")
    (tmp_path / "photos").mkdir()
    for k, photo in enumerate(photos):
        path = tmp_path / "photos" / f"{k}.jpg"
        write_image(path, np.rot90(photo, 1).copy() if k % 2 == 0 else photo, 97)
        if k % 2 == 0:
            turn(path, 6)
    mask(tmp_path / "photos", tmp_path / "masks", BOX)
    for k, disc in enumerate(discs):
        found, true = read_label(tmp_path / "masks" / f"{k}.png") > 0, np.rot90(disc, 1) if k % 2 == 0 else disc
        assert (found & true).sum() / (found | true).sum() > 0.85


def test_a_capture_gets_the_label_of_its_body(tmp_path: Path) -> None:
    folder(tmp_path / "capture" / "images", scene("one colour")[0])
    (tmp_path / "capture" / "capture.toml").write_text(
        'format = "cgwm-capture/1"\n[[bodies]]\nname = "a"\n[[bodies]]\nname = "b"\n'
    )
    with pytest.raises(UsageError, match=r"has 2 bodies: a, b\.\nAllowed: one body in a run\.\nNext: --body NAME"):
        mask(tmp_path / "capture", tmp_path / "capture" / "masks")
    assert mask(tmp_path / "capture", tmp_path / "capture" / "masks", body="b").label == 2
    assert set(np.unique(read_label(tmp_path / "capture" / "masks" / "0.png"))) == {0, 2}
    assert validate(tmp_path / "capture").facts["masks"] == COUNT
    with pytest.raises(OutputExistsError):
        mask(tmp_path / "capture", tmp_path / "capture" / "masks", body="b")
    report = mask(tmp_path / "capture", tmp_path / "capture" / "masks", body="a", overwrite=True)
    assert report.label == 1 and "names no body" not in _summary(report, tmp_path / "capture")
    # without bodies the masks would be a fault: what to add is said
    (tmp_path / "capture" / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    report = mask(tmp_path / "capture", tmp_path / "capture" / "masks", overwrite=True)
    assert 'add a line [[bodies]], and under it name = "object"' in _summary(report, tmp_path / "capture")
    with pytest.raises(InputDataError, match=r'a line \[\[bodies\]\], and under it name = "object"'):
        validate(tmp_path / "capture")


def test_what_cannot_be_done_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    photos = folder(tmp_path / "photos", scene("what moves")[0])
    (tmp_path / "empty").mkdir()
    shutil.copy(photos / "0.png", folder(tmp_path / "twice", []) / "a.png")
    shutil.copy(photos / "0.png", tmp_path / "twice" / "a.jpg")
    out = tmp_path / "masks"
    for call, error, text in (
        (lambda: mask(photos, out), InputDataError, "the photos do not tell the body"),
        (lambda: mask(photos, out, (10, 10, 130, 60)), UsageError, "not inside 0.png, which has 120 x 90 pixels"),
        (lambda: mask(photos, out, (10, 60, 50, 60)), UsageError, "not inside 0.png"),
        (lambda: mask(photos, out, BOX, "9.png"), UsageError, "--photo 9.png: no such photo"),
        (lambda: mask(photos, out, BOX, body="a"), UsageError, "--body a: no such body"),
        (lambda: mask(tmp_path / "empty", out), InputDataError, "no photos"),
        (lambda: mask(tmp_path / "twice", out), InputDataError, "names differ in the suffix alone"),
        (lambda: mask(tmp_path / "none", out), InputDataError, "none"),
    ):
        with pytest.raises(error, match=text):
            call()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["empty", "photos", "twice"]


def films(capture: Path) -> list[np.ndarray]:
    """Write a film of an empty place and one of a darker exposure, in which a disc and its shadow move; return it."""
    rng, place = np.random.default_rng(0), texture(7, 60, 200)

    def film(episode: str, pictures: list[np.ndarray]) -> None:
        for number, picture in enumerate(pictures):
            path = capture / "videos" / "left" / episode / f"{number:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_image(path, (picture + rng.normal(0, 2, picture.shape)).clip(0, 255).astype(np.uint8))

    discs, pictures = [], []
    for k in range(6):
        disc, shade = (
            cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (30 + 12 * k + off, 40 + off), 15, 1, cv2.FILLED) > 0
            for off in (0, 10)
        )
        shaded = np.where(shade[..., None], 0.7 * place, place)
        pictures.append(0.9 * np.where(disc[..., None], np.array([200.0, 60.0, 20.0]), shaded))
        discs.append(disc)
    film("empty", [place] * 8)
    film("000", pictures)
    (capture / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "a"\n')
    return discs


def test_a_body_is_cut_out_of_videos_by_a_film_of_the_empty_place(tmp_path: Path) -> None:
    """Also where the exposure of a film differs, and without the shadow that the body casts."""
    discs = films(tmp_path / "capture")
    out = tmp_path / "capture" / "video_masks"
    report = mask_videos(tmp_path / "capture", out, "empty")
    assert report.method == "empty" and report.body == "a" and not report.doubtful and len(report.photos) == 6
    for number, disc in enumerate(discs):
        found = read_label(out / "left" / "000" / f"{number:06d}.png") == 1
        assert (found & disc).sum() / (found | disc).sum() > 0.9
    assert validate(out).faults == () and validate(tmp_path / "capture").faults == ()
    for empty, error, text in (
        ("none", InputDataError, "no video of episode 'none'"),
        ("000", NotConvergedError, "differs from the empty place|found in"),
    ):
        with pytest.raises(error, match=text):
            mask_videos(tmp_path / "capture", out, empty, overwrite=True)
    with pytest.raises(InputDataError, match="no capture"):
        mask_videos(tmp_path / "capture" / "videos", tmp_path / "other", "empty")
    assert read_label(out / "left" / "000" / "000000.png").any() and not (tmp_path / "other").exists()


def test_a_body_that_is_lost_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = folder(tmp_path / "photos", scene("what moves")[0])
    nothing = [np.zeros((HEIGHT, WIDTH), bool)] * 4 + [np.ones((HEIGHT, WIDTH), bool)] * 2
    monkeypatch.setattr("cgwm.pipeline.mask.stage.from_box", lambda *_: nothing)
    with pytest.raises(NotConvergedError, match=r"found in 2 of 6 pictures"):
        mask(photos, tmp_path / "masks", BOX)
    assert not (tmp_path / "masks").exists()


def test_doubtful_masks_are_named() -> None:
    disc = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (60, 45), 20, 1, cv2.FILLED) > 0
    large = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), (60, 45), 30, 1, cv2.FILLED) > 0
    cut_off = np.roll(disc, 50, axis=1) & (np.arange(WIDTH) > 30)
    assert doubts([disc] * 4) == [""] * 4
    said = doubts([disc, disc, disc, large, disc, np.zeros_like(disc), cut_off])
    assert [bool(one) for one in said] == [False, False, False, True, False, True, True]
    assert said[3].startswith("the body has 2.2 times the size")
    assert said[5] == "nothing of the body was found" and "border" in said[6]
    assert doubts([disc]) == [""]
    report = masks_report("box", "", 1, [f"{k}.jpg" for k in range(3)], [disc, cut_off, cut_off])
    assert "draw these masks by hand" in str(report)
    assert "draw these masks by hand" not in str(masks_report("box", "", 1, ["0.jpg", "1.jpg"], [disc, cut_off]))


def test_changed_masks_are_faults(tmp_path: Path) -> None:
    mask(folder(tmp_path / "photos", scene("one colour")[0]), tmp_path / "masks")
    (tmp_path / "masks" / "0.png").unlink()
    write_image(tmp_path / "masks" / "1.png", np.full((HEIGHT, WIDTH), 3, np.uint8))
    write_image(tmp_path / "masks" / "2.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    faults = validate(tmp_path / "masks").faults
    assert [text in fault for text, fault in zip(("missing", "has label 3", "fills 0.0 %"), faults, strict=True)] == [
        True
    ] * 3
    listed = json.loads((tmp_path / "masks" / "masks.json").read_text())["photos"]
    assert all(a < b for a, b in pairwise(listed))

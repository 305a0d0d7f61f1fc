"""Photos of what turns before a camera that stands: they are recognised, and the surroundings found."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.images import read_label, write_image
from cgwm.pipeline.calibrate.photos import gather
from cgwm.pipeline.foreground.standing_camera import places_of_camera, probes, seems_to_stand, surroundings, turning
from cgwm.schemas import InputDataError

HEIGHT, WIDTH, COUNT = 90, 120, 12


def texture(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)).astype(np.float32), (0, 0), 1.5) * 2.0 - 128


def photos(standing: bool) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return noisy photos of a disc whose texture changes and that moves about, and where it is."""
    rng, made, discs = np.random.default_rng(0), [], []
    for k in range(COUNT):
        center = (60 + round(8 * np.sin(k)), 45)
        disc = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), center, 22, 1, cv2.FILLED)
        behind = texture(100) if standing else texture(100 + k)
        image = np.where(disc[..., None] > 0, texture(k), behind) + rng.normal(0, 2, (HEIGHT, WIDTH, 3))
        made.append(image.clip(0, 255).astype(np.uint8))
        discs.append(disc.astype(bool))
    return made, discs


def test_the_pixels_that_turn_are_found_without_masks() -> None:
    made, discs = photos(standing=True)
    assert seems_to_stand(list(pairwise(made)))
    assert places_of_camera(made) == [list(range(COUNT))]
    color, known = surroundings(made)
    for image, disc in zip(made, discs, strict=True):
        found = turning(image, color, known)
        assert (found & disc).sum() / disc.sum() > 0.98
        assert found.sum() < 1.6 * disc.sum()  # with its margin


def test_a_camera_that_moves_or_sees_no_texture_does_not_stand() -> None:
    made, discs = photos(standing=False)
    assert not seems_to_stand(list(pairwise(made))) and not places_of_camera(made)
    plain = [np.where(disc[..., None], image, 0) for image, disc in zip(made, discs, strict=True)]
    assert not seems_to_stand(list(pairwise(plain)))
    assert not seems_to_stand([]) and not seems_to_stand([(made[0], made[0][1:])])
    assert probes(["a"]) == [] and probes(["a", "b", "c"]) == [("a", "b"), ("b", "c")]


def test_each_place_of_the_camera_has_its_own_surroundings() -> None:
    low, _ = photos(standing=True)
    high = [image[::-1].copy() for image in low]
    assert places_of_camera([*low[:6], *high[:7]]) == [list(range(6)), list(range(6, 13))]
    assert places_of_camera([*low[:6], *high[:2]]) == []  # a quarter of the photos is from no such place


def capture(root: Path, images: list[np.ndarray]) -> Path:
    (root / "images").mkdir(parents=True)
    (root / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    for k, image in enumerate(images):
        write_image(root / "images" / f"{k:02d}.png", image)
    return root


def test_features_are_taken_from_what_turns_and_from_given_masks(tmp_path: Path) -> None:
    made, discs = photos(standing=True)
    root = capture(tmp_path / "capture", made)
    given = np.zeros((HEIGHT, WIDTH), np.uint8)
    given[:5, :5] = 1
    (root / "masks").mkdir()
    write_image(root / "masks" / "00.png", given)
    inputs = gather(Capture.open(root, check=False), tmp_path / "work")
    assert any("the camera stands and what it shows turns" in note for note in inputs.notes)
    first = inputs.sources[0].image
    assert first.mask is not None
    kept = read_label(first.mask / f"{first.name}.png") > 0
    assert kept[:5, :5].all() and kept[discs[0]].mean() > 0.98 and kept.mean() < 0.4
    assert gather(Capture.open(root, check=False), tmp_path / "again", turntable=False).sources[0].image.mask is None


def test_photos_that_are_all_the_same_are_refused(tmp_path: Path) -> None:
    made, _ = photos(standing=True)
    with pytest.raises(InputDataError, match=r"all photos are the same"):
        gather(Capture.open(capture(tmp_path / "capture", [made[0]] * 5)), tmp_path / "work")

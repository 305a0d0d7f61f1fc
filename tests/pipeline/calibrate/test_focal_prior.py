"""Focal lengths: EXIF data count where the matches leave the focal length open, and not where they contradict it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.exif import photo_lens
from cgwm.pipeline.calibrate.center_uncertainty import center_stds, focal_stds
from cgwm.pipeline.calibrate.focal_prior import EXIF_STD, FocalLength
from cgwm.pipeline.calibrate.photos import gather
from helpers.exif import add_exif, tiff
from helpers.sfm_scene import make_scene


def _focal(matches_px: float, std: float) -> FocalLength:
    return FocalLength(exif_px=1000.0, matches_px=matches_px, matches_std=std)


def test_the_mean_is_weighted_by_information() -> None:
    assert _focal(1020.0, EXIF_STD).combined_px == pytest.approx(np.sqrt(1000.0 * 1020.0))
    assert _focal(1020.0, 1e-4).combined_px == pytest.approx(1020.0, rel=1e-4)
    assert _focal(1020.0, np.inf).combined_px == pytest.approx(1000.0)


def test_a_contradiction_drops_the_exif_data() -> None:
    cut_out = _focal(2000.0, 0.005)
    assert not cut_out.agree
    assert cut_out.combined_px == 2000.0
    assert _focal(2000.0, 0.5).agree


def test_the_focal_length_scatters_as_stated_and_exif_data_bound_it() -> None:
    model = make_scene(images=6, points=200, noise_px=0.5, outliers=0.0, seed=0)[0]
    models = {"photos": "RADIAL"}
    few = replace(model, observations={n: (xy[:8], index[:8]) for n, (xy, index) in model.observations.items()})
    assert focal_stds(few, models)["photos"] > 2 * focal_stds(model, models)["photos"] > 0
    assert focal_stds(model, {}) == {}
    free, bound = (np.array(list(center_stds(few, models, exif).values())) for exif in ((), ("photos",)))
    assert (bound < free).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_lens_is_read_and_damaged_data_count_as_absent(tmp_path: Path, suffix: str) -> None:
    photo = tmp_path / f"a{suffix}"
    cv2.imwrite(str(photo), np.zeros((6, 8, 3), np.uint8))
    assert photo_lens(photo) == ""
    add_exif(photo, tiff("Maker", "Model Two", 4.25, 26))
    assert photo_lens(photo) == "Maker Model Two 4.25 mm 26 mm (35 mm)"
    data = photo.read_bytes()
    start = data.index(b"II*\0")
    for k in range(start, start + 120):  # a wrong byte anywhere changes the text, or drops it
        photo.write_bytes(data[:k] + b"\xff" + data[k + 1 :])
        assert isinstance(photo_lens(photo), str)


def test_photos_of_two_lenses_have_intrinsics_of_their_own(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    (root / "images").mkdir(parents=True)
    (root / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    for k, focal in enumerate((4.25, 4.25, 9.0, None)):
        photo = root / "images" / f"{k}.jpg"
        cv2.imwrite(str(photo), np.zeros((60, 80, 3), np.uint8))
        if focal is not None:
            add_exif(photo, tiff(focal_mm=focal))
    inputs = gather(Capture.open(root), tmp_path / "work")
    cameras = [source.image.camera for source in inputs.sources]
    assert cameras == ["photos-lens1", "photos-lens1", "photos-lens2", "photos-lens1"]
    assert any("EXIF data name 2 lenses" in note for note in inputs.notes)
    assert "1.jpg is the same photo as 0.jpg: remove one" in inputs.notes

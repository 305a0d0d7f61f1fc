"""The exposure of video cameras, from frames with a known gain."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.images import read_rgb, write_image
from cgwm.pipeline.phys_geo.images.video_exposure import estimate_exposures, fit_exposure
from cgwm.pipeline.rendering.video_view import expose
from cgwm.schemas import Exposure
from helpers.small_model import small_model
from helpers.thrown_cube import EXPOSURE, add_video, truth, write_capture


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = write_capture(tmp_path_factory.mktemp("exposure") / "capture", episodes=1)
    add_video(root)
    return root


def test_known_gain_is_found(root: Path) -> None:
    found = estimate_exposures(small_model(), Capture.open(root), "test", "cpu")
    assert list(found) == ["left"]
    assert found["left"].gain_rgb == pytest.approx(EXPOSURE.gain_rgb, abs=0.01)
    assert found["left"].offset_rgb == (0.0, 0.0, 0.0)


def test_body_and_shadow_do_not_count(root: Path) -> None:
    """A dark band over a fifth of the frame, noise, and a body without masks move the gain by less than 2 %."""
    rng = np.random.default_rng(0)
    for path in sorted((root / "videos" / "left" / "000").iterdir()):
        image = read_rgb(path).astype(float)
        image[:, :19] *= 0.6
        write_image(path, (image + 4 * rng.standard_normal(image.shape)).clip(0, 255).astype(np.uint8))
    for path in (root / "video_masks" / "left" / "000").iterdir():
        path.unlink()
    (root / "video_masks" / "left" / "000").rmdir()
    found = estimate_exposures(small_model(), Capture.open(root), "test", "cpu")
    assert found["left"].gain_rgb == pytest.approx(EXPOSURE.gain_rgb, rel=0.02)


def test_offset_only_where_it_is_clear() -> None:
    rng = np.random.default_rng(1)
    colours = rng.uniform(0.2, 0.8, (500, 3))
    noise = 0.01 * rng.standard_normal((500, 3))
    plain = fit_exposure(colours, colours * [0.9, 1.0, 1.1] + noise)
    assert plain.offset_rgb == (0.0, 0.0, 0.0)
    assert plain.gain_rgb == pytest.approx((0.9, 1.0, 1.1), abs=0.005)
    lifted = fit_exposure(colours, 0.7 * colours + 0.15 + noise)
    assert lifted.gain_rgb == pytest.approx((0.7, 0.7, 0.7), abs=0.01)
    assert lifted.offset_rgb == pytest.approx((0.15, 0.15, 0.15), abs=0.01)


def test_exposure_is_applied_as_it_is_estimated() -> None:
    picture = np.full((1, 1, 3), 102, np.uint8)
    exposure = Exposure(gain_rgb=(0.5, 1.0, 3.0), offset_rgb=(0.1, 0.0, 0.0))
    assert expose(picture, exposure)[0, 0] == pytest.approx([0.3, 0.4, 1.0], abs=1e-6)


def test_model_without_scene_has_no_exposure(root: Path) -> None:
    assert estimate_exposures(replace(truth(), scene=None), Capture.open(root), "test") == {}

"""How long frames are exposed, from films whose exposure is known; frames of the model over it repeat them better."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.images import write_image
from cgwm.datasets.models.model import Model
from cgwm.pipeline.evaluate.stage import evaluate_model
from cgwm.pipeline.phys_geo.images.exposure_time import DURATIONS, best_duration, with_durations
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.rendering.motion_blur import poses_at
from cgwm.pipeline.rendering.video_view import expose
from helpers.thrown_cube import EXPOSURE, VIDEO_HZ, add_video, camera, thrown, truth, write_capture

EXPOSED_S = 0.5 / VIDEO_HZ


def film(root: Path, exposed_s: float) -> Capture:
    """Film a throw with exposures of a duration, as means of many instants."""
    capture = write_capture(root / "capture", episodes=1)
    add_video(capture)
    times, motion = thrown(0)
    renderer = LabelRenderer(truth(), {"left": camera()})
    for path in sorted((capture / "videos" / "left" / "000").iterdir()):
        at = int(path.stem) / VIDEO_HZ + exposed_s * (np.arange(9) - 4) / 9
        blocks = list(renderer.blocks(*poses_at(times, motion.position_m, motion.quat_wxyz, at)))
        mean = np.asarray(np.concatenate([block.image for block in blocks]).mean(0), np.float32)
        write_image(path, (255 * expose(mean[None], EXPOSURE)[0]).round().astype(np.uint8))
    return Capture.open(capture)


def psnr_db(model: Model, capture: Capture) -> float:
    found = evaluate_model(model, capture, "test", 0.1, "cpu").result
    assert found.psnr_object_db is not None
    return found.psnr_object_db.mean


@pytest.mark.parametrize("exposed_s", [EXPOSED_S, 0.0])
def test_the_duration_of_an_exposure_is_found(tmp_path: Path, exposed_s: float) -> None:
    capture = film(tmp_path, exposed_s)
    found = with_durations(truth(), capture, "test", device="cpu")
    assert found.file.exposures["left"].duration_s == pytest.approx(exposed_s, abs=0.1 / VIDEO_HZ)
    assert found.file.exposures["left"].gain_rgb == EXPOSURE.gain_rgb
    if exposed_s:
        assert psnr_db(found, capture) > psnr_db(truth(), capture) + 0.5


def test_what_chance_explains_is_no_exposure() -> None:
    rng = np.random.default_rng(0)
    flat = 1 + 0.01 * rng.standard_normal((8, len(DURATIONS)))
    assert best_duration(flat) == 0.0
    bowl = flat + (np.array(DURATIONS) - 0.4) ** 2
    assert best_duration(bowl) == pytest.approx(0.4, abs=0.05)

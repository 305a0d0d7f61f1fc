"""Evaluation of a capture that was filmed but not tracked: poses come from the videos; those are put in place here."""

import math
from pathlib import Path

import pytest
import torch
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.evaluate.stage import evaluate
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseQuality, PoseTrack, PoseTracker
from cgwm.schemas import EvalResult, InputDataError, NotConvergedError, UsageError
from helpers.thrown_cube import RATE_HZ, VIDEO_HZ, add_video, thrown, truth, with_friction, write_capture

pytestmark = pytest.mark.usefixtures("one_thread")
STD_M, STD_RAD = 2e-4, 2e-3


def tracked(bias_m: float = 0.0) -> PoseTrack:
    """Return the true poses at the video's frames, shifted along y."""
    _, motion = thrown(0)
    rows = slice(0, None, round(RATE_HZ / VIDEO_HZ))
    position, quat = (torch.tensor(values[rows]) for values in (motion.position_m, motion.quat_wxyz))
    count = len(position)
    covariance = torch.diag(torch.tensor([STD_M**2] * 3 + [STD_RAD**2] * 3).double()).expand(count, 6, 6)
    ones = torch.ones(count)
    return PoseTrack(
        position_m=position + torch.tensor([0.0, bias_m, 0.0]), quat_wxyz=quat, curvature=covariance,
        covariance=covariance, loss=ones, quality=PoseQuality(ones, ones, ones, ones), found=ones > 0, searches=1,
        rival_nats=math.inf,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("images")
    add_video(write_capture(root / "capture", episodes=1))
    (root / "capture" / "tracks" / "000.csv").unlink()
    write_model(root / "true", truth())
    write_model(root / "slippery", with_friction(0.1))
    return root


def by_images(folder: Path, model: str, track: PoseTrack, page: Path | None = None) -> EvalResult:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PoseTracker, "run", lambda self: track)
        return evaluate(folder / model, folder / "capture", device="cpu", page=page)


@pytest.fixture(scope="module")
def right(folder: Path) -> EvalResult:
    return by_images(folder, "true", tracked(), folder / "eval.html")


def test_a_wrong_friction_is_seen_without_tracks(folder: Path, right: EvalResult) -> None:
    wrong = by_images(folder, "slippery", tracked())
    assert right.reference == wrong.reference == "images"
    assert wrong.translation_error_m.median > 5 * right.translation_error_m.median
    assert right.mask_iou is not None and wrong.mask_iou is not None
    assert right.mask_iou.median > 0.95 and wrong.mask_iou.median < 0.8
    assert right.centroid_error_px is not None and wrong.centroid_error_px is not None
    assert right.centroid_error_px.median < 0.2 and wrong.centroid_error_px.median > 2
    assert right.centroid_error_m is None  # one camera
    (left,) = wrong.per_episode[0].filmed
    assert len(left.time_s) == len(left.mask_iou) == wrong.per_episode[0].frames
    assert left.mask_iou[0] is not None and left.mask_iou[-1] is not None and left.mask_iou[0] > left.mask_iou[-1]


def test_intervals_are_of_one_frame_along_the_error(right: EvalResult) -> None:
    episode = right.per_episode[0]
    assert episode.translation_interval_95_m is not None and episode.rotation_interval_95_deg is not None
    high = episode.translation_interval_95_m[1]
    assert high - episode.translation_error_m == pytest.approx(1.96 * STD_M, rel=1e-3)
    assert episode.rotation_error_deg is not None
    turned = episode.rotation_interval_95_deg[1] - episode.rotation_error_deg
    assert turned == pytest.approx(math.degrees(1.96 * STD_RAD), rel=1e-3)


def test_the_page_shows_figures_and_frames(folder: Path, right: EvalResult) -> None:
    html = (folder / "eval.html").read_text()
    assert right.report == str(folder / "eval.html")
    for words in (
        "Silhouettes over time",
        "above as filmed, below as predicted",
        "data:image/jpeg",
        "Poses were found",
    ):
        assert words in html
    with pytest.raises(UsageError, match="exists"):
        by_images(folder, "slippery", tracked(), folder / "eval.html")


def test_an_error_of_the_reference_is_seen_by_masks_alone(folder: Path, right: EvalResult) -> None:
    """A reference that is wrong by 4 mm moves the prediction with it, and not the masks."""
    moved = by_images(folder, "true", tracked(0.004))
    assert moved.translation_error_m.median < right.translation_error_m.median + 1e-3
    assert right.centroid_error_px is not None and moved.centroid_error_px is not None
    assert moved.centroid_error_px.median > right.centroid_error_px.median + 0.3


def test_refusals(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = folder / "capture"
    with pytest.raises(InputDataError, match="no track of 'cube'") as asked:
        evaluate(folder / "true", capture, device="cpu", reference="tracks")
    assert "cgwm eval finds poses in the videos" in str(asked.value)
    bare = write_capture(tmp_path / "bare", episodes=1)
    with pytest.raises(InputDataError, match="no episode of split 'test' has a video"):
        evaluate(folder / "true", bare, device="cpu", reference="images")

    def lost(self: PoseTracker) -> PoseTrack:
        raise NotConvergedError("000: the body was found in 1 of 13 instants.")

    monkeypatch.setattr(PoseTracker, "run", lost)
    with pytest.raises(InputDataError, match=r"found in no video of split 'test'.*1 of 13 instants"):
        evaluate(folder / "true", capture, device="cpu")

"""Evaluation of a capture that was filmed but not tracked: poses come from the videos; those are put in place here."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.evaluate.filmed_poses import SHARED_PX, PoseUncertainty, shared_covariance
from cgwm.pipeline.evaluate.prediction import EpisodePrediction, Motion
from cgwm.pipeline.evaluate.stage import evaluate
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseQuality, PoseTrack, PoseTracker
from cgwm.pipeline.phys_geo.images.video_frames import Footage, Video
from cgwm.schemas import EvalResult, InputDataError, NotConvergedError, UsageError
from helpers.thrown_cube import RATE_HZ, VIDEO_HZ, add_video, camera, thrown, truth, with_friction, write_capture

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


def test_intervals_are_of_one_frame_along_the_error() -> None:
    """The error is along x: its standard deviation counts, and that of a turn about the mean axis."""
    times, motion = np.arange(3) / 30.0, np.zeros((3, 1, 3))
    still = np.tile([1.0, 0, 0, 0], (3, 1, 1))
    ones = np.ones((3, 1), bool)
    prediction = EpisodePrediction(
        episode="000", bodies=("cube",), free=(0,), time_s=times, warmup=times < 0.01, position_m=motion,
        quat_wxyz=still, seen=ones, turned=ones, grid_s=times, rows=np.arange(3),
        motions={"model": Motion(motion + np.array([0.01, 0, 0]), still)}, noise_floor_m=0.0, state_fitted_m=None,
    )  # fmt: skip
    covariance = np.diag(np.square([0.001, 9, 9, 0.01, 0.02, 0.02]))
    known = PoseUncertainty(times, np.tile(covariance, (3, 1, 1)))
    moved, turned = known.intervals(prediction, 0.01, 5.0)
    assert moved == pytest.approx((0.01 - 0.00196, 0.01 + 0.00196), abs=1e-6)
    assert turned[1] - 5.0 == pytest.approx(math.degrees(1.96 * math.sqrt(3e-4)), rel=1e-4)


def test_what_all_frames_share_is_least_across_the_view_and_largest_along_it() -> None:
    frames = torch.zeros(1, 72, 96, 3)
    view = torch.tensor(camera().T_cam_world)[None]
    video = Video(
        camera="left", times_s=np.zeros(1), frames=frames, covers=None, K=torch.tensor(camera().K), viewmats=view
    )
    place, radius, focal = np.zeros(3), 0.04, 90.0
    away = float(np.linalg.norm(camera().center - place))
    covariance = shared_covariance(Footage.of("000", (video,)), 0, place, radius)
    std = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]))
    assert std[0] == pytest.approx(SHARED_PX * away / focal, rel=0.05)
    assert std[2] == pytest.approx(SHARED_PX * away**2 / (focal * radius), rel=0.05)
    assert np.sqrt(covariance[3, 3]) == pytest.approx(SHARED_PX * away / (focal * radius), rel=0.05)
    two = shared_covariance(Footage.of("000", (video, video)), 0, place, radius)
    assert two == pytest.approx(covariance / 2)


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
    track = tracked(0.004)
    track.quat_wxyz[-2:] = torch.tensor([0.0, 0, 0, 1]).double()  # taken for its other side
    moved = by_images(folder, "true", track)
    assert [len(one.warnings) for one in (right, moved)] == [1, 2] and "from one frame to the next" in moved.warnings[1]
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

"""Open-loop errors against measurements made by our own engine, so that the right answer is known."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Episode, Track, write_tracks
from cgwm.datasets.models.model import write_model
from cgwm.pipeline.evaluate.evaluation import Evaluation
from cgwm.pipeline.evaluate.prediction import Motion
from cgwm.pipeline.evaluate.stage import WARMUP_S, _outlasted, evaluate, evaluate_model
from cgwm.pipeline.physics import State, world_of_model
from cgwm.pipeline.physics.engine import rollout as roll_out
from cgwm.pipeline.trajectories.state_uncertainty import covariance_root
from cgwm.schemas import EvalResult, InputDataError, SynthesizeConfig, UsageError
from helpers.small_model import HALF, small_model
from helpers.thrown_cube import (
    FRAMES,
    NOISE_M,
    RATE_HZ,
    add_video,
    measured,
    quick,
    thrown,
    truth,
    with_friction,
    write_capture,
)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    root = write_capture(tmp_path_factory.mktemp("eval") / "capture")
    add_video(root)
    return Capture.open(root)


@pytest.fixture(scope="module")
def perfect(capture: Capture) -> Evaluation:
    torch.set_num_threads(1)
    return evaluate_model(truth(), capture, keep_frames=True)


def test_true_model_is_as_good_as_the_noise_allows(perfect: Evaluation) -> None:
    result = perfect.result
    assert result.episodes == 3
    assert result.state_noise_floor_m is not None and result.state_fitted_residual_m is not None
    floor = np.hypot(result.state_noise_floor_m.median, NOISE_M * np.sqrt(8 / np.pi))  # mean distance of 3D noise
    assert result.translation_error_m.median < 3 * floor
    assert result.rotation_error_deg is not None and result.rotation_error_deg.median < 3.0
    # a state fitted to all frames leaves little more than the noise
    assert result.state_fitted_residual_m.median < 2 * NOISE_M * np.sqrt(8 / np.pi)


@pytest.fixture(scope="module")
def slippery(capture: Capture) -> EvalResult:
    return evaluate_model(with_friction(0.1), capture).result


def test_state_fit_is_never_worse_than_open_loop(slippery: EvalResult) -> None:
    for episode in slippery.per_episode:
        assert episode.state_fitted_residual_m is not None
        assert episode.state_fitted_residual_m <= episode.translation_error_m + 1e-9


def test_wrong_friction_is_told_from_the_right_one(slippery: EvalResult, perfect: Evaluation) -> None:
    wrong = slippery
    assert wrong.translation_error_m.median > 5 * perfect.result.translation_error_m.median
    assert wrong.translation_error_m.final is not None
    assert wrong.translation_error_m.final > wrong.translation_error_m.median  # it goes on sliding
    assert wrong.psnr_object_db is not None and perfect.result.psnr_object_db is not None
    assert wrong.psnr_object_db.median < perfect.result.psnr_object_db.median - 3
    assert wrong.ssim is not None and perfect.result.ssim is not None
    assert wrong.ssim.median < perfect.result.ssim.median <= 1


def test_baselines_are_much_worse(perfect: Evaluation) -> None:
    result = perfect.result
    for name in ("frozen", "ballistic"):
        figures = result.baselines[name]
        assert figures["translation_error_m"]["median"] > 10 * result.translation_error_m.median
        assert result.psnr_object_db is not None
        assert figures["psnr_object_db"]["median"] < result.psnr_object_db.median - 5


def test_baselines_are_what_they_say(perfect: Evaluation) -> None:
    prediction = perfect.episodes[0].prediction
    last = np.flatnonzero(prediction.warmup)[-1]
    frozen, _ = prediction.predicted("frozen")
    assert np.array_equal(frozen, np.broadcast_to(prediction.position_m[last], frozen.shape))
    flying, _ = prediction.predicted("ballistic")
    predicted, _ = prediction.predicted()
    assert np.allclose(flying[last], predicted[last], atol=1e-12)
    bend = np.diff(flying[:, 0], 2, axis=0) * RATE_HZ**2
    assert np.allclose(bend, [0, 0, -9.81], atol=1e-6)


def test_result_has_every_figure(perfect: Evaluation) -> None:
    printed = json.loads(perfect.result.model_dump_json())
    assert set(printed) == set(EvalResult.model_fields)
    for name in ("translation_error_m", "rotation_error_deg"):
        assert set(printed[name]) == {"mean", "median", "final"} and printed[name]["final"] > 0
    episodes = printed["per_episode"]
    assert [episode["episode"] for episode in episodes] == ["000", "001", "002"]
    means = [episode["translation_error_m"] for episode in episodes]
    assert printed["translation_error_m"]["mean"] == pytest.approx(np.mean(means))
    assert printed["translation_error_m"]["median"] == pytest.approx(np.median(means))
    # only the first episode was filmed
    assert episodes[0]["psnr_db"] > 25 and episodes[1]["psnr_db"] is None
    assert printed["psnr_db"]["mean"] == episodes[0]["psnr_db"]
    assert printed["warnings"] == []


def test_two_evaluations_agree_bit_for_bit(capture: Capture) -> None:
    first, second = (evaluate_model(truth(), capture, brief=True).result for _ in range(2))
    assert first.model_dump_json() == second.model_dump_json()


def test_covariance_root_is_one() -> None:
    factor = torch.tensor(np.random.default_rng(4).standard_normal((2, 12, 12))).double()
    covariance = factor @ factor.transpose(1, 2) * torch.logspace(-4, 1, 12)[:, None] * torch.logspace(-4, 1, 12)
    root = covariance_root(covariance)
    scale = covariance.diagonal(dim1=1, dim2=2).sqrt()
    error = (root @ root.transpose(1, 2) - covariance) / (scale[:, :, None] * scale[:, None])
    assert float(error.abs().max()) < 1e-8


@pytest.mark.parametrize("angle", [1e-6, 0.3, 3.0, 6.0])
def test_rotation_error_is_the_geodesic_angle(perfect: Evaluation, angle: float) -> None:
    prediction = perfect.episodes[0].prediction
    turn = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    ones = np.tile([1.0, 0.0, 0.0, 0.0], (len(prediction.grid_s), 1, 1))
    turned = replace(
        prediction,
        quat_wxyz=np.broadcast_to(turn, prediction.quat_wxyz.shape),
        motions={"model": Motion(prediction.motions["model"].position_m, ones)},
    )
    wanted = np.degrees(min(angle, 2 * np.pi - angle))
    assert turned.rotation_error_deg() == pytest.approx(wanted, rel=1e-9)


def test_warm_up_ends_before_the_first_contact(perfect: Evaluation) -> None:
    for seed, episode in enumerate(perfect.episodes):
        times, motion = thrown(seed)
        touches = times[np.argmax(motion.position_m[:, 0, 2] < HALF + 1e-3)]
        assert 0.05 < episode.prediction.warmup_end_s <= min(0.1, touches) + 1e-9
        assert episode.errors.frames == FRAMES - int(episode.prediction.warmup.sum())


def test_frames_are_kept_side_by_side(perfect: Evaluation) -> None:
    (video,) = perfect.episodes[0].videos
    assert video.real is not None and video.predicted is not None
    assert video.real.shape == video.predicted.shape == (len(video.time_s), 72, 96, 3)
    assert video.time_s.min() > perfect.episodes[0].prediction.warmup_end_s
    difference = np.abs(video.real.astype(float) - video.predicted).mean()
    assert difference < 3  # of 255: gain and camera are right, and the cube is nearly where it was


def test_without_masks_it_says_so(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture", episodes=1)
    add_video(root, masks=False)
    result = evaluate_model(truth(), Capture.open(root)).result
    assert result.psnr_object_db is not None
    assert any("predicted mask alone" in warning for warning in result.warnings)


def test_centroid_tracks_have_no_rotation(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture", episodes=1, turned=False)
    result = evaluate_model(truth(), Capture.open(root), brief=True).result
    assert result.rotation_error_deg is None
    assert result.per_episode[0].rotation_error_deg is None
    assert result.baselines["frozen"]["rotation_error_deg"] is None
    assert result.baselines["frozen"]["translation_error_m"]["median"] > 0.05


def test_times_that_scatter_about_a_clock_change_no_error(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture", episodes=1)
    right = evaluate_model(truth(), Capture.open(root), brief=True).result
    (name,) = Capture.open(root).episodes("test")
    tracks = Capture.open(root).tracks(name)
    scatter = 2e-3 * np.random.default_rng(1).uniform(-1, 1, len(tracks["cube"].time_s))
    late = {body: replace(track, time_s=track.time_s + scatter) for body, track in tracks.items()}
    write_tracks(root / "tracks" / f"{name}.csv", late, overwrite=True)
    found = evaluate_model(truth(), Capture.open(root), brief=True).result
    assert any("follows the clock" in warning for warning in found.warnings)
    assert found.translation_error_m.median == pytest.approx(right.translation_error_m.median, rel=0.1)


def test_driven_body_follows_its_track(tmp_path: Path) -> None:
    """The tip pushes the resting cube; without its track the episode cannot be predicted."""
    root = write_capture(tmp_path / "capture", episodes=2)
    text = (root / "capture.toml").read_text()
    tip = '[[bodies]]\nname = "tip"\nmotion = "driven"\nshape = { sphere = { radius_m = 0.012 } }\n[measurement]'
    (root / "capture.toml").write_text(text.replace("[measurement]", tip))
    model = quick(small_model(driven=True))
    times = np.arange(FRAMES) / RATE_HZ
    path = np.stack([0.11 - 0.25 * np.maximum(times - 0.1, 0), 0 * times, 0 * times + 0.04], 1)
    command = Track(times, path, np.tile([1.0, 0, 0, 0], (FRAMES, 1)))
    rest = torch.tensor([[[0.0, 0.0, HALF - 2e-4], [0.0, 0.0, 0.0]]]).double()
    unturned = torch.tensor([[[1.0, 0.0, 0.0, 0.0]] * 2]).double()
    state = State(rest, unturned, torch.zeros(1, 2, 3).double(), torch.zeros(1, 2, 3).double())
    rollout = roll_out(world_of_model(model), state, torch.tensor(times), {"tip": command})
    motion = Motion(rollout.position_m[0].numpy(), rollout.quat_wxyz[0].numpy())
    assert motion.position_m[-1, 0, 0] < -0.03  # it was pushed
    cube = measured(times, motion, 0)
    write_tracks(root / "tracks" / "000.csv", {"cube": cube, "tip": command}, overwrite=True)
    write_tracks(root / "tracks" / "001.csv", {"cube": cube}, overwrite=True)
    result = evaluate_model(model, Capture.open(root), brief=True).result
    assert result.translation_error_m.median < 0.002
    assert result.baselines["frozen"]["translation_error_m"]["median"] > 0.01
    assert result.warnings == ("episode '001' is left out: no track of 'tip'.",)


def test_dataset_of_the_model_itself(tmp_path: Path) -> None:
    from cgwm.pipeline.synthesize import synthesize

    path = tmp_path / "model"
    write_model(path, quick(small_model(visible=False)))
    config = SynthesizeConfig.model_validate({"rollouts": 2, "seed": 3, "compression": "gzip", "duration_s": 0.6})
    synthesize(path, tmp_path / "data", config)
    result = evaluate(path, tmp_path / "data")
    assert result.episodes == 2
    assert [episode.episode for episode in result.per_episode] == ["demo_0", "demo_1"]
    assert result.psnr_db is None
    assert result.translation_error_m.median < 0.1 * result.baselines["frozen"]["translation_error_m"]["median"]


def test_other_bodies_are_refused(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture", episodes=1, body="box")
    with pytest.raises(InputDataError, match=r"the model's bodies are 'cube'; those of .* are 'box'"):
        evaluate_model(truth(), Capture.open(root))


def test_splits_without_episodes_are_refused(capture: Capture) -> None:
    with pytest.raises(UsageError, match="no split 'tset'"):
        evaluate_model(truth(), capture, "tset")
    with pytest.raises(InputDataError, match="no episode of split 'empty' can be evaluated"):
        evaluate_model(truth(), capture, "empty")


def test_unscaled_cameras_are_refused(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "capture", episodes=1)
    add_video(root, kind="unscaled")
    with pytest.raises(InputDataError, match="The cameras are unscaled"):
        evaluate_model(truth(), Capture.open(root))


def test_model_without_physics_is_refused(capture: Capture) -> None:
    model = truth()
    model = replace(model, file=model.file.model_copy(update={"contact": None}))
    with pytest.raises(InputDataError, match="no fitted physics"):
        evaluate_model(model, capture)


def test_a_usual_warm_up_that_no_episode_outlasts_is_half_of_the_longest() -> None:
    long = [Episode("0", {"cube": Track(np.arange(0, 0.3, 0.1), np.zeros((3, 3)))})]
    short = [Episode("0", {"cube": Track(np.array([0.0, 0.03, 0.08]), np.zeros((3, 3)))})]
    warnings: list[str] = []
    assert _outlasted(WARMUP_S, long, warnings) == WARMUP_S and _outlasted(5.0, short, warnings) == 5.0
    assert not warnings and _outlasted(WARMUP_S, short, warnings) == pytest.approx(0.04)
    assert warnings == ["no episode is longer than 80 ms: models see the first half of it."]


def test_warm_up_longer_than_every_episode_is_refused(capture: Capture) -> None:
    rest = quick(small_model(visible=False))
    position = Motion(np.tile([0.0, 0.0, HALF], (FRAMES, 1, 1)), np.tile([1.0, 0, 0, 0], (FRAMES, 1, 1)))
    with pytest.raises(InputDataError, match="in none of the episodes does a measured frame follow the warm-up"):
        _at_rest(capture.root.parent / "rest", position)
        evaluate_model(rest, Capture.open(capture.root.parent / "rest"), warmup_s=5.0, brief=True)


def _at_rest(root: Path, motion: Motion) -> None:
    write_capture(root, episodes=1)
    path = root / "tracks" / "000.csv"
    write_tracks(path, {"cube": measured(np.arange(FRAMES) / RATE_HZ, motion, 0)}, overwrite=True)

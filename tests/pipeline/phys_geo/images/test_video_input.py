"""Bad videos for `cgwm fit --supervise images`: one clear message, exit code 2, nothing left behind."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.images import read_rgb, write_image
from cgwm.datasets.capture.tracks import Track
from cgwm.pipeline.phys_geo.images.image_loss import ImageLoss
from cgwm.pipeline.phys_geo.images.video_checks import examine_tracks, examine_videos
from cgwm.pipeline.phys_geo.images.video_frames import Footage, load_footage
from cgwm.pipeline.phys_geo.tracks.contact_result import ContactEstimate, FitRecord, PhysicsFit, physics_fit
from cgwm.pipeline.physics.effects.effect import ActiveEffect
from cgwm.pipeline.physics.effects.registry import load_effect
from cgwm.pipeline.physics.parameters import (
    CONTACT_PARAMETERS,
    CONTACT_TIME,
    DAMPING_RATIO,
    FRICTION,
    GROUND_SHIFT,
    effect_parameters,
    mass_distribution,
)
from cgwm.pipeline.segments.fitted_parameters import bound_warnings, fitted_parameter
from cgwm.pipeline.trajectories.track_noise import Noise
from cgwm.schemas import InputDataError, read_json
from cgwm.schemas.model import FitFile, ModelFile
from helpers.commands import cgwm
from helpers.pose_search import search_briefly
from helpers.tiny_capture import (
    CAMERAS,
    EPISODE,
    FAST,
    FRAMES,
    HEIGHT,
    RATE_HZ,
    WIDTH,
    change_masks,
    model_of,
    thrown,
    tiny_model,
    with_manifest,
    with_tracks,
    write_cameras,
    write_tiny_capture,
)
from helpers.worlds import F64, ball_body, box_body, world_of


def fit(root: Path, *options: str) -> tuple[int, str, Path]:
    """Run the command; return exit code, what it said, and where the model would be."""
    out = root.with_name("fitted")
    words = ["fit", root, "--out", out, "--from", model_of(root), "--stage", "phys-geo", "--device", "cpu"]
    done = cgwm(*words, *(options or ("--supervise", "images")), *FAST)
    return done.returncode, done.stderr, out


def refused(root: Path, *options: str) -> str:
    """Check that a fit is refused as bad input and leaves nothing behind; return the message."""
    before = sorted(path.name for path in root.parent.iterdir())
    code, said, _ = fit(root, *options)
    assert code == 2, said
    assert "Traceback" not in said and "\nAllowed: " in said and "\nNext: " in said
    assert sorted(path.name for path in root.parent.iterdir()) == before
    return said


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tiny_capture(tmp_path / "capture")


def without_masks(root: Path) -> None:
    (root / "video_masks").rename(root / "elsewhere")


def test_video_and_camera_of_different_sizes(root: Path) -> None:
    write_cameras(root, CAMERAS | {"right": CAMERAS["right"].resized(2 * WIDTH, 2 * HEIGHT)})
    said = refused(root)
    assert f"videos/right/{EPISODE}: 64x48 px, but its camera 'right' has 128x96 px" in said
    with pytest.raises(InputDataError, match=r"frames of 64x48 pixels(.|\n)*128x96(.|\n)*calibrate"):
        load_footage(Capture.open(root, check=False), EPISODE, 64)


@pytest.mark.parametrize("frames", [pytest.param(1, marks=pytest.mark.evidence), 2])
def test_fewer_than_three_frames(root: Path, frames: int) -> None:
    end_s = (frames - 0.9) / RATE_HZ
    with_manifest(root, "[video]", f"[episodes]\n{EPISODE} = {{ end_s = {end_s} }}\n[video]")
    said = refused(root)
    assert re.search(rf"videos/left/{EPISODE}: .*{frames} frame", said)
    assert frames == 1 or "at least 3" in said


def test_three_frames_are_enough_to_look_at(root: Path) -> None:
    with_manifest(root, "[video]", f"[episodes]\n{EPISODE} = {{ end_s = {2.1 / RATE_HZ} }}\n[video]")
    assert len(load_footage(Capture.open(root), EPISODE, 64).times_s) == 3


@pytest.mark.parametrize("masks", [True, False])
def test_a_video_in_which_nothing_moves(tmp_path: Path, masks: bool) -> None:
    track = thrown()
    assert track.quat_wxyz is not None
    still = Track(track.time_s, np.tile(track.position_m[3], (FRAMES, 1)), np.tile(track.quat_wxyz[3], (FRAMES, 1)))
    root = write_tiny_capture(tmp_path / "capture", still, masks)
    said = refused(root)
    assert f"nothing moves in episode '{EPISODE}'" in said and "start_s" in said


def test_flicker_is_no_motion_and_small_motion_is(tmp_path: Path) -> None:
    track = thrown()
    assert track.quat_wxyz is not None
    quat = np.tile(track.quat_wxyz[3], (FRAMES, 1))
    along = np.linspace(0, 1, FRAMES)[:, None] * np.array([0.01, 0.0, 0.0])  # about one pixel
    moved = write_tiny_capture(tmp_path / "moved", Track(track.time_s, track.position_m[3] + along, quat))
    assert examine_videos(Capture.open(moved), "train", False) == []
    still = write_tiny_capture(tmp_path / "still", Track(track.time_s, track.position_m[3] + 0 * along, quat))
    for path in sorted((still / "videos").rglob("*.png"))[1::2]:
        write_image(path, (0.85 * read_rgb(path)).astype(np.uint8))
    with pytest.raises(InputDataError, match="nothing moves"):
        examine_videos(Capture.open(still), "train", False)


def test_masks_that_are_all_empty(root: Path) -> None:
    for name in CAMERAS:
        change_masks(root, name, lambda _, mask: 0 * mask)
    said = refused(root)
    assert "the masks of all 2 cameras are empty: none shows 'cube' (label 1)" in said


def test_an_object_that_leaves_every_view_for_most_of_the_time(root: Path) -> None:
    change_masks(root, "left", lambda k, mask: mask * (k < 3))
    change_masks(root, "right", lambda k, mask: mask * (k < 4))
    said = refused(root)
    assert "can be seen in 4 of 10 instants, last at 0.100 s (left: frame 2 of 10; right: frame 3 of 10)" in said
    assert "end_s = 0.100" in said


@pytest.fixture
def partly_hidden(tmp_path: Path) -> Path:
    """A hidden body, or a failed segmentation, in some frames of each camera."""
    track = thrown()
    assert track.quat_wxyz is not None
    root = write_tiny_capture(tmp_path / "capture", Track(track.time_s[:6], track.position_m[:6], track.quat_wxyz[:6]))
    change_masks(root, "left", lambda k, mask: mask * (k not in (2, 3)))
    change_masks(root, "right", lambda k, mask: mask * (k not in (3, 5)))
    return root


def test_empty_masks_count_as_not_seen(partly_hidden: Path) -> None:
    footage = load_footage(Capture.open(partly_hidden), EPISODE, 64)
    assert footage.frame_at.tolist() == [[0, 1, -1, 4, 5], [0, 1, 2, 4, -1]]
    assert np.allclose(footage.times_s * RATE_HZ, [0, 1, 2, 4, 5])
    warnings = "\n".join(examine_videos(Capture.open(partly_hidden), "train", False))
    assert "000: left: the masks of 2 of 6 frames show no body that moves freely (frames 2, 3)" in warnings
    assert "000: right: the masks of 2 of 6 frames show no body that moves freely (frames 3, 5)" in warnings


# In the suite: what is left out and the warnings of it are tested above.
@pytest.mark.evidence
def test_a_fit_leaves_out_what_is_not_seen_and_says_so(partly_hidden: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search_briefly(monkeypatch)
    code, said, out = fit(partly_hidden)
    assert code == 0, said
    warnings = "\n".join(read_json(out / "model.json", ModelFile).warnings)
    assert "000: left: the masks of 2 of 6 frames show no body that moves freely (frames 2, 3)" in warnings
    assert "000: right: the masks of 2 of 6 frames show no body that moves freely (frames 3, 5)" in warnings
    assert "no camera shows the body in 1 of 6 instants, from 0.100 s to 0.100 s" in warnings
    record = read_json(out / "fit.json", FitFile).stages["phys-geo"]["pose_tracks"][EPISODE]
    assert (record["instants"], record["found"]) == (5, 5)
    assert record["mask_iou"] > 0.8


def test_a_first_frame_in_deep_contact(root: Path) -> None:
    track = thrown()
    with_tracks(root, replace(track, position_m=track.position_m - [0, 0, 0.07]))
    said = refused(root, "--supervise", "both")
    found = re.search(r"000: in the first frame body 'cube' is (\d+\.\d) mm deep inside the ground", said)
    assert found and 10 < float(found[1]) < 70
    assert "offset_m" in said and "scale" in said


def test_a_start_in_the_fingertip() -> None:
    tip = replace(ball_body(0.01, name="tip"), motion="driven")
    world = world_of(box_body(half=(0.05, 0.05, 0.05), radius=0.01), tip, ground=False)
    times = np.array([0.0, 0.1, 0.2])
    quat = np.tile([1.0, 0, 0, 0], (3, 1))

    def at(x: float) -> dict[str, Track]:
        finger = np.tile([x, 0.06, 0.06], (3, 1))
        return {"box": Track(times, np.cumsum(np.full((3, 3), 0.02), 0), quat), "tip": Track(times, finger, quat)}

    noise = Noise(5e-4, 5e-3)
    assert examine_tracks(world, [("a", at(0.09), noise)]) == []
    (text,) = examine_tracks(world, [("a", at(0.075), noise)])
    assert re.search(r"a: in the first frame body 'box' is 5\.0 mm deep inside body 'tip'", text)
    with pytest.raises(
        InputDataError, match=r"body 'box' is \d+\.\d mm deep inside body 'tip'(.|\n)*driven body's track"
    ):
        examine_tracks(world, [("a", at(0.06), noise)])


def test_poses_that_only_scatter_are_no_motion() -> None:
    world = world_of(box_body())
    rng = np.random.default_rng(0)
    quat = np.tile([1.0, 0, 0, 0], (15, 1))
    times = np.arange(15) / 30

    def scattered(speed: float) -> list[tuple[str, dict[str, Track], Noise]]:
        path = np.array([0.0, 0.0, 0.05]) + 1e-3 * rng.standard_normal((15, 3)) + speed * times[:, None] * [1, 0, 0]
        return [("a", {"box": Track(times, path, quat)}, Noise(1e-3, 1e-2))]

    with pytest.raises(InputDataError, match=r"no free body moves(.|\n)*film the motion"):
        examine_tracks(world, scattered(0.0))
    assert examine_tracks(world, scattered(0.1)) == []
    # poses of coarse pictures may be uncertain, and the motion plain all the same
    ((name, tracks, _),) = scattered(0.1)
    assert examine_tracks(world, [(name, tracks, Noise(1e-3, 1.0))]) == []


def test_a_time_offset_of_a_camera_gives_its_instants(root: Path) -> None:
    with_manifest(root, "[video]", "[video]\ncamera_time_offset_s = { right = 0.0125, left = -0.004 }")
    capture = Capture.open(root)
    footage = load_footage(capture, EPISODE, 64)
    frames = np.arange(FRAMES) / RATE_HZ
    for video, offset in zip(footage.videos, (-0.004, 0.0125), strict=True):
        np.testing.assert_allclose(video.times_s, frames + offset, atol=1e-12)
    assert len(footage.times_s) == 2 * FRAMES
    for row, offset in zip(footage.frame_at, (-0.004, 0.0125), strict=True):
        seen = row >= 0
        np.testing.assert_allclose(footage.times_s[seen], frames[row[seen]] + offset, atol=1e-12)
    # the episode's start and end are on the common clock, not on a camera's
    with_manifest(root, "[video]", f"[episodes]\n{EPISODE} = {{ start_s = 0.01, end_s = 0.2 }}\n[video]")
    late = load_footage(Capture.open(root), EPISODE, 64)
    assert [video.times_s.min() > 0.01 and video.times_s.max() < 0.2 for video in late.videos] == [True, True]
    assert late.videos[1].times_s[0] == pytest.approx(0.0125)


@pytest.mark.parametrize(
    ("parameter", "low", "high"),
    [
        (FRICTION, "slides as if on ice", "does not slide at all"),
        (CONTACT_TIME, "read it as rigid", "foam"),
        (DAMPING_RATIO, "bounces without losing speed", "does not bounce at all"),
        (GROUND_SHIFT, "2 cm or more below", "2 cm or more above"),
    ],
)
def test_a_fit_that_ends_at_a_bound_says_what_it_means(parameter, low: str, high: str) -> None:
    names = [*CONTACT_PARAMETERS, GROUND_SHIFT]
    world = world_of(box_body())
    inside = np.array([p.encode(p.prior[0]) for p in names])
    record = FitRecord(episodes=9, search_episodes=9, noise_estimated=Noise(1e-3, 1e-2))

    def fit(best: np.ndarray) -> PhysicsFit:
        estimate = ContactEstimate(parameters=names, values=best, covariance=1e-8 * np.eye(4))
        return physics_fit(world, estimate, (1e-3, 1e-2), record)

    quiet = fit(inside)
    assert quiet.warnings == ()
    for side, words in zip(("lower", "upper"), (low, high), strict=True):
        best = inside.copy()
        best[names.index(parameter)] = parameter.limits[side == "upper"]
        found = fit(best)
        (text,) = found.warnings
        assert text.startswith(f"{parameter.name} ended on its {side} bound (")
        assert words in text and text.endswith(".")
        assert [p.name for p in found.parameters if p.state == "on_bound"] == [
            "ground_offset_m" if parameter is GROUND_SHIFT else parameter.name
        ]


def test_bounds_of_effects_and_of_the_mass_have_a_meaning_too() -> None:
    effect = load_effect("quadratic_drag")
    active = ActiveEffect.of(effect, {p.name: 0.0 for p in effect.parameters}, torch.zeros(1, dtype=F64))
    names = [*effect_parameters(replace(world_of(box_body()), effects=(active,))), *mass_distribution("box", 0.05)]
    for parameter in names:
        for coordinate in parameter.limits:
            (text,) = bound_warnings(names, [fitted_parameter(parameter, coordinate, 1e-9)])
            assert parameter.name in text and "the motion asks" not in text
    (text,) = bound_warnings(names[:1], [fitted_parameter(names[0], 0.0, 1e-9)])
    assert "leave it out" in text


def test_an_instant_that_one_camera_saw_is_compared_with_that_camera(root: Path) -> None:
    """With time offsets no two cameras share an instant; the loss of each is that of its own picture."""
    track, model = thrown(), tiny_model()
    assert track.quat_wxyz is not None
    at = torch.arange(FRAMES)
    position, quat = torch.tensor(track.position_m[:, None] + 0.01), torch.tensor(track.quat_wxyz[:, None])
    alone = [
        ImageLoss(model, Footage.of("000", (video,)), [0]).expand(at, position, quat)
        for video in load_footage(Capture.open(root), EPISODE, 64).videos
    ]
    with_manifest(root, "[video]", "[video]\ncamera_time_offset_s = { right = 0.0125 }")
    loss = ImageLoss(model, load_footage(Capture.open(root), EPISODE, 64), [0])
    for camera, expected in enumerate(alone):
        found = loss.expand(2 * at + camera, position, quat)
        torch.testing.assert_close(found.value, expected.value)
        torch.testing.assert_close(found.slope, expected.slope)

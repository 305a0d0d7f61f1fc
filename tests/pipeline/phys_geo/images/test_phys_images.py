"""Physics from images: gradients through contact, poses from renders, a loss that falls, honest refusals."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import Model
from cgwm.pipeline.geometry.rotation import geodesic_angle, quat_to_matrix
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.phys_geo.images import end_to_end, image_fit, pose_tracking
from cgwm.pipeline.phys_geo.images.coarse_spheres import coarse_model, merged
from cgwm.pipeline.phys_geo.images.contact_spheres import ContactSpheres
from cgwm.pipeline.phys_geo.images.end_to_end import ImageObjective, TrackTerm, refine_end_to_end
from cgwm.pipeline.phys_geo.images.image_fit import fit_physics_from_images
from cgwm.pipeline.phys_geo.images.image_loss import ImageLoss
from cgwm.pipeline.phys_geo.images.image_problem import ImageProblem
from cgwm.pipeline.phys_geo.images.pose_search import rotation_grid
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseTracker
from cgwm.pipeline.phys_geo.images.video_frames import Footage, Video, load_footage
from cgwm.pipeline.physics import engine
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.parameters import DAMPING_RATIO, FRICTION, apply_parameters
from cgwm.pipeline.physics.rollout import Rollout
from cgwm.pipeline.physics.world import World
from cgwm.pipeline.rendering.render import RenderOutput, render
from cgwm.pipeline.runtime.checkpoint import Checkpoint
from cgwm.pipeline.trajectories.observations import Observations
from cgwm.schemas import InputDataError, NotConvergedError, PhysConfig
from helpers import tiny_capture
from helpers.small_model import cube_splats, small_model, table_splats
from helpers.tiny_capture import CAMERAS, HEIGHT, WIDTH, start_state

pytestmark = pytest.mark.usefixtures("one_thread")
FRAMES, RATE = 8, 30.0
GAIN = {"left": (0.9, 1.0, 1.1), "right": (1.1, 1.05, 0.95)}
NAMES = [FRICTION, DAMPING_RATIO]
LIFT = torch.tensor([0.01, 0.01, 0.08], dtype=torch.float64)
"""So far above the table none of its spheres reaches before the cube."""
TRUTH = torch.tensor([math.log(0.4), math.log(0.3)], dtype=torch.float64)


def tiny_model() -> Model:
    """The tiny capture's cube, on a table of smaller spheres.

    None of them reaches half a body's radius into what stands on it.
    """
    return replace(tiny_capture.tiny_model(), scene=table_splats(24))


def drawn(spheres: Spheres, view: torch.Tensor, K: torch.Tensor) -> RenderOutput:
    """Render spheres with one camera."""
    gaussians = (spheres.means, spheres.scales, spheres.opacities, spheres.colors)
    return render(*gaussians, view[None], K[None], WIDTH, HEIGHT)


def film(model: Model, rollout: Rollout, masks: bool = True, noise: float = 0.01, dtype=torch.float32) -> Footage:
    """Render a rollout from two cameras, with exposures and noise.

    The cube is drawn over the table: no real table reaches into what stands on it, as one of coarse spheres would.
    """
    generator = torch.Generator().manual_seed(0)
    body, scene = (Spheres.from_numpy(s, dtype) for s in (model.body_splats["cube"], model.scene) if s is not None)
    videos = []
    for name, camera in CAMERAS.items():
        view, K = (torch.as_tensor(matrix).to(dtype) for matrix in (camera.T_cam_world, camera.K))
        pictures, covers = [], []
        for k in range(rollout.position_m.shape[1]):
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = quat_to_matrix(rollout.quat_wxyz[0, k, 0])
            pose[:3, 3] = rollout.position_m[0, k, 0]
            cube, table = drawn(body.moved(pose.to(dtype)), view, K), drawn(scene, view, K)
            picture = cube.features[0] + (1 - cube.alpha[0, ..., None]) * table.features[0]
            exposed = torch.tensor(GAIN[name], dtype=dtype) * picture
            pictures.append((exposed + noise * torch.randn(exposed.shape, generator=generator)).clamp(0, 1).to(dtype))
            covers.append((cube.alpha > 0.5).to(dtype))
        count = len(pictures)
        videos.append(
            Video(
                camera=name,
                times_s=np.arange(count) / RATE,
                frames=torch.stack(pictures),
                covers=torch.stack(covers) if masks else None,
                K=K,
                viewmats=view.expand(count, 4, 4),
            )
        )
    return Footage.of("000", tuple(videos))


@pytest.fixture(scope="module")
def scene() -> tuple[Model, World, Rollout]:
    model = tiny_model()
    world = apply_parameters(world_of_model(model), NAMES, TRUTH.exp()[None])
    times = torch.arange(FRAMES, dtype=torch.float64) / RATE
    rollout = engine.rollout(world, start_state(), times, record_contacts=True)
    assert rollout.contacts is not None and float(rollout.contacts.impulse_n_s[..., 2].sum()) > 0.1
    return model, world, rollout


def observed(world: World, rollout: Rollout) -> Observations:
    track = Track(rollout.times_s.numpy(), rollout.position_m[0, :, 0].numpy(), rollout.quat_wxyz[0, :, 0].numpy())
    observations = Observations.of(world, [("000", {"cube": track})], [(-1.0, 10.0)])
    return replace(observations, state=start_state())


def objective_of(scene: tuple[Model, World, Rollout], footage: Footage, min_alpha: float = 1 / 255) -> ImageObjective:
    model, world, rollout = scene
    loss = ImageLoss(model, footage, [0], min_alpha)
    columns = torch.arange(FRAMES).repeat(2, 1)
    return ImageObjective(
        world=world, parameters=NAMES, observations=observed(world, rollout), losses=[loss], columns=[columns]
    )


def valued(objective: ImageObjective, shared: torch.Tensor, states: torch.Tensor) -> float:
    return objective.value(objective.parts(objective.rollout(shared, states)), shared)


@pytest.mark.parametrize("with_tracks", [pytest.param(False, marks=pytest.mark.evidence), True])
def test_gradient_is_that_of_differences_through_contact(
    scene: tuple[Model, World, Rollout], with_tracks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The chain renderer (reverse mode) times rollout (differences) against differences of the whole loss.

    The rollout's steps are a hundredth of what they are in a fit, where curvature is part of the slope. Coordinates
    of spheres are tested as those of parameters and states are.
    """
    model, world, rollout = scene
    monkeypatch.setattr(end_to_end, "PARAMETER_STEP", 0.01 * end_to_end.PARAMETER_STEP)
    monkeypatch.setattr(end_to_end, "SPHERE_STEP", 0.01 * end_to_end.SPHERE_STEP)
    monkeypatch.setattr(end_to_end, "STATE_STEPS", tuple(0.01 * step for step in end_to_end.STATE_STEPS))
    footage = Footage.of("000", film(model, rollout, noise=0.05, dtype=torch.float64).videos[:1])
    objective = objective_of(scene, footage, min_alpha=1e-12)
    if with_tracks:
        objective = replace(objective, tracks=TrackTerm(objective.observations, (0.02, 0.2)), scale=0.02)
    spheres = ContactSpheres.of(
        world, replace(rollout, position_m=rollout.position_m[:, -2:], quat_wxyz=rollout.quat_wxyz[:, -2:])
    )
    assert spheres.count >= 4
    objective = replace(objective, geometry=spheres, unit=300.0)  # so that what holds the spheres counts as well
    moved_spheres = 0.5 * torch.randn(spheres.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    shared = torch.cat([TRUTH + torch.tensor([0.1, -0.15], dtype=torch.float64), moved_spheres])
    states = torch.zeros(1, 12, dtype=torch.float64)
    states[0, [0, 2, 4, 6, 8, 10]] = torch.tensor([0.004, -0.003, 0.03, 0.05, -0.04, 0.2], dtype=torch.float64)
    here = objective.rollout(shared, states)
    _, slope = objective.normal_equations(shared, states, here, objective.curvature(here))

    z, count = torch.cat([shared, states[0]]), len(shared)
    steps = torch.cat(
        [
            torch.full((2,), 3e-4),
            torch.full((spheres.count,), 2.5e-3),
            torch.tensor([2e-6, 2e-5, 5e-5, 5e-4]).repeat_interleave(3),
        ]
    )
    groups = [range(2), range(2, count), *(range(first, first + 3) for first in range(count, count + 12, 3))]
    for group in groups:
        largest = float(slope[group.start : group.stop].abs().max())
        assert largest > 0
        for index in list(group)[:: 1 + with_tracks]:
            ends = []
            for sign in (1, -1):
                moved = z.clone()
                moved[index] += sign * float(steps[index])
                ends.append(valued(objective, moved[:count], moved[count:][None]))
            difference = (ends[0] - ends[1]) / (2 * float(steps[index]))
            # a pixel of the L1 norm changes its sign here and there within the step, hence a few per cent
            assert float(slope[index]) == pytest.approx(difference, rel=0.05, abs=0.01 * largest), index


def test_window_and_constant_give_the_loss_of_the_whole_picture(scene: tuple[Model, World, Rollout]) -> None:
    model, _, rollout = scene
    footage = film(model, rollout)
    loss = ImageLoss(model, footage, [0])
    position, quat = rollout.position_m[0] + LIFT, rollout.quat_wxyz[0]
    parts = loss.parts(torch.arange(FRAMES), position, quat)

    shown = film(model, replace(rollout, position_m=rollout.position_m + LIFT), noise=0.0)
    expected = torch.zeros(FRAMES, 2)
    for number, (video, mine) in enumerate(zip(footage.videos, shown.videos, strict=True)):
        assert video.covers is not None
        exposed = torch.tensor(loss.gains[video.camera]) / torch.tensor(GAIN[video.camera])
        expected[:, 0] += (exposed * mine.frames - video.frames).abs().mean((1, 2, 3)) / 2
        assert number < 2
    assert torch.allclose(parts[:, 0], expected[:, 0], atol=2e-4)
    assert loss.gains["left"] == pytest.approx(GAIN["left"], abs=0.02)
    assert loss.gains["right"] == pytest.approx(GAIN["right"], abs=0.02)


@pytest.mark.parametrize("masks", [True, pytest.param(False, marks=pytest.mark.evidence)])
def test_poses_are_found_again(
    scene: tuple[Model, World, Rollout], masks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_tracking, "KEYFRAMES", 2)
    model, _, rollout = scene
    footage = film(model, rollout, masks)
    nothing = torch.zeros(FRAMES, 1, 3), torch.tensor([1.0, 0, 0, 0]).repeat(FRAMES, 1, 1)
    tracker = PoseTracker(ImageLoss(coarse_model(model), footage, [0]), ImageLoss(model, footage, [0]), *nothing)
    found = tracker.run()
    assert bool(found.found.all())
    # a pixel is 8 mm and 4 degrees here
    assert (found.position_m - rollout.position_m[0]).norm(dim=-1).max() < 3e-3
    assert geodesic_angle(found.quat_wxyz, rollout.quat_wxyz[0]).max() < math.radians(4)
    std = found.covariance.diagonal(dim1=1, dim2=2).sqrt().mean(0)
    assert 1e-5 < float(std[:3].max()) < 5e-3
    if masks:
        assert float(found.quality.iou.median()) > 0.9
    else:
        assert bool(found.quality.iou.isnan().all())


def test_a_video_of_something_else_is_refused(scene: tuple[Model, World, Rollout]) -> None:
    model, _, rollout = scene
    away = replace(rollout, position_m=rollout.position_m * 0 + torch.tensor([0.0, 0.0, 5.0]).double())
    footage = film(model, away)
    nothing = torch.zeros(FRAMES, 1, 3), torch.tensor([1.0, 0, 0, 0]).repeat(FRAMES, 1, 1)
    loss = ImageLoss(model, footage, [0])
    with pytest.raises(NotConvergedError, match=r"found in 0 of 8 instants(.|\n)*--supervise tracks"):
        PoseTracker(loss, loss, *nothing).run()


def test_refinement_lowers_the_image_loss_and_never_raises_it(scene: tuple[Model, World, Rollout]) -> None:
    model, _, rollout = scene
    objective = objective_of(scene, film(model, rollout))
    shared = TRUTH + torch.tensor([0.2, -0.3], dtype=torch.float64)
    states = torch.zeros(1, 12, dtype=torch.float64)
    states[0, [0, 2, 6, 8]] = torch.tensor([0.006, 0.004, 0.05, 0.05], dtype=torch.float64)
    bounds = torch.tensor([p.limits for p in NAMES], dtype=torch.float64)
    refined = refine_end_to_end(objective, shared, states, bounds, 4)
    assert all(b < a for a, b in zip(refined.history, refined.history[1:], strict=False))
    truth = valued(objective, TRUTH, torch.zeros_like(states))
    assert refined.history[-1] - truth < 0.35 * (refined.history[0] - truth)
    moved = objective.rollout(refined.shared, refined.states).position_m[0]
    before = objective.rollout(shared, states).position_m[0]
    assert (moved - rollout.position_m[0]).norm() < 0.5 * (before - rollout.position_m[0]).norm()


@pytest.mark.parametrize("law", ["closed_form", "paper"])
def test_images_move_the_friction_under_the_published_law_alone(
    scene: tuple[Model, World, Rollout], law: Literal["closed_form", "paper"]
) -> None:
    model, _, rollout = scene
    shared = TRUTH + torch.tensor([0.2, -0.3], dtype=torch.float64)
    problem = ImageProblem(objective_of(scene, film(model, rollout)), shared, "known")
    config = PhysConfig(supervise="images", device="cpu", contact_law=law, iterations=1)
    moved = image_fit._refine(problem, np.eye(2), config).shared - shared
    friction, damping_ratio = moved.abs().tolist()
    assert damping_ratio > 1e-3
    assert friction > 1e-3 if law == "paper" else friction == 0


def test_cameras_with_a_time_offset_share_one_time_line(scene: tuple[Model, World, Rollout]) -> None:
    model, _, rollout = scene
    left, right = film(model, rollout).videos
    footage = Footage.of("000", (left, replace(right, times_s=right.times_s + 0.01)))
    assert len(footage.times_s) == 2 * FRAMES
    assert (footage.frame_at[0][::2] == np.arange(FRAMES)).all()
    assert (footage.frame_at[1][1::2] == np.arange(FRAMES)).all()
    assert (footage.frame_at >= 0).sum(0).max() == 1


def test_merged_spheres_keep_the_mean_and_the_count_falls() -> None:
    splats = cube_splats(600)
    fewer = merged(splats, 0.02)
    weight, less = splats.scales**2 * splats.opacities, fewer.scales**2 * fewer.opacities
    assert len(fewer) < 0.5 * len(splats)
    assert (
        np.abs(np.average(fewer.means, axis=0, weights=less) - np.average(splats.means, axis=0, weights=weight)).max()
        < 5e-3
    )


def test_rotation_grid_covers_all_rotations() -> None:
    grid = rotation_grid(72)
    assert torch.allclose(grid.norm(dim=1), torch.ones(72, dtype=torch.float64))
    random = torch.nn.functional.normalize(
        torch.randn(500, 4, generator=torch.Generator().manual_seed(0)).double(), dim=1
    )
    nearest = 2 * torch.acos((random @ grid.T).abs().amax(1).clamp_max(1))
    assert math.degrees(float(nearest.max())) < 60


def test_a_capture_without_cameras_or_videos_is_told_what_to_do(tmp_path: Path) -> None:
    text = 'format = "cgwm-capture/1"\n[[bodies]]\nname = "cube"\n[splits]\ntrain = ["000"]\n'
    (tmp_path / "capture.toml").write_text(text)
    capture = Capture.open(tmp_path, check=False)
    model = small_model()
    checkpoint = Checkpoint(tmp_path / "checkpoint", {})
    with pytest.raises(InputDataError, match=r"episode '000' has no video(.|\n)*--supervise tracks"):
        fit_physics_from_images(world_of_model(model), model, capture, "train", PhysConfig(), False, checkpoint)
    folder = tmp_path / "videos" / "left" / "000"
    folder.mkdir(parents=True)
    with pytest.raises(InputDataError, match="cgwm calibrate"):
        load_footage(capture, "000", 64)


def test_a_model_without_background_is_refused(scene: tuple[Model, World, Rollout]) -> None:
    model, _, rollout = scene
    footage = film(model, replace(rollout, position_m=rollout.position_m[:, :3], quat_wxyz=rollout.quat_wxyz[:, :3]))
    with pytest.raises(InputDataError, match="no background"):
        ImageLoss(replace(model, scene=None), footage, [0])
    with pytest.raises(InputDataError, match="no visual spheres of the free body 'cube'"):
        ImageLoss(replace(model, body_splats={}), footage, [0])

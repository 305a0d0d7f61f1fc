"""Synthesis: equal seeds give equal bytes, sharding changes nothing, labels are exact, failures leave nothing."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import read_model, write_model
from cgwm.datasets.rollouts.dataset import read_manifest
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.pipeline.geometry.viewpoint import rotation_matrix
from cgwm.pipeline.rendering import label_renderer as labels_module
from cgwm.pipeline.rendering.label_renderer import LabelRenderer
from cgwm.pipeline.rendering.render import render
from cgwm.pipeline.rendering.screen_bounds import Box
from cgwm.pipeline.synthesize import simulator as batches
from cgwm.pipeline.synthesize.parameters import draw_parameters, with_parameter
from cgwm.pipeline.synthesize.plan import extent, resolve_plan
from cgwm.pipeline.synthesize.stage import shard_indices, synthesize
from cgwm.pipeline.synthesize.start_states import draw_start
from cgwm.pipeline.synthesize.viewpoints import look_at_cameras
from cgwm.schemas import (
    EffectModel,
    Exposure,
    FittedParameter,
    GroundShadow,
    InputDataError,
    Light,
    NotConvergedError,
    SamplingPlan,
    SynthesizeConfig,
    UsageError,
)
from helpers.small_model import HALF, MASS, cube_splats, small_model, write_small_model
from scipy import stats

SHADOW = GroundShadow(to_lamp=(0.48, 0.0, 0.877268), brightness_rgb=(0.5, 0.6, 0.7))
CONFIG = SynthesizeConfig(rollouts=2, duration_s=0.3, width=64, height=48, device="cpu", seed=5)


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("models") / "model")


@pytest.fixture(scope="module")
def dataset(model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("datasets") / "whole"
    synthesize(model_path, out, CONFIG)
    return out


def test_equal_seeds_give_equal_bytes(model_path: Path, dataset: Path, tmp_path: Path) -> None:
    again = synthesize(model_path, tmp_path / "again", CONFIG)
    assert read_manifest(dataset).shards[0].sha256 == again.sha256 == sha256(dataset / again.shard)
    other = synthesize(model_path, tmp_path / "other", CONFIG.model_copy(update={"seed": 6}))
    assert other.sha256 != again.sha256
    assert sha256(dataset / "model") == read_manifest(dataset).model_sha256 == sha256(model_path)


def test_sharding_changes_no_rollout(model_path: Path, dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "shards"
    for shard in (1, 0):  # in any order
        update = {"shards": 2, "shard": shard}
        summary = synthesize(model_path, out, CONFIG.model_copy(update=update))
        assert summary.shard == f"rollouts-000{shard}-of-0002.h5"
    manifest = read_manifest(out)
    assert [entry.index for entry in manifest.shards] == [0, 1]
    assert all(sha256(out / entry.file) == entry.sha256 for entry in manifest.shards)
    whole, parts = RolloutReader(dataset), RolloutReader(out)
    assert [info.demo for info in parts.rollouts] == ["demo_0", "demo_1"]
    for number in range(2):
        assert whole.keys(number) == parts.keys(number)
        for key in whole.keys(number):
            np.testing.assert_array_equal(whole.read(number, key), parts.read(number, key), err_msg=key)
        assert dict(whole.group(number).attrs) == dict(parts.group(number).attrs)


@pytest.mark.parametrize(("rollouts", "shards"), [(10, 3), (7, 7), (1000, 64)])
def test_shards_divide_the_rollouts(rollouts: int, shards: int) -> None:
    parts = [shard_indices(SynthesizeConfig(rollouts=rollouts, shards=shards, shard=shard)) for shard in range(shards)]
    assert [index for part in parts for index in part] == list(range(rollouts))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_a_foreign_shard_is_refused(model_path: Path, tmp_path: Path) -> None:
    two = CONFIG.model_copy(update={"shards": 2, "duration_s": 0.1})
    synthesize(model_path, tmp_path / "out", two)
    before = sha256(tmp_path / "out")
    with pytest.raises(
        UsageError, match=r"another dataset: its config.seed is 5, here 99[\s\S]*repeat the options of the first shard"
    ):
        synthesize(model_path, tmp_path / "out", two.model_copy(update={"shard": 1, "seed": 99}))
    synthesize(model_path, tmp_path / "out", two)  # the same shard again is kept
    with pytest.raises(UsageError, match="3 shards for 2 rollouts: some would be empty"):
        synthesize(model_path, tmp_path / "new", two.model_copy(update={"shards": 3}))
    assert sha256(tmp_path / "out") == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


@pytest.mark.parametrize("shards", [1, 2])
def test_a_failure_leaves_nothing(
    model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shards: int
) -> None:
    def diverge(*arguments: object, **options: object) -> object:
        rollout = simulate(*arguments, **options)  # pyright: ignore
        return replace(rollout, position_m=rollout.position_m * torch.nan)

    simulate = batches.roll_out
    monkeypatch.setattr(batches, "roll_out", diverge)
    with pytest.raises(NotConvergedError, match=r"rollout 0 \(seed 5\) diverged by step 0(.|\n)*Its start: "):
        synthesize(model_path, tmp_path / "out", CONFIG.model_copy(update={"shards": shards}))
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_model_or_exists_is_refused(model_path: Path, dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"exists|complete|other"):
        synthesize(model_path, dataset, CONFIG.model_copy(update={"seed": 99}))
    with pytest.raises(InputDataError, match="is a dataset"):
        synthesize(dataset, tmp_path / "out", CONFIG)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture/capture.toml").write_text('format = "cgwm-capture/1"\n')
    with pytest.raises(InputDataError, match="is a capture"):
        synthesize(tmp_path / "capture", tmp_path / "out", CONFIG)
    model = read_model(model_path)
    write_model(tmp_path / "scene", replace(model, file=model.file.model_copy(update={"contact": None})))
    with pytest.raises(InputDataError, match="no fitted physics"):
        synthesize(tmp_path / "scene", tmp_path / "out", CONFIG)
    with pytest.raises(UsageError, match="is one frame"):
        synthesize(model_path, tmp_path / "out", CONFIG.model_copy(update={"duration_s": 0.01}))
    assert not (tmp_path / "out").exists()


def test_a_model_without_splats_gives_states_and_says_so(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    summary = synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"rollouts": 1}))
    assert summary.cameras == () and summary.frames == 10
    assert "no visual spheres, so there is nothing to render" in summary.notes[0]
    with h5py.File(tmp_path / "out" / summary.shard) as file:
        assert list(file["data/demo_0/obs"]) == ["object"]


def test_the_pusher_comes_at_the_object(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", driven=True)
    plan = SamplingPlan(push_speed_m_s=(0.5, 0.5), push_miss=0.2)
    summary = synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"plan": plan}))
    reader = RolloutReader(tmp_path / "out" / summary.shard)
    for number in range(2):
        position = reader.read(number, "bodies/pos")
        command, time = reader.read(number, "actions"), reader.read(number, "time")
        assert np.linalg.norm(position[-1, 0] - position[0, 0]) > 0.005
        np.testing.assert_allclose(position[:, 1], position[0, 1] + 0.5 * time[:, None] * command[0], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(command, axis=1), 1)
        a, b = (reader.read(number, f"contacts/body_{side}") for side in "ab")
        assert {tuple(pair) for pair in np.stack([a, b], 1).tolist()} >= {(0, -1), (0, 1)}
    reader.close()


def test_shadows_change_colours_alone_and_need_a_lamp(dataset: Path, model_path: Path, tmp_path: Path) -> None:
    config = CONFIG.model_copy(update={"shadows": True})
    with pytest.raises(InputDataError, match="neither its photos nor its videos tell where the lamp is"):
        synthesize(model_path, tmp_path / "none", config)
    model = small_model()
    lit = model.file.model_copy(update={"ground_shadow": SHADOW})
    write_model(tmp_path / "model", replace(model, file=lit))
    synthesize(tmp_path / "model", tmp_path / "shaded", config)
    plain, shaded = RolloutReader(dataset), RolloutReader(tmp_path / "shaded")
    for key in ("view0_mask", "view0_depth", "view0_amodal"):
        np.testing.assert_array_equal(plain.read(0, f"obs/{key}"), shaded.read(0, f"obs/{key}"))
    change = shaded.read(0, "obs/view0_image").astype(int) - plain.read(0, "obs/view0_image")
    dark = change.min(-1) < -5
    assert dark.mean() > 0.005 and change.max() <= 1
    assert (plain.read(0, "obs/view0_mask")[dark] == 0).mean() > 0.9
    plain.close()
    shaded.close()


def test_crops_are_the_whole_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(driven=True)
    plan = resolve_plan(model, SamplingPlan())
    cameras = look_at_cameras(model, plan, SynthesizeConfig(width=100, height=76))
    renderer = LabelRenderer(model, cameras, shadow=SHADOW)
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.25, 0.25, (6, 2, 3)) + np.array([0, 0, 0.2])
    quat = rng.normal(size=(6, 2, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    crops = list(renderer.blocks(position, quat))
    monkeypatch.setattr(labels_module, "reach", lambda each, width, height: Box(0, 0, width, height))
    for crop, whole in zip(crops, renderer.blocks(position, quat), strict=True):
        np.testing.assert_array_equal(crop.image, whole.image)
        np.testing.assert_array_equal(crop.mask, whole.mask)
        np.testing.assert_array_equal(crop.amodal, whole.amodal)
        np.testing.assert_allclose(crop.depth, whole.depth, atol=1e-6)


def test_labels_agree_with_a_plain_rendering() -> None:
    """Colour is the renderer's; the mask names what has the largest weight; depth is that surface's."""
    model = small_model()
    cameras = look_at_cameras(model, resolve_plan(model, SamplingPlan(views=1)), SynthesizeConfig(width=80, height=60))
    camera = cameras["view0"]
    quat = np.array([0.8, 0.2, -0.5, 0.26])
    quat /= np.linalg.norm(quat)
    place = np.array([0.03, -0.02, 0.12])
    (block,) = LabelRenderer(model, cameras).blocks(place[None, None], quat[None, None])
    body, scene = model.body_splats["cube"], model.scene
    assert scene is not None
    means = np.concatenate([body.means @ rotation_matrix(quat).T + place, scene.means])
    parts = [np.concatenate([getattr(body, key), getattr(scene, key)]) for key in ("scales", "opacities", "colors")]
    is_body = np.r_[np.ones(len(body)), np.zeros(len(scene))]
    values = [torch.as_tensor(part) for part in (means, *parts[:2], np.c_[parts[2], is_body])]
    pose, K = torch.as_tensor(camera.T_cam_world)[None], torch.as_tensor(camera.K)[None]
    picture = render(*values, pose, K, camera.width, camera.height)
    np.testing.assert_allclose(block.image[0], 255 * picture.features[0, ..., :3].numpy(), atol=0.51)
    share, alpha = picture.features[0, ..., 3].numpy(), picture.alpha[0].numpy()
    sure = (np.abs(2 * share - alpha) > 1e-4) & (np.abs(alpha - 0.5) > 1e-4)
    np.testing.assert_array_equal(block.mask[0][sure], ((alpha > 0.5) & (2 * share > alpha))[sure])
    z = (means[: len(body)] @ camera.T_cam_world[:3, :3].T + camera.T_cam_world[:3, 3])[:, 2]
    on_body = block.depth[0][block.mask[0] == 1]
    assert len(on_body) > 100 and on_body.min() >= z.min() and on_body.max() <= z.max()
    pure = (block.mask[0] == 1) & (share > 0.995 * alpha)
    np.testing.assert_allclose(block.depth[0][pure], picture.depth[0].numpy()[pure], atol=2e-3)


def test_all_at_once_is_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a GPU does in one call, here by the torch renderer: the same labels, in the same order of blocks."""
    model = small_model(driven=True)
    fixed = model.file.bodies[1].model_copy(update={"name": "post", "motion": "fixed"})
    file = model.file.model_copy(update={"bodies": (*model.file.bodies, fixed)})
    splats = {**model.body_splats, "post": replace(model.body_splats["tip"], scales=np.array([0.02]))}
    model = replace(model, file=file, body_splats=splats, collision={**model.collision, "post": splats["post"]})
    plan = resolve_plan(model, SamplingPlan(views=2))
    cameras = look_at_cameras(model, plan, SynthesizeConfig(width=72, height=48))
    cameras["small"] = look_at_cameras(model, plan, SynthesizeConfig(width=40, height=32))["view1"]
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.1, 0.1, (11, 3, 3)) + np.array([0, 0, 0.15])
    quat = rng.normal(size=(11, 3, 4))
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    renderer = LabelRenderer(model, cameras, shadow=SHADOW)
    expected = list(renderer.blocks(position, quat))
    monkeypatch.setattr(labels_module, "_to_host", lambda pictures: (pictures, lambda: None))
    monkeypatch.setattr(renderer, "_together", True)
    renderer.set_cameras(cameras)
    for numbers in (labels_module.NUMBERS_AT_ONCE, 1):  # one call, and one for each chunk of frames
        monkeypatch.setattr(labels_module, "NUMBERS_AT_ONCE", numbers)
        found = list(renderer.blocks(position, quat))
        assert [(b.camera, b.start, len(b.image)) for b in found] == [
            (b.camera, b.start, len(b.image)) for b in expected
        ]
        for one, other in zip(found, expected, strict=True):
            assert np.abs(one.image.astype(int) - other.image).max() <= 1
            for key in ("mask", "amodal"):
                assert (getattr(one, key) != getattr(other, key)).mean() < 1e-3
            same = one.mask == other.mask
            np.testing.assert_allclose(one.depth[same], other.depth[same], atol=1e-5)
            assert np.abs(one.visible_px - other.visible_px).max() <= 2
            assert np.abs(one.amodal_px - other.amodal_px).max() <= 2
    assert set(np.unique(np.concatenate([b.mask.ravel() for b in expected]))) == {0, 1, 2, 3}


def test_amodal_masks_show_what_is_hidden() -> None:
    """The tip stands between the camera and the cube: amodal masks are those of each body rendered alone."""
    model = small_model(driven=True)
    plan = resolve_plan(model, SamplingPlan(views=1))
    cameras = look_at_cameras(model, plan, SynthesizeConfig(width=96, height=72))
    camera = cameras["view0"]
    eye = camera.T_world_cam[:3, 3]
    cube = np.array([0.0, 0.0, 0.12])
    position = np.stack([np.stack([cube, cube + step * (eye - cube)]) for step in (0.25, -0.25)])
    quat = np.tile([1.0, 0, 0, 0], (2, 2, 1))
    (block,) = LabelRenderer(model, cameras).blocks(position, quat)
    for body, name in enumerate(("cube", "tip")):
        splats = model.body_splats[name]
        for frame in range(2):
            means = torch.as_tensor(splats.means + position[frame, body])
            values = [torch.as_tensor(getattr(splats, key)) for key in ("scales", "opacities", "colors")]
            pose, K = torch.as_tensor(camera.T_cam_world)[None], torch.as_tensor(camera.K)[None]
            alpha = render(means, *values, pose, K, 96, 72).alpha[0].numpy()
            seen = (block.amodal[frame] >> body & 1).astype(bool)
            sure = np.abs(alpha - 0.5) > 1e-3
            shown = (block.mask[frame] == body + 1) & (alpha < 0.5)  # edges that shine through count as seen
            np.testing.assert_array_equal(seen[sure & ~shown], (alpha > 0.5)[sure & ~shown])
            assert block.amodal_px[frame, body] == seen.sum() > 1
            assert block.visible_px[frame, body] == (block.mask[frame] == body + 1).sum()
    assert block.visible_px[0, 0] < block.amodal_px[0, 0] and block.visible_px[0, 1] == block.amodal_px[0, 1]
    assert block.visible_px[1, 1] == 0 < block.amodal_px[1, 1]


def test_cameras_light_and_exposure_may_change_between_rollouts() -> None:
    """What a renderer is told later is what one that is made so shows."""
    normals = np.tile([0.0, 0, 1], (400, 1))
    model = small_model()
    model = replace(model, body_splats={"cube": replace(model.body_splats["cube"], normals=normals)})
    dark, light = (Light(lamp=lamp, sky=0.1) for lamp in ((0.0, 0.0, 0.1), (0.3, 0.2, 0.5)))
    lit = [replace(model, file=model.file.model_copy(update={"light": one})) for one in (dark, light)]
    settings = SynthesizeConfig(width=64, height=48)
    views = [
        look_at_cameras(model, resolve_plan(model, SamplingPlan(views=2, view_elevation_deg=angle)), settings)
        for angle in (20, 50)
    ]
    poses = np.tile([0.0, 0, 0.15], (3, 1, 1)), np.tile([0.6, 0.8, 0, 0], (3, 1, 1))
    told = LabelRenderer(lit[0], views[0])
    before = list(told.blocks(*poses))
    told.set_cameras(views[1])
    told.set_light(light)
    for block, expected in zip(told.blocks(*poses), LabelRenderer(lit[1], views[1]).blocks(*poses), strict=True):
        np.testing.assert_array_equal(block.image, expected.image)
        np.testing.assert_array_equal(block.mask, expected.mask)
        assert (block.image != before[0].image).any()
    exposure = Exposure(gain_rgb=(0.5, 1.0, 2.0), offset_rgb=(0.1, 0.0, 0.0))
    plain = list(told.blocks(*poses))
    exposed = list(told.blocks(*poses, exposures={"view1": exposure}))
    np.testing.assert_array_equal(exposed[0].image, plain[0].image)
    wanted = (plain[1].image * np.array([0.5, 1, 2]) + [25.5, 0, 0]).clip(0, 255)
    np.testing.assert_allclose(exposed[1].image, wanted, atol=0.51)


def test_labels_obey_newton_and_the_states_are_the_bodies(dataset: Path) -> None:
    reader = RolloutReader(dataset)
    touched = 0
    for number in range(2):
        velocity, time = reader.read(number, "bodies/vel")[:, 0], reader.read(number, "time")
        for frame in range(1, len(time)):
            rows = reader.contacts(number, frame)
            push = rows["impulse_world"].sum(0) + MASS * np.array([0, 0, -9.81]) * (time[frame] - time[frame - 1])
            np.testing.assert_allclose(MASS * (velocity[frame] - velocity[frame - 1]), push, atol=1e-12)
            touched += len(rows["mode"])
            # friction stays in its cone, contacts push
            normal = (rows["impulse_world"] * rows["normal_world"]).sum(1)
            across = np.linalg.norm(rows["impulse_world"] - normal[:, None] * rows["normal_world"], axis=1)
            assert (normal >= 0).all()
            assert (across <= reader.parameters(number)["friction"] * normal * (1 + 1e-9) + 1e-15).all()
        states = reader.read(number, "states")
        np.testing.assert_array_equal(states[:, 0], time)
        np.testing.assert_array_equal(states[:, 1:4], reader.read(number, "bodies/pos")[:, 0])
        np.testing.assert_array_equal(states[:, 8:11], velocity)
    assert touched > 0
    reader.close()


def test_starts_are_above_the_ground_and_within_the_plan() -> None:
    model = small_model(com_m=(0.01, 0, 0))
    plan = resolve_plan(model, SamplingPlan(height_m=(0.02, 0.2), offset_m=0.1))
    size = extent(model, model.file.bodies[0])
    assert size.radius_m == pytest.approx(np.sqrt(3) * 0.9 * HALF + 0.1 * HALF)
    for seed in range(50):
        start = draw_start(model, plan, 1.0, np.random.default_rng(seed))
        gap = start.position_m[0, 2] - size.radius_m
        assert 0.02 - 1e-12 <= gap <= 0.2 + 1e-12
        assert np.linalg.norm(start.position_m[0, :2]) <= 0.1 + 1e-12
        assert np.linalg.norm(start.quat_wxyz[0]) == pytest.approx(1)
        assert plan.spin_rad_s and np.linalg.norm(start.omega_body_rad_s[0]) <= plan.spin_rad_s.support[1]


def test_two_bodies_start_apart() -> None:
    model = small_model()
    twin = model.file.bodies[0].model_copy(update={"name": "twin"})
    file = model.file.model_copy(update={"bodies": (*model.file.bodies, twin)})
    both = replace(model, file=file, collision={name: model.collision["cube"] for name in ("cube", "twin")})
    plan = resolve_plan(both, SamplingPlan(offset_m=0.3))
    for seed in range(10):
        start = draw_start(both, plan, 1.0, np.random.default_rng(seed))
        assert np.linalg.norm(start.position_m[0] - start.position_m[1]) > 2 * extent(both, twin).radius_m
    with pytest.raises(NotConvergedError, match=r"no start without overlap in 1000 draws for 2 free bodies"):
        draw_start(both, resolve_plan(both, SamplingPlan(offset_m=0.0, height_m=(0, 0))), 1.0, np.random.default_rng(0))


def test_parameters_follow_the_posterior() -> None:
    file = small_model().file
    draws = [draw_parameters(file, 1.0, np.random.default_rng(seed)) for seed in range(400)]
    friction = np.array([entries[0].value for _, entries in draws])
    # friction has positive bounds: its logarithm is normal
    assert stats.kstest(np.log(friction), stats.norm(np.log(0.4), 0.05 / 0.4).cdf).pvalue > 0.01
    assert all(drawn.contact is not None and drawn.contact.friction == entries[0].value for drawn, entries in draws)
    assert {entries[2].value for _, entries in draws} == {MASS}  # given, so not varied
    assert len({entries[1].value for _, entries in draws}) == 400
    assert draw_parameters(file, 0.0, np.random.default_rng(0))[0] == file


def test_parameters_stay_within_their_bounds() -> None:
    tight = FittedParameter(name="friction", unit="1", estimate=0.4, std_error=5.0, bounds=(0.3, 0.5))
    signed = FittedParameter(name="ground_offset_m", unit="m", estimate=0.0, std_error=1.0, bounds=(-0.01, 0.02))
    file = small_model().file.model_copy(update={"parameters": (tight, signed)})
    values = np.array(
        [[entry.value for entry in draw_parameters(file, 1.0, np.random.default_rng(seed))[1]] for seed in range(200)]
    )
    assert 0.3 <= values[:, 0].min() < 0.32 and 0.48 < values[:, 0].max() <= 0.5
    assert -0.01 <= values[:, 1].min() < -0.008 and 0.018 < values[:, 1].max() <= 0.02


def test_a_parameter_is_set_where_it_belongs() -> None:
    file = small_model().file.model_copy(update={"effects": (EffectModel(name="drag", parameters={"c": 0.1}),)})
    heavier = with_parameter(file, "cube.mass_kg", 2 * MASS).bodies[0]
    assert heavier.inertia_kg_m2[0] == pytest.approx(2 * file.bodies[0].inertia_kg_m2[0])
    assert with_parameter(file, "cube.com_y_m", 0.01).bodies[0].com_m == (0, 0.01, 0)
    moved = with_parameter(file, "ground_offset_m", -0.003)
    assert moved.ground is not None and moved.ground.offset_m == -0.003
    assert with_parameter(file, "drag.c", 0.3).effects[0].parameters == {"c": 0.3}
    with pytest.raises(InputDataError, match=r"no physical parameter 'ball.mass_kg'"):
        with_parameter(file, "ball.mass_kg", 1.0)


def test_settings_are_in_the_file(dataset: Path) -> None:
    with h5py.File(next(dataset.glob("*.h5"))) as file:
        settings = json.loads(file.attrs["config_json"])
    assert settings["seed"] == 5 and settings["plan"]["height_m"][0] > 0 and "shard" not in settings
    assert settings == read_manifest(dataset).config


def test_the_cameras_see_the_bodies(dataset: Path) -> None:
    reader = RolloutReader(dataset)
    assert reader.cameras() == ["view0", "view1"]
    for number in range(len(reader)):
        assert (reader.read(number, "bodies/visible_px") > 20).mean() > 0.8
    assert len(cube_splats()) == 400
    reader.close()

"""Rollout files: robomimic's names, units on everything, equal bytes, lossless images, readable in workers."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.mjcf import mujoco_states, write_mjcf
from cgwm.datasets.rollouts.loader import RolloutDataset, RolloutReader
from cgwm.datasets.rollouts.rollout_writer import RolloutWriter
from cgwm.datasets.rollouts.rollouts import ContactTable, FrameBlock, RolloutLabels, RolloutParameter, open_shard
from cgwm.pipeline.geometry.viewpoint import look_at
from cgwm.schemas import InputDataError, UsageError
from helpers.small_model import HALF, MASS, small_model

FRAMES = 11
SIZE = (24, 32)
K = np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])


def camera() -> Camera:
    pose = look_at(np.array([0.0, -0.5, 0.3]), np.zeros(3), np.array([0.0, 0, 1]))
    return Camera(width=SIZE[1], height=SIZE[0], K=K, distortion=np.zeros(0), T_world_cam=pose)


def labels(index: int, seed: int = 3) -> RolloutLabels:
    rng = np.random.default_rng([seed, index])
    quat = rng.normal(size=(FRAMES, 1, 4))
    counts = rng.integers(0, 3, FRAMES)
    total = int(counts.sum())
    table = ContactTable(
        offsets=np.concatenate([[0], counts.cumsum()]),
        body_a=np.zeros(total, np.int32),
        body_b=np.full(total, -1, np.int32),
        position_m=rng.normal(size=(total, 3)),
        normal=np.tile([0.0, 0, 1], (total, 1)),
        distance_m=rng.normal(size=total),
        impulse_n_s=rng.random((total, 3)),
        sliding=rng.integers(0, 2, total).astype(np.uint8),
    )
    poses = (rng.normal(size=(FRAMES, 1, 3)), quat / np.linalg.norm(quat, axis=-1, keepdims=True))
    speeds = (rng.normal(size=(FRAMES, 1, 3)), rng.normal(size=(FRAMES, 1, 3)))
    times = np.arange(FRAMES) / 30
    model = small_model()
    return RolloutLabels(
        episode_index=index,
        seed=seed,
        model_mjcf=write_mjcf(model),
        time_s=times,
        states=mujoco_states(model.file, times, (*poses, *speeds)),
        actions=np.zeros((FRAMES, 1)),
        action_meaning="none",
        bodies=("cube",),
        motions=("free",),
        mass_kg=np.array([MASS]),
        com_m=np.zeros((1, 3)),
        inertia_kg_m2=np.ones((1, 6)),
        position_m=poses[0],
        quat_wxyz=poses[1],
        velocity_m_s=speeds[0],
        omega_body_rad_s=speeds[1],
        gravity_m_s2=np.array([0, 0, -9.81]),
        contacts=table,
        contact_force_n=rng.normal(size=(FRAMES, 1, 3)),
        contact_torque_n_m=rng.normal(size=(FRAMES, 1, 3)),
        parameters=(RolloutParameter(name="friction", unit="1", value=0.41, estimate=0.4, std_error=0.05),),
        cameras={"left": camera()},
    )


def blocks(index: int) -> list[FrameBlock]:
    rng = np.random.default_rng(index)
    image = rng.integers(0, 256, (FRAMES, *SIZE, 3), dtype=np.uint8)
    depth = rng.random((FRAMES, *SIZE)).astype(np.float32)
    mask = rng.integers(0, 2, (FRAMES, *SIZE), dtype=np.uint8)
    amodal = mask | rng.integers(0, 2, (FRAMES, *SIZE), dtype=np.uint8)
    counts = (mask.sum((1, 2), dtype=np.int32)[:, None], amodal.sum((1, 2), dtype=np.int32)[:, None])
    arrays = (image, depth, mask, amodal, *counts)
    parts = (slice(0, 8), slice(8, FRAMES))
    return [FrameBlock("left", part.start, *(array[part] for array in arrays)) for part in parts]


def write(path: Path, indices: tuple[int, ...] = (0, 1, 4), compression: str = "zstd") -> Path:
    with RolloutWriter(path, 3, "{}", "cgwm test", compression) as writer:  # pyright: ignore[reportArgumentType]
        for index in indices:
            writer.write(labels(index), blocks(index))
    return path


def test_robomimic_finds_its_names(tmp_path: Path) -> None:
    with h5py.File(write(tmp_path / "a.h5"), "r") as file:
        data = file["data"]
        demos = sorted(data, key=lambda name: int(name[5:]))
        assert demos == ["demo_0", "demo_1", "demo_4"]
        assert data.attrs["total"] == 3 * FRAMES
        assert {"env_name", "type", "env_kwargs"} <= set(json.loads(data.attrs["env_args"]))
        assert [name.decode() for name in file["mask/train"][:]] == ["demo_0", "demo_1"]
        assert [name.decode() for name in file["mask/valid"][:]] == ["demo_4"]
        for demo in map(data.__getitem__, demos):
            assert demo.attrs["num_samples"] == FRAMES
            assert len(demo["actions"]) == len(demo["states"]) == len(demo["rewards"]) == FRAMES
            assert demo["dones"][:].tolist() == [0] * (FRAMES - 1) + [1]
            assert np.abs(demo["actions"][:]).max() <= 1
            assert (
                sorted(demo["obs"])
                == sorted(demo["next_obs"])
                == ["left_amodal", "left_depth", "left_image", "left_mask", "object"]
            )
            for key in demo["obs"]:
                now, after = demo["obs"][key][()], demo["next_obs"][key][()]
                np.testing.assert_array_equal(after[:-1], now[1:])
                np.testing.assert_array_equal(after[-1], now[-1])


def test_everything_says_its_unit_frame_and_order(tmp_path: Path) -> None:
    seen = []

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and "next_obs" not in name:
            assert {"unit", "frame", "order", "shape_meaning", "description"} <= set(item.attrs), name
            assert item.attrs["description"], name
            seen.append(name)

    with h5py.File(write(tmp_path / "a.h5", (0,)), "r") as file:
        file["data"].visititems(visit)
        assert "w x y z" in file.attrs["convention"]
        assert file["data/demo_0/bodies/quat_wxyz"].attrs["order"] == "w x y z"
        assert file["data/demo_0/contacts/impulse_world"].attrs["unit"] == "N s"
        assert file["data/demo_0/parameters/friction"].attrs["std_error"] == 0.05
    assert len(seen) > 30


@pytest.mark.parametrize("compression", ["zstd", "gzip", "none"])
def test_what_is_written_is_read_back(tmp_path: Path, compression: str) -> None:
    path = write(tmp_path / "a.h5", (2,), compression)
    reader = RolloutReader(path)
    truth = labels(2)
    np.testing.assert_array_equal(reader.read(0, "bodies/pos"), truth.position_m)
    np.testing.assert_array_equal(reader.read(0, "contacts/impulse_world"), truth.contacts.impulse_n_s)
    np.testing.assert_array_equal(reader.read(0, "cameras/left/T_world_cam"), camera().T_world_cam)
    for key in ("image", "depth", "mask", "amodal"):
        written = np.concatenate([getattr(block, key) for block in blocks(2)])
        np.testing.assert_array_equal(reader.read(0, f"obs/left_{key}"), written)
    visible, whole = (np.concatenate([getattr(b, key) for b in blocks(2)]).sum((1, 2)) for key in ("mask", "amodal"))
    np.testing.assert_array_equal(reader.read(0, "bodies/visible_px")[:, 0, 0], visible)
    np.testing.assert_array_equal(reader.read(0, "bodies/visible_fraction")[:, 0, 0], visible / whole)
    assert reader.parameters(0) == {"friction": 0.41}
    assert reader.group(0)["obs/left_image"].chunks == (8, *SIZE, 3)
    reader.close()


def test_equal_content_gives_equal_bytes(tmp_path: Path) -> None:
    first = sha256(write(tmp_path / "a.h5"))
    time.sleep(1.1)  # HDF5's own time stamps have a resolution of a second
    assert sha256(write(tmp_path / "b.h5")) == first


def test_frames_that_are_not_written_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="camera left: 3 of 11 frames were not written"):
        with RolloutWriter(tmp_path / "a.h5", 0, "{}", "test") as writer:
            writer.write(labels(0), blocks(0)[:1])


def test_a_missing_filter_is_named_with_its_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, plain = write(tmp_path / "a.h5", (0,)), write(tmp_path / "b.h5", (0,), "gzip")
    monkeypatch.setitem(sys.modules, "hdf5plugin", None)
    monkeypatch.setattr(h5py.h5z, "filter_avail", lambda number: False)
    with pytest.raises(
        InputDataError, match=r"needs the HDF5 filter zstd.*\n.*gzip or none.*\n.*pip install hdf5plugin"
    ):
        open_shard(path)
    with pytest.raises(InputDataError, match="pip install hdf5plugin"):
        RolloutWriter(tmp_path / "c.h5", 0, "{}", "test")
    assert not (tmp_path / "c.h5").exists()
    open_shard(plain).close()


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(InputDataError, match="not a readable HDF5 file"):
        open_shard(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w"):
        pass
    with pytest.raises(InputDataError, match="its format attribute is 'none'"):
        open_shard(tmp_path / "other.h5")
    with pytest.raises(InputDataError, match="no such file"):
        open_shard(tmp_path / "absent.h5")


def test_windows_and_contacts_of_a_frame(tmp_path: Path) -> None:
    reader = RolloutReader(write(tmp_path / "a.h5"))
    window = reader.window(1, 6, 4, ["bodies/pos", "obs/left_image"])
    np.testing.assert_array_equal(window["bodies/pos"], labels(1).position_m[6:10])
    table = labels(1).contacts
    for frame in range(FRAMES):
        rows = slice(*table.offsets[frame : frame + 2])
        np.testing.assert_array_equal(reader.contacts(1, frame)["pos_world"], table.position_m[rows])
    with pytest.raises(UsageError, match="frames 9 to 13 of rollout 1, which has 11"):
        reader.window(1, 9, 4, ["bodies/pos"])
    with pytest.raises(UsageError, match=r"no array 'bodies/poss'. Did you mean 'bodies/pos'"):
        reader.read(0, "bodies/poss")
    with pytest.raises(UsageError, match=r"no split 'test'.*\nAllowed: train, valid"):
        RolloutReader(tmp_path / "a.h5", split="test")
    reader.close()


def test_torch_loader_with_workers(tmp_path: Path) -> None:
    """Forked ones; `test_loader.py` spawns some, too."""
    from torch.utils.data import DataLoader

    dataset = RolloutDataset(write(tmp_path / "a.h5", (0, 1)), length=4)
    assert len(dataset) == 4
    first = dataset[0]  # opens the file in this process, which a fork must not use
    loader = DataLoader(dataset, batch_size=2, num_workers=1, multiprocessing_context="fork")  # pyright: ignore
    batches = list(loader)
    assert batches[0]["obs/left_image"].shape == (2, 4, *SIZE, 3)
    np.testing.assert_array_equal(batches[0]["obs/left_image"][0], first["obs/left_image"])
    np.testing.assert_array_equal(batches[1]["left_K"][0], K)
    assert [int(value) for batch in batches for value in batch["rollout"]] == [0, 0, 1, 1]


def test_mjcf_is_the_fitted_model() -> None:
    model = small_model(driven=True, com_m=(0.01, 0, -0.005))
    text = write_mjcf(model, {"left": camera()})
    loaded = mujoco.MjModel.from_xml_string(text)
    cube = loaded.body("cube")
    assert loaded.nq == 7 and loaded.nmocap == 1
    np.testing.assert_allclose(cube.mass, MASS)
    np.testing.assert_allclose(cube.ipos, [0.01, 0, -0.005])
    np.testing.assert_allclose(np.sort(cube.inertia), np.full(3, MASS / 6 * (2 * HALF) ** 2))
    geoms = [index for index in range(loaded.ngeom) if loaded.geom_bodyid[index] == cube.id]
    np.testing.assert_allclose(loaded.geom_pos[geoms], model.collision["cube"].means, atol=1e-9)
    np.testing.assert_allclose(loaded.geom_size[geoms, 0], model.collision["cube"].scales * 2.0)
    np.testing.assert_allclose(loaded.geom_friction[geoms, 0], 0.4)
    np.testing.assert_allclose(loaded.geom_solref[geoms], np.tile([0.008 / 0.3, 0.3], (len(geoms), 1)))
    assert loaded.opt.timestep <= 0.008 / 20 + 1e-12


def test_mjcf_camera_sees_what_ours_sees() -> None:
    off_centre = np.array([[40.0, 0, 14], [0, 40.0, 9], [0, 0, 1]])
    loaded = mujoco.MjModel.from_xml_string(write_mjcf(small_model(), {"left": replace(camera(), K=off_centre)}))
    data = mujoco.MjData(loaded)
    mujoco.mj_forward(loaded, data)
    rotation = data.cam_xmat[0].reshape(3, 3) @ np.diag([1.0, -1, -1])
    np.testing.assert_allclose(rotation, camera().T_world_cam[:3, :3], atol=1e-9)
    np.testing.assert_allclose(data.cam_xpos[0], camera().T_world_cam[:3, 3], atol=1e-9)
    scene, view = mujoco.MjvScene(loaded, 100), mujoco.MjvCamera()
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateScene(loaded, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    seen = scene.camera[0]
    bottom, top = (40 * edge / seen.frustum_near for edge in (seen.frustum_bottom, seen.frustum_top))
    centre, half = (40 * value / seen.frustum_near for value in (seen.frustum_center, seen.frustum_width))
    np.testing.assert_allclose([half - centre, top, -bottom], [14, 9, SIZE[0] - 9], rtol=1e-5)


def test_mujoco_flies_as_the_stored_states_say() -> None:
    """A free joint's convention is ours: velocity of the body origin in world axes, spin in body axes."""
    import torch
    from cgwm.pipeline.physics.model_world import world_of_model
    from cgwm.pipeline.physics.rollout import simulate
    from cgwm.pipeline.physics.state import State

    model = small_model(com_m=(0.01, -0.004, 0.006))
    times = np.arange(0, 0.101, 0.02)
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    state = State(
        one * torch.tensor([0.0, 0, 1]), one * torch.tensor([1.0, 0, 0, 0]), one * torch.tensor([0.3, 0, 1]),
        one * torch.tensor([3.0, 5, -2]),
    )  # fmt: skip
    rollout = simulate(world_of_model(model), state, torch.as_tensor(times))
    parts = (rollout.position_m, rollout.quat_wxyz, rollout.velocity_m_s, rollout.omega_body_rad_s)
    states = mujoco_states(model.file, times, tuple(part[0].numpy() for part in parts))  # pyright: ignore
    loaded = mujoco.MjModel.from_xml_string(write_mjcf(model))
    data = mujoco.MjData(loaded)
    data.qpos[:], data.qvel[:] = states[0, 1:8], states[0, 8:]
    for expected in states[1:]:
        while data.time < expected[0] - 1e-9:
            mujoco.mj_step(loaded, data)
        np.testing.assert_allclose(data.qpos[:3], expected[1:4], atol=1e-5)
        np.testing.assert_allclose(data.qpos[3:], expected[4:8], atol=2e-4)
        np.testing.assert_allclose(data.qvel, expected[8:], atol=2e-3)

"""Rollouts in batches: what one holds does not depend on the others, and one that diverges takes none along."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.datasets.rollouts.rollouts import ContactTable
from cgwm.pipeline.physics.fused.rollout import roll
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.net_contact_wrench import contact_force_n, contact_torque_n_m
from cgwm.pipeline.runtime import kernel_build
from cgwm.pipeline.synthesize import simulator as batches
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.synthesize.simulator import joined_worlds
from cgwm.schemas import SamplingPlan, SynthesizeConfig
from helpers import fused_host
from helpers.small_model import MASS, small_model, write_small_model

CONFIG = SynthesizeConfig(
    rollouts=9, duration_s=0.2, width=48, height=32, device="cpu", seed=5, plan=SamplingPlan(views=1)
)
FEW_FRAMES = CONFIG.model_copy(update={"frame_rate_hz": 10.0})
"""Of the same motions: each image takes longer than the steps between two."""
FIVE = FEW_FRAMES.model_copy(update={"rollouts": 5})
CUDA = torch.cuda.is_available() and kernel_build.available()
NEEDS_GPU = pytest.mark.skipif(not CUDA, reason="needs a CUDA device and cuda.core")
NEEDS_COMPILER = pytest.mark.skipif(fused_host.COMPILER is None, reason="needs g++ to build the kernel for the CPU")


def hashes(model: Path, folder: Path, config: SynthesizeConfig, sizes: tuple[int, ...] = (1, 8, 9)) -> set[str]:
    """Return the hashes of the dataset for several sizes of the batch."""
    return {synthesize(model, folder / f"{size}", config.model_copy(update={"batch": size})).sha256 for size in sizes}


def test_the_batch_changes_no_byte(tmp_path: Path) -> None:
    assert len(hashes(write_small_model(tmp_path / "model"), tmp_path, FIVE, sizes=(1, 4))) == 1


# In the suite: the same without the kernel above; that rollouts do not see each other in it: test_fused.py.
@pytest.mark.evidence
@NEEDS_COMPILER
@pytest.mark.parametrize("driven", [False, pytest.param(True, marks=pytest.mark.evidence)])
def test_the_batch_changes_no_byte_in_the_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driven: bool) -> None:
    """The fused kernel, built for the CPU, takes many rollouts with numbers of their own; none sees the others."""
    calls: list[int] = []

    def fused(world: object, state: object, *rest: object, **options: object) -> object:
        calls.append(len(state.position_m))
        return roll(fused_host.run, world, state, *rest, **options)

    monkeypatch.setattr(batches, "roll_out", fused)
    monkeypatch.setattr(batches, "unsupported", lambda world: None)
    monkeypatch.setattr(batches, "ENVIRONMENTS", 4)
    build = batches.Simulator.__init__

    def together(self: object, *arguments: object) -> None:
        build(self, *arguments)
        self._together = True

    monkeypatch.setattr(batches.Simulator, "__init__", together)
    model = write_small_model(tmp_path / "model", driven=driven)
    assert len(hashes(model, tmp_path, FEW_FRAMES)) == 1
    assert set(calls) == {4} and len(calls) == 9 + (2 + 1) + 3
    monkeypatch.undo()
    alone = synthesize(model, tmp_path / "torch", FEW_FRAMES)
    one, other = RolloutReader(tmp_path / "torch" / alone.shard), RolloutReader(tmp_path / "8" / alone.shard)
    for number in range(9):  # the same motions as the torch engine's, to rounding
        np.testing.assert_allclose(one.read(number, "bodies/pos"), other.read(number, "bodies/pos"), atol=1e-7)
        assert one.parameters(number) == other.parameters(number)
    one.close()
    other.close()


@NEEDS_GPU
def test_the_batch_and_the_sharding_change_no_byte_on_a_gpu(tmp_path: Path) -> None:
    model = write_small_model(tmp_path / "model")
    config = CONFIG.model_copy(update={"device": "cuda"})
    assert len(hashes(model, tmp_path, config)) == 1
    for shard in range(2):
        synthesize(model, tmp_path / "shards", config.model_copy(update={"shards": 2, "shard": shard}))
    one, other = RolloutReader(tmp_path / "1"), RolloutReader(tmp_path / "shards")
    for number in range(9):
        for key in one.keys(number):
            np.testing.assert_array_equal(one.read(number, key), other.read(number, key), err_msg=key)


@NEEDS_GPU
def test_a_gpu_makes_what_the_cpu_makes(tmp_path: Path) -> None:
    model = write_small_model(tmp_path / "model", driven=True)
    readers = []
    for device in ("cpu", "cuda"):
        summary = synthesize(model, tmp_path / device, CONFIG.model_copy(update={"device": device, "rollouts": 3}))
        readers.append(RolloutReader(tmp_path / device / summary.shard))
    for number in range(3):
        one, other = ({key: reader.read(number, key) for key in reader.keys(number)} for reader in readers)
        np.testing.assert_allclose(one["bodies/pos"], other["bodies/pos"], atol=1e-6)
        for camera in readers[0].cameras(number):
            images = [values[f"obs/{camera}_image"].astype(int) for values in (one, other)]
            assert np.abs(images[0] - images[1]).max() <= 2
            for key in ("mask", "amodal"):
                assert (one[f"obs/{camera}_{key}"] != other[f"obs/{camera}_{key}"]).mean() < 1e-3
            same = one[f"obs/{camera}_mask"] == other[f"obs/{camera}_mask"]
            assert np.abs(one[f"obs/{camera}_depth"] - other[f"obs/{camera}_depth"])[same].max() < 1e-3


def test_worlds_are_joined_by_their_numbers() -> None:
    model = small_model()
    heavy = model.file.bodies[0].model_copy(update={"mass_kg": 2 * MASS})
    other = replace(model, file=model.file.model_copy(update={"bodies": (heavy,)}))
    base = world_of_model(model)
    joined = joined_worlds([world_of_model(one, geometry=base) for one in (model, other, model)])
    assert joined.bodies[0].mass.tolist() == [MASS, 2 * MASS, MASS]
    assert joined.bodies[0].centers is base.bodies[0].centers
    assert joined.contact.friction.shape == (3,) and joined.ground_normal.shape == (3,)
    tilted = replace(base, ground_normal=torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="worlds differ in a tensor of shape"):
        joined_worlds([base, tilted])


def test_one_that_diverges_is_drawn_again_and_takes_none_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = write_small_model(tmp_path / "model")
    synthesize(model, tmp_path / "whole", FIVE)
    simulate, calls = batches.roll_out, []

    def diverge(*arguments: object, **options: object) -> object:
        rollout = simulate(*arguments, **options)
        calls.append(len(calls))
        return replace(rollout, position_m=rollout.position_m * torch.nan) if calls[-1] == 3 else rollout

    monkeypatch.setattr(batches, "roll_out", diverge)
    summary = synthesize(model, tmp_path / "out", FIVE)
    (note,) = (note for note in summary.notes if "drawn again" in note)
    assert "drawn again: rollout 3 (seed 5) diverged by step 0" in note
    assert summary.rollouts == 5 and summary.rejected == {"diverged": 1}
    whole, other = RolloutReader(tmp_path / "whole"), RolloutReader(tmp_path / "out")
    for number in range(5):
        same = [np.array_equal(other.read(number, key), whole.read(number, key)) for key in other.keys(number)]
        assert all(same) == (number != 3)
    whole.close()
    other.close()


# In the suite: `validate` holds labels to Newton's law in test_validate.py.
@pytest.mark.evidence
def test_forces_are_what_changes_momenta(tmp_path: Path) -> None:
    summary = synthesize(write_small_model(tmp_path / "model"), tmp_path / "out", CONFIG)
    reader = RolloutReader(tmp_path / "out" / summary.shard)
    pushed = 0
    for number in range(summary.rollouts):
        read = {key: reader.read(number, f"bodies/{key}") for key in ("vel", "contact_force", "contact_torque", "mass")}
        interval = np.diff(reader.read(number, "time"))[:, None]
        change = MASS * (np.diff(read["vel"][:, 0], axis=0) / interval - np.array([0, 0, -9.81]))
        np.testing.assert_allclose(read["contact_force"][1:, 0], change, atol=1e-9)
        assert not read["contact_force"][0].any() and not read["contact_torque"][0].any()
        offsets, force = reader.read(number, "contacts/offsets"), reader.read(number, "contacts/force_world")
        for frame in range(1, len(offsets) - 1):
            total = force[offsets[frame] : offsets[frame + 1]].sum(0)
            np.testing.assert_allclose(total, read["contact_force"][frame, 0], atol=1e-9)
            pushed += bool(np.linalg.norm(total) > 1)
            turning = np.linalg.norm(read["contact_torque"][frame, 0])
            assert turning < 1e-9 if np.linalg.norm(total) < 1e-12 else turning < 0.09 * 2 * np.linalg.norm(total)
    assert pushed > 3
    reader.close()


def test_pairs_push_each_other_and_torques_turn() -> None:
    table = ContactTable(
        offsets=np.array([0, 0, 2]),
        body_a=np.array([0, 1]),
        body_b=np.array([1, -1]),
        position_m=np.zeros((2, 3)),
        normal=np.tile([0.0, 0, 1], (2, 1)),
        distance_m=np.zeros(2),
        impulse_n_s=np.array([[1.0, 0, 2], [0, 3, 0]]),
        sliding=np.zeros(2, np.uint8),
    )
    force = contact_force_n(table, np.array([0.0, 0.5]), 2)
    np.testing.assert_allclose(force[1], [[2, 0, 4], [-2, 6, -4]])
    # a body turned by 90 degrees about z spins up about its own x axis, the world's y
    half = np.sqrt(0.5)
    quat = np.tile([half, 0, 0, half], (2, 1, 1))
    omega = np.array([[[0.0, 0, 0]], [[3.0, 0, 0]]])
    torque = contact_torque_n_m(quat, omega, np.array([[2.0, 5, 7, 0, 0, 0]]), np.array([0.0, 0.5]), np.array([True]))
    np.testing.assert_allclose(torque[1, 0], [0, 12, 0], atol=1e-12)

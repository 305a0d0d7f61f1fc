"""What turns a capture into what the rivals themselves read: frames and states agree; what is not fetched is said."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.synthetic.objects import make_object
from cgwm.schemas import UsageError
from scipy.spatial.transform import Rotation

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))  # as `python benchmarks/fall_push.py` has it
try:
    from contenders.latent_model import Sequences
    from rivals import dreamer, source
    from rivals.pinwm_frames import Local
finally:
    sys.path.remove(str(BENCHMARKS))


def test_a_state_in_the_simulators_frame_is_that_of_the_mass_centre() -> None:
    solid = make_object(2)  # an L-block
    local = Local.of(solid)
    quat, omega, velocity = np.array([0.5, -0.1, 0.7, 0.5]), np.array([1.0, -4, 2]), np.array([0.3, 0.1, -0.2])
    quat /= np.linalg.norm(quat)
    position = np.array([0.1, 0.2, 0.3])
    place, turned, speed, spin = local.state(position, quat, velocity, omega)
    after = Rotation.from_quat(quat, scalar_first=True) * Rotation.from_rotvec(1e-6 * omega)  # omega is in the body
    moved = local.pose(position + 1e-6 * velocity, after.as_quat(scalar_first=True))[0]
    np.testing.assert_allclose((moved - place) / 1e-6, speed, atol=1e-5)
    np.testing.assert_allclose(spin, Rotation.from_quat(quat, scalar_first=True).apply(omega), atol=1e-12)
    # its axes are those of inertia, and the way back is the way there
    inertia = local.R_body_local.T @ solid.inertia @ local.R_body_local
    np.testing.assert_allclose(inertia, np.diag(local.moments), atol=1e-12)
    back, unturned = local.body_pose(place, turned)
    np.testing.assert_allclose(back, position, atol=1e-12)
    assert abs(unturned @ quat) == pytest.approx(1)


def test_a_rival_that_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CGWM_PINWM", raising=False)
    with pytest.raises(UsageError, match="CGWM_PINWM is not set"):
        source.source("CGWM_PINWM")
    monkeypatch.setenv("CGWM_PINWM", str(tmp_path / "nowhere"))
    with pytest.raises(UsageError, match="is no folder"):
        source.source("CGWM_PINWM")


def test_a_package_that_is_missing_can_be_named_and_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    source.may_lack(["no_such_package_of_meshes"])
    found = source.module("no_such_package_of_meshes.parts")
    assert isinstance(found.base.Mesh, type)  # as in the annotation of an argument
    with pytest.raises(ImportError, match="was called"):
        found.base.Mesh()


class Echo:
    """An agent that imagines what is true, each draw off by as much to either side."""

    def __init__(self, truth: dreamer.Arrays) -> None:
        self.truth = truth

    def imagine(self, one: dreamer.Arrays, draws: int) -> tuple[np.ndarray, np.ndarray]:
        np.testing.assert_array_equal(one["state"][:, 0], self.truth["state"][:, 0])
        off = 0.05 * np.where(np.arange(draws) % 2, 1, -1)[:, None, None]
        return (self.truth["state"] + off).astype(np.float32), (self.truth["image"][0] / 255).astype(np.float32)


def test_what_the_agent_observes_is_read_back_as_poses() -> None:
    frames, generator = 6, torch.Generator().manual_seed(3)
    turns = torch.as_tensor(Rotation.random(frames, rng=np.random.default_rng(1)).as_matrix(), dtype=torch.float32)
    draw = partial(torch.rand, generator=generator)
    data = Sequences(
        images=draw(1, frames, 6, 4, 5),
        position_m=draw(1, frames, 3) - 0.5,
        rotation=turns[None],
        velocity_m_s=draw(1, frames, 3),
        omega_world_rad_s=draw(1, frames, 3),
        driven_m=draw(1, frames, 1, 3) - 0.5,
        known=torch.ones(1, frames, dtype=torch.bool),
    )
    truth = dreamer.observed(data)
    assert truth["is_first"].sum() == 1 and truth["is_last"].sum() == 1
    np.testing.assert_allclose(truth["action"][0, :-1, 3:], truth["action"][0, 1:, :3])  # where it is and will be
    position, rotation, images = dreamer.ahead(Echo(truth), frames, data)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(position[0], data.position_m[0], atol=1e-6)
    np.testing.assert_allclose(rotation[0], turns, atol=1e-5)
    np.testing.assert_allclose(images, data.images, atol=1 / 400)

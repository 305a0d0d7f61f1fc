"""The fit from images as a whole: spheres that touch are moved, the best step is kept, and poses are found but once."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.phys_geo.images import image_fit, video_episodes
from cgwm.pipeline.phys_geo.images.contact_spheres import MOVED_STD_M, ContactSpheres, dense_times
from cgwm.pipeline.phys_geo.images.end_to_end import PATIENCE, ImageObjective, refine_end_to_end
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseTrack, PoseTracker
from cgwm.pipeline.physics import engine
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.physics.rollout import Rollout
from cgwm.pipeline.physics.world import World
from cgwm.schemas import PhysConfig, UsageError
from helpers.pose_search import search_briefly
from helpers.tiny_capture import EPISODE, model_of, start_state, thrown, write_tiny_capture
from helpers.worlds import box_body, state_of, times, world_of
from pipeline.phys_geo.images.test_honest_supervision import contents
from pipeline.phys_geo.images.test_phys_images import FRAMES, NAMES, TRUTH, film, objective_of, tiny_model

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = PhysConfig(supervise="images", device="cpu", step_s=0.003, population=8, generations=2, iterations=1)
SHORT = 5


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    search_briefly(monkeypatch)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    track = thrown()
    assert track.quat_wxyz is not None
    short = Track(track.time_s[:SHORT], track.position_m[:SHORT], track.quat_wxyz[:SHORT])
    return write_tiny_capture(tmp_path_factory.mktemp("fit") / "capture", short)


@pytest.fixture(scope="module")
def known(capture: Path) -> list[PoseTrack]:
    """What the tracker found in this capture, once it was asked."""
    return []


def track_once(known: list[PoseTrack], patch: pytest.MonkeyPatch) -> None:
    """Let a tracker give what another found in the same videos: looking for poses takes long."""
    run = PoseTracker.run

    def found(self: PoseTracker) -> PoseTrack:
        if not known:
            known.append(run(self))
        return known[0]

    patch.setattr(PoseTracker, "run", found)


def fitted(capture: Path, out: Path, config: PhysConfig = CONFIG, resume: bool = False) -> dict[str, bytes]:
    fit(capture, out, "phys-geo", model_of(capture), phys_config=config, resume=resume)
    return contents(out)


@pytest.fixture(scope="module")
def plain(capture: Path, known: list[PoseTrack], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The fit with the settings of these tests."""
    out = tmp_path_factory.mktemp("plain") / "model"
    with pytest.MonkeyPatch.context() as patch:
        search_briefly(patch)
        track_once(known, patch)
        fitted(capture, out)
    return out


# In the suite: the choice of spheres and how they move the body are tested below.
@pytest.mark.evidence
def test_spheres_that_touch_are_moved_where_that_is_wanted(
    capture: Path, plain: Path, known: list[PoseTrack], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track_once(known, monkeypatch)
    before = (model_of(capture) / "cube.collision.ply").read_bytes()
    assert contents(plain)["cube.collision.ply"] == before
    assert read_model(plain).fit.stages["phys-geo"]["geometry"] == {}
    moved = fitted(capture, tmp_path / "moved", CONFIG.model_copy(update={"geometry": True}))
    assert moved["cube.collision.ply"] != before
    record = read_model(tmp_path / "moved").fit.stages["phys-geo"]["geometry"]["cube"]
    old, new = (read_model(path).collision["cube"] for path in (model_of(capture), tmp_path / "moved"))
    away = np.linalg.norm(new.means - old.means, axis=1)
    assert 1 <= (away > 1e-9).sum() <= record["spheres"] < len(old.means)
    assert 1e-7 < away.max() < record["moved_most_m"] + 1e-7
    assert record["moved_most_m"] < 2.5 * (3**0.5 + 1) * MOVED_STD_M


# In the suite: poses come from the checkpoint in test_honest_supervision.py, refusals are those of test_checkpoint.py.
@pytest.mark.evidence
def test_an_interrupted_fit_does_not_look_for_poses_again(
    capture: Path, plain: Path, known: list[PoseTrack], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track_once(known, monkeypatch)
    whole = contents(plain)
    out = tmp_path / "model"

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(image_fit, "fit_with_effects", interrupted)
        fitted(capture, out)
    assert not out.exists()
    checkpoint = tmp_path / "model.checkpoint"
    assert [path.name.startswith(f"poses-of-{EPISODE}") for path in checkpoint.glob("*.npz")] == [True]

    def again(_: PoseTracker) -> PoseTrack:
        raise AssertionError("the poses were looked for again")

    monkeypatch.setattr(video_episodes.PoseTracker, "run", again)
    with pytest.raises(UsageError, match=r"made with other physics settings(.|\n)*--overwrite"):
        fitted(capture, out, CONFIG.model_copy(update={"seed": 1}), resume=True)
    with pytest.raises(UsageError, match="--resume"):
        fitted(capture, out)
    resumed = fitted(capture, out, resume=True)
    assert [name for name in whole if whole[name] != resumed.get(name)] == []
    assert set(whole) == set(resumed) and f"pose_tracks/{EPISODE}.csv" in whole
    assert not checkpoint.exists()


@dataclass(frozen=True)
class Scripted(ImageObjective):
    """An objective whose held-out loss is written beforehand, step by step."""

    script: list[float] = field(default_factory=list)
    told: list[float] = field(default_factory=list)

    def parts(self, rollout: Rollout, held: bool = False) -> torch.Tensor:
        if not held:
            return super().parts(rollout)
        self.told.append(self.script[len(self.told)])
        return torch.tensor([self.told[-1], 0.0, 0.0], dtype=torch.float64)


@pytest.mark.parametrize(
    ("script", "kept"),
    [
        ([1.0, 0.8, 0.9, 0.85, 0.1], 1),
        pytest.param([1.0, 1.1, 1.2, 0.1], 0, marks=pytest.mark.evidence),
        pytest.param([1.0, 0.9, 0.95, 0.8], 3, marks=pytest.mark.evidence),
    ],
)
def test_the_step_is_kept_that_explains_what_was_held_out_best(script: list[float], kept: int) -> None:
    model = tiny_model()
    world = world_of_model(model)
    rollout = engine.rollout(world, start_state(), torch.arange(FRAMES, dtype=torch.float64) / 30)
    plain = objective_of((model, world, rollout), film(model, rollout))
    shared, states = TRUTH + torch.tensor([0.3, -0.4], dtype=torch.float64), torch.zeros(1, 12, dtype=torch.float64)
    states[0, [0, 2, 6, 8]] = torch.tensor([0.01, 0.006, 0.08, 0.08], dtype=torch.float64)
    bounds = torch.tensor([p.limits for p in NAMES], dtype=torch.float64)
    last = min(kept + PATIENCE, len(script) - 1)
    values = {name: getattr(plain, name) for name in plain.__dataclass_fields__}
    objective = Scripted(**(values | {"held": plain.columns}), script=script)
    found = refine_end_to_end(objective, shared, states, bounds, last if kept == 3 else 8)
    assert found.kept == kept and found.held == script[: last + 1]
    assert (found.stopped == "the frames held out are no longer explained better") == (kept < 3)
    alone = refine_end_to_end(plain, shared, states, bounds, kept)
    assert torch.equal(found.shared, alone.shared) and torch.equal(found.states, alone.states)
    assert torch.equal(found.after, alone.after)
    assert found.history[kept] == alone.history[-1]


def resting() -> tuple[World, Rollout]:
    """A box that falls flat by a millimetre, in steps that are short beside the contact."""
    world = world_of(box_body())
    start = state_of(((0, 0, 0.031), (1.0, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    return world, engine.rollout(world, start, times(0.1))


def test_spheres_at_the_ground_are_chosen_and_only_they_change_the_motion() -> None:
    world, rollout = resting()
    spheres = ContactSpheres.of(world, rollout)
    ((index, chosen),) = spheres.chosen
    bottom = (world.bodies[0].centers[0, :, 2] < 0).nonzero()[:, 0]
    assert index == 0 and sorted(chosen.tolist()) == bottom.tolist()
    assert spheres.count == 16
    high = replace(rollout, position_m=rollout.position_m + torch.tensor([0, 0, 0.1]))
    assert ContactSpheres.of(world, high).count == 0

    start = state_of(((0, 0, 0.031), (1.0, 0, 0, 0), (0, 0, 0), (0, 0, 0)))
    zero = spheres.apply(world, torch.zeros(1, 16, dtype=torch.float64))
    assert torch.equal(engine.rollout(zero, start, times(0.1)).position_m, rollout.position_m)
    lower = torch.zeros(1, 16, dtype=torch.float64)
    lower[0, 2::4] = -1.0  # all centres down by one width of the prior: the box comes to rest so much higher
    raised = engine.rollout(spheres.apply(world, lower), start, times(0.1)).position_m[0, -1, 0, 2]
    assert float(raised - rollout.position_m[0, -1, 0, 2]) == pytest.approx(MOVED_STD_M, rel=0.05)
    assert spheres.record(world, lower[0])["box"] == {
        "spheres": 4,
        "moved_mean_m": pytest.approx(MOVED_STD_M),
        "moved_most_m": pytest.approx(MOVED_STD_M),
    }
    shrunk = torch.zeros(1, 16, dtype=torch.float64)
    shrunk[0, 3::4] = -100.0
    radii = spheres.apply(world, shrunk).bodies[0].radii[0]
    assert float(radii.min()) == pytest.approx(0.5 * float(world.bodies[0].radii.min()))


def test_times_between_frames_are_added_evenly() -> None:
    grid = torch.tensor([[0.0, 0.3, 0.9]], dtype=torch.float64)
    expected = [[0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9]]
    torch.testing.assert_close(dense_times(grid, 3), torch.tensor(expected, dtype=torch.float64))

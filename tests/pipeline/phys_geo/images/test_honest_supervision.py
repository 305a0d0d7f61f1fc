"""`--supervise images` looks at images: tracks, the true mass and the truth beside them change nothing of the model."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.tracks import Track
from cgwm.datasets.models.model import read_model
from cgwm.pipeline.fit import ASSUMED_DENSITY_KG_M3, fit
from cgwm.pipeline.phys_geo.images.pose_tracking import PoseQuality, PoseTrack, PoseTracker
from cgwm.pipeline.phys_geo.images.video_episodes import load_video_episode
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.runtime.checkpoint import Checkpoint
from cgwm.schemas import PhysConfig, SplatConfig
from helpers.pose_search import search_briefly
from helpers.small_model import HALF, MASS
from helpers.tiny_capture import model_of, thrown, tiny_model, with_manifest, with_tracks, write_tiny_capture

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = PhysConfig(supervise="images", device="cpu", step_s=0.003, population=8, generations=2, iterations=1)
FRAMES, LEAST = 4, 3


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps of the shooting, and poses looked for in two frames: more of them would look at nothing else."""
    search_briefly(monkeypatch)


def told(tmp_path: Path, masks: bool = True, frames: int = FRAMES) -> Path:
    """Write a capture that tells everything: tracks, noise, mass and truth."""
    track = thrown()
    assert track.quat_wxyz is not None
    short = Track(track.time_s[:frames], track.position_m[:frames], track.quat_wxyz[:frames])
    root = write_tiny_capture(tmp_path / "told", short, masks)
    with_manifest(root, "[video]", "[measurement]\nposition_std_m = 0.0001\nrotation_std_rad = 0.001\n[video]")
    with_tracks(root, short)
    truth = {"friction": 0.4, "states": {"000": track.position_m[0].tolist()}}
    (root / "truth.json").write_text(json.dumps(truth))
    return root


def contents(model: Path) -> dict[str, bytes]:
    """Return what a model is made of by file, without what it was made from and how long that took."""
    file = json.loads((model / "model.json").read_text())
    del file["provenance"]
    record = json.loads((model / "fit.json").read_text())
    kept = {"model.json": file, "fit.json": _timeless(record)}
    files = [*sorted(model.glob("*.ply")), *sorted(model.glob("pose_tracks/*.csv"))]
    found = {path.relative_to(model).as_posix(): path.read_bytes() for path in files}
    return found | {name: json.dumps(value).encode() for name, value in kept.items()}


def _timeless(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {key: _timeless(part) for key, part in value.items() if not key.startswith("seconds")}


def test_poses_are_those_of_the_images_though_tracks_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """That nothing beside the images changes a byte of the model takes two whole fits: `make evidence`."""
    capture, model = Capture.open(told(tmp_path, frames=LEAST)), tiny_model()
    nothing = torch.zeros(LEAST)
    quality = PoseQuality(**{name: nothing for name in PoseQuality.__dataclass_fields__})
    seen = PoseTrack(
        position_m=torch.rand(LEAST, 1, 3).double(),
        quat_wxyz=torch.tensor([0.6, 0.8, 0, 0]).double().expand(LEAST, 1, 4), curvature=nothing, covariance=nothing,
        loss=nothing, quality=quality, found=nothing == 0, searches=1,
        rival_nats=math.inf,
    )  # fmt: skip
    began = []
    monkeypatch.setattr(PoseTracker, "run", lambda self: (began.append((self._position, self._quat)), seen)[1])
    slot = Checkpoint(tmp_path / "checkpoint", {"all": "0"}, every_s=0.0).slot("poses")
    for again in (False, True):  # found, and of the checkpoint
        episode = load_video_episode(
            world_of_model(model), model, capture, "000", {}, slot, tracks_too=False, image_size=64,
            device=torch.device("cpu"),
        )  # fmt: skip
        track = episode.tracks["cube"]
        np.testing.assert_array_equal(track.position_m, seen.position_m[:, 0])
        np.testing.assert_array_equal(track.quat_wxyz, seen.quat_wxyz[:, 0])
        assert again or slot.read(torch.device("cpu")) is not None
    ((position, quat),) = began  # from the origin, not from where the tracks are
    assert not position.any() and bool((quat == torch.tensor([1.0, 0, 0, 0])).all())


# In the suite: the test above: poses are those of the images.
@pytest.mark.evidence
@pytest.mark.parametrize("masks", [True, False])
def test_what_is_not_in_the_images_is_not_looked_at(tmp_path: Path, masks: bool) -> None:
    root = told(tmp_path, masks, LEAST)
    fit(root, tmp_path / "a", "phys-geo", model_of(root), phys_config=CONFIG)
    stripped = tmp_path / "stripped"
    shutil.copytree(root, stripped)
    shutil.rmtree(stripped / "tracks")
    (stripped / "truth.json").unlink()
    with_manifest(stripped, f"mass_kg = {MASS}\n", "")
    with_manifest(stripped, "[measurement]\nposition_std_m = 0.0001\nrotation_std_rad = 0.001\n", "")
    fit(stripped, tmp_path / "b", "phys-geo", model_of(root), phys_config=CONFIG)
    a, b = contents(tmp_path / "a"), contents(tmp_path / "b")
    spheres = {"cube.ply", "cube.collision.ply", "scene.ply"}
    assert set(a) == set(b) == {*spheres, "pose_tracks/000.csv", "model.json", "fit.json"}
    assert [name for name in a if a[name] != b[name]] == []


# In the suite: a contact law is one of times, whatever the mass: tests of physics.
@pytest.mark.evidence
def test_contact_does_not_depend_on_the_mass_of_a_body_on_the_ground(tmp_path: Path) -> None:
    """Fitted without photos, to masks and the shape, so that the mass is the manifest's or an assumed density's."""
    root = told(tmp_path)
    found = []
    for name in ("weighed", "unknown"):
        if name == "unknown":
            with_manifest(root, f"mass_kg = {MASS}\n", "")
        splats = SplatConfig(max_collision_spheres=8)
        fit(root, tmp_path / name, "phys-geo", splat_config=splats, phys_config=CONFIG)
        found.append(read_model(tmp_path / name))
    ratio = found[1].file.bodies[0].mass_kg / MASS
    assert ratio == pytest.approx(ASSUMED_DENSITY_KG_M3 * 8 * HALF**3 / MASS) and ratio != 1.0
    numbers = [{p.name: p for p in one.file.parameters} for one in found]
    for name in ("friction", "contact_time_s", "damping_ratio", "restitution"):
        values = [(one[name].estimate, *(one[name].interval_95 or ())) for one in numbers]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-6, err_msg=name)
    for name in ("stiffness_n_m", "damping_n_s_m"):  # of a contact that carries this mass
        assert numbers[1][name].estimate == pytest.approx(ratio * numbers[0][name].estimate, rel=1e-6)
    assert any(text.startswith("photometric part left out") for text in found[0].file.warnings)
    assert found[0].fit.stages["phys-geo"]["image_loss"]["photometric"] is False

"""`--collision visual`: the visual spheres themselves collide, in the model, on disk, and in the engine."""

from dataclasses import replace

import numpy as np
import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.models.model import read_model, write_model
from cgwm.pipeline.fit import fit
from cgwm.pipeline.physics.model_world import world_of_model
from cgwm.pipeline.sg_gs import bodies
from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement
from cgwm.pipeline.sg_gs.solid.visual_hull import carve
from cgwm.pipeline.sg_gs.stage import fit_scene
from cgwm.pipeline.synthesize import synthesize
from cgwm.schemas import ContactParameters, SynthesizeConfig, UsageError
from pipeline.sg_gs.test_sg_gs import CONFIG, PLACE, RADIUS, make_capture, write_manifest

BRIEF = {"iterations": 4, "max_scene_spheres": 100, "bare_ground": False, "flat_faces": False, "image_size": 64}
VISUAL = CONFIG.model_copy(update={"collision": "visual", **BRIEF})


@pytest.fixture(scope="module")
def quick():
    """Carve the hull once, as the photos are always the same, and leave it as the silhouettes have it."""
    hulls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bodies, "refine", lambda hull, *_: (hull, Refinement(0.0, 0.0, 0.0)))
        patch.setattr(bodies, "carve", lambda *given: (hulls or hulls.append(carve(*given)) or hulls)[0])
        yield


@pytest.fixture(scope="module")
def model(tmp_path_factory, quick):
    root = tmp_path_factory.mktemp("visual")
    make_capture(root / "tiny")
    fit(root / "tiny", root / "model", "sg-gs", splat_config=VISUAL)
    return read_model(root / "model")


def test_the_visual_spheres_are_the_colliding_ones(model):
    (body,) = model.file.bodies
    assert body.collision is None
    assert not (model.root / "ball.collision.ply").exists()
    assert model.collision["ball"] is model.body_splats["ball"]
    record = model.fit.stages["sg-gs"]["ball"]["collision"]
    assert record["set"] == "visual"
    assert record["spheres"] == len(model.body_splats["ball"])
    assert record["surface_distance_m"] == body.collision_distance_m
    assert 0 < body.collision_distance_m < 0.5 * RADIUS
    assert "to_visual" not in record


def test_a_distilled_set_is_compared_with_what_is_seen_and_nothing_stands_before_it_in_unknown_surroundings(
    tmp_path, quick
):
    make_capture(tmp_path / "tiny")
    (tmp_path / "tiny" / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "ball"\n')
    capture = Capture.open(tmp_path / "tiny", check=False)
    result = fit_scene(capture, VISUAL.model_copy(update={"collision": "distilled"}))
    ball, record = result.bodies["ball"], result.record["ball"]["collision"]
    assert record["set"] == "distilled"
    assert record["spheres"] == len(ball.collision) < len(ball.visual)
    for way in ("to_visual", "from_visual"):
        assert 0 < record[way]["mean_m"] < 0.1 * RADIUS
        assert record[way]["mean_m"] < record[way]["percentile_95_m"] <= record[way]["max_m"]
    away = np.linalg.norm(np.asarray(result.scene.means) - PLACE, axis=1)
    assert away.min() > 0.3  # where the cameras are
    assert any("shell far away" in warning for warning in result.warnings)


def test_a_model_whose_visual_spheres_collide_is_simulated_and_written_again(model, tmp_path):
    file = model.file.model_copy(update={"contact": ContactParameters()})
    ready = write_model(tmp_path / "ready", replace(model, file=file))
    assert ready.file.bodies[0].collision is None
    world = world_of_model(read_model(tmp_path / "ready"))
    assert world.bodies[0].radii.shape[1] == len(model.body_splats["ball"])
    config = SynthesizeConfig(rollouts=1, duration_s=0.2, width=32, height=24)
    synthesize(tmp_path / "ready", tmp_path / "dataset", config)
    assert (tmp_path / "dataset" / "dataset.json").is_file()


def test_without_photos_there_is_nothing_visual_to_collide(tmp_path):
    write_manifest(tmp_path / "tracks_only", "shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }")
    with pytest.raises(UsageError, match="--collision visual: no photos"):
        fit_scene(Capture.open(tmp_path / "tracks_only", check=False), VISUAL)

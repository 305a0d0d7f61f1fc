"""Bodies are separated from scenes without masks, by a box or by the ground and clustering."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture import Capture
from cgwm.datasets.manifest import write_manifest
from cgwm.datasets.models import read_model
from cgwm.datasets.scenes.dynamics import draw_contact, rest_pose
from cgwm.datasets.scenes.objects import make_object, resting_down
from cgwm.datasets.scenes.plan import ScenePlan
from cgwm.datasets.scenes.record import build_set, take_photos, truth
from cgwm.pipeline.fit import fit
from cgwm.pipeline.splats.separation import separate
from cgwm.pipeline.splats.views import load_views
from cgwm.schemas import Body, CaptureManifest, Ground, InputDataError, PhotoBox, SplatConfig, World

CONFIG = SplatConfig(
    iterations=200, image_size=96, max_body_spheres=100, max_scene_spheres=200, max_collision_spheres=60, device="cpu"
)
BOX = PhotoBox(min_m=(-0.1, -0.1, -0.01), max_m=(0.1, 0.1, 0.1))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A T-shaped block with a shadow on a mat, 20 photos from all around, with masks."""
    root = tmp_path_factory.mktemp("separation") / "capture"
    root.mkdir()
    solid = make_object(4)
    pose = rest_pose(solid, resting_down(solid), 0.5, 0.0, 0.0)
    plan = ScenePlan("fall", 4, solid, draw_contact(np.random.default_rng(0)), pose, 30.0, (), fingertip=False)
    scene = build_set(plan, (192, 144), (16, 16), 20)
    take_photos(scene, root)
    (root / "cameras.json").write_text(truth(scene).cameras.model_dump_json())
    return with_bodies(Capture(root, CaptureManifest(format="cgwm-capture/1")), Body(name="block"))


def with_bodies(capture, *bodies, ground=True):
    manifest = CaptureManifest(
        format="cgwm-capture/1", world=World(ground=Ground() if ground else None), bodies=tuple(bodies)
    )
    write_manifest(capture.root / "capture.toml", manifest)
    return Capture.open(capture.root, check=False)


def photos(capture):
    """The photos without masks, and the true masks."""
    views = load_views(capture, capture.photos(), CONFIG.image_size, torch.device("cpu"))
    true = {view.name: view.labels for view in views}
    return [replace(view, labels=None, cover=None) for view in views], true


def ious(views, true, label=1):
    masks = [(view.labels == label, true[view.name] == label) for view in views]
    return np.array([(a & b).sum() / (a | b).sum() for a, b in masks])


def test_the_ground_and_clustering_find_the_body(capture):
    views, true = photos(capture)
    found = separate(capture, views[1:], views[:1], Ground(), None, CONFIG)
    assert found is not None
    assert ious(found.train, true).mean() > 0.93
    assert ious(found.train, true).min() > 0.8
    assert ious(found.test, true).mean() > 0.9  # a photo that took no part in it
    entry = found.record["block"]
    assert entry["method"] == "ground"
    assert entry["clusters"] == 1
    assert entry["agreement"] > 0.93
    assert entry["share"] == pytest.approx(np.mean([(true[view.name] == 1).mean() for view in found.train]), rel=0.1)
    assert [warning for warning in found.warnings if "separation.png" in warning] == list(found.warnings)

"""Bodies are separated from scenes without masks, by a box or by the ground and clustering.

Boxes are tested here with two bodies, which takes the whole way; ground and clustering by `make evidence`.
"""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.capture.manifest import write_manifest
from cgwm.datasets.models.model import read_model
from cgwm.datasets.synthetic.dynamics import draw_contact, rest_pose
from cgwm.datasets.synthetic.objects import make_object, resting_down
from cgwm.datasets.synthetic.plan import ScenePlan
from cgwm.datasets.synthetic.record import build_set, take_photos, truth
from cgwm.pipeline.fit import fit
from cgwm.pipeline.geometry.spheres import Spheres
from cgwm.pipeline.sg_gs.photos.views import load_views, with_labels
from cgwm.pipeline.sg_gs.separation.body_separation import separate
from cgwm.pipeline.sg_gs.separation.object_search import ObjectSearch
from cgwm.pipeline.sg_gs.solid.depth_refinement import Refinement
from cgwm.schemas import Body, CaptureManifest, Ground, InputDataError, PhotoBox, Shape, SplatConfig, World
from cgwm.schemas.capture import SphereShape
from pipeline.sg_gs.test_sg_gs import PLACE, make_capture
from pydantic import ValidationError

CONFIG = SplatConfig(
    iterations=60, image_size=96, max_body_spheres=1000, max_scene_spheres=600, max_collision_spheres=20, device="cpu"
)
BESIDE = np.array([0.12, 0.03, 0.0])
BOX = PhotoBox(min_m=(-0.1, -0.1, -0.01), max_m=(0.1, 0.1, 0.1))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A T-shaped block with a shadow on a mat, 16 photos from all around, with masks."""
    root = tmp_path_factory.mktemp("separation") / "capture"
    root.mkdir()
    solid = make_object(4)
    pose = rest_pose(solid, resting_down(solid), 0.5, 0.0, 0.0)
    plan = ScenePlan(
        name="fall",
        seed=4,
        solid=solid,
        contact=draw_contact(np.random.default_rng(0)),
        photo_qpos=pose,
        frame_rate=30.0,
        episodes=(),
        fingertip=False,
    )
    scene = build_set(plan, (160, 120), (16, 16), 16)
    take_photos(scene, root)
    cameras = truth(scene).cameras.model_copy(update={"videos": {}})
    (root / "cameras.json").write_text(cameras.model_dump_json())
    return with_bodies(Capture(root, CaptureManifest(format="cgwm-capture/1"), cameras), Body(name="block"))


def with_bodies(capture, *bodies):
    """The same photos under another manifest."""
    manifest = CaptureManifest(format="cgwm-capture/1", world=World(ground=Ground()), bodies=bodies)
    return replace(capture, manifest=manifest)


def unmasked(capture):
    """The photos without masks, and the true masks by photo."""
    views = load_views(capture, capture.photos(), CONFIG.image_size, torch.device("cpu"))
    true = {view.name: view.labels for view in views}
    return [replace(view, labels=None, cover=None) for view in views], true


def ious(views, true, label=1):
    masks = [(view.labels == label, true[view.name] == label) for view in views]
    masks = [(mine, wanted) for mine, wanted in masks if wanted.any()]
    return np.array([(a & b).sum() / (a | b).sum() for a, b in masks])


@pytest.fixture(scope="module")
def found(capture):
    """By the ground and clustering, the first photo held out."""
    views, _ = unmasked(capture)
    result = separate(capture, views[1:], views[:1], Ground(), None, CONFIG)
    assert result is not None
    return result


@pytest.mark.evidence
def test_the_ground_and_clustering_find_the_body(capture, found):
    _, true = unmasked(capture)
    assert ious(found.train, true).mean() > 0.93
    assert ious(found.train, true).min() > 0.8
    assert ious(found.test, true)[0] > 0.9  # a photo that took no part in it
    entry = found.record["block"]
    assert (entry["method"], entry["clusters"]) == ("ground", 1)
    assert entry["agreement"] > 0.88
    assert entry["share"] == pytest.approx(np.mean([(true[view.name] == 1).mean() for view in found.train]), rel=0.1)
    assert len(found.warnings) == 1
    assert "separated by what is on the ground. separation.png shows" in found.warnings[0]


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """Two balls on a ground of squares, the photos without masks, and their true masks."""
    capture = make_capture(tmp_path_factory.mktemp("balls") / "capture", beside=BESIDE)
    return capture, *unmasked(capture)


def test_two_bodies_are_told_apart_by_their_boxes(balls):
    capture, views, true = balls
    boxes = [PhotoBox(min_m=tuple(c - 0.06), max_m=tuple(c + 0.06)) for c in (PLACE, PLACE + BESIDE)]
    both = with_bodies(capture, *(Body(name=f"ball-{k}", photo_box=box) for k, box in enumerate(boxes)))
    result = separate(both, views, [], Ground(), None, CONFIG)
    assert result is not None
    assert [entry["method"] for entry in result.record.values()] == ["box", "box"]
    assert ious(result.train, true, 1).mean() > 0.85
    assert ious(result.train, true, 2).mean() > 0.7  # it is half hidden, or half out of the photo, in most of 11 photos


@pytest.mark.evidence
@pytest.mark.parametrize("iterations", [100, 200, 400])  # after 60 steps nothing is solid beside the first ball
def test_a_body_is_found_beside_one_with_masks_whose_labels_stay(balls, iterations):
    capture, views, true = balls
    masked = [with_labels(view, np.where(true[view.name] == 1, 1, 0).astype(np.uint8), 2) for view in views]
    both = with_bodies(capture, Body(name="ball-0"), Body(name="ball-1"))
    result = separate(both, masked, [], Ground(), None, CONFIG.model_copy(update={"iterations": iterations}))
    assert result is not None
    assert list(result.record) == ["ball-1"]
    for before, after in zip(masked, result.train, strict=True):
        np.testing.assert_array_equal(after.labels == 1, before.labels == 1)
    assert ious(result.train, true, 2).mean() > 0.7


@pytest.mark.parametrize("steps", [1.0, 2.0, 4.0])
def test_what_is_half_as_opaque_joins_no_objects(balls, steps):
    """Two rows of spheres with a third between them, whose opacities all grow with the steps of the fit."""
    capture, views, _ = balls
    k = torch.arange(15)
    means = torch.stack((0.02 * k, torch.zeros(15), torch.full((15,), 0.05)), 1)
    opacities = 0.1 + steps * torch.where((k < 5) | (k >= 10), 0.2, 0.07)
    spheres = Spheres(means, torch.full((15,), 0.008), opacities, torch.zeros(15, 3))
    clusters = ObjectSearch(capture, views[:1], Ground(), None, CONFIG)._clusters(spheres, 15, 0.02, 0.5)
    assert [members.tolist() for members in clusters] == [[*range(5)], [*range(10, 15)]]


def test_no_body_is_separated_that_has_masks_or_a_shape(balls):
    capture, views, true = balls
    shaped = with_bodies(capture, Body(name="block", shape=Shape(sphere=SphereShape(radius_m=0.05))))
    assert separate(shaped, views, [], Ground(), None, CONFIG) is None
    in_some = [with_labels(views[0], np.minimum(true[views[0].name], 1), 1), *views[1:]]
    assert separate(with_bodies(capture, Body(name="block")), in_some, [], Ground(), None, CONFIG) is None


def test_what_cannot_be_known_is_refused(balls):
    capture, views, _ = balls
    with pytest.raises(
        InputDataError,
        match=r"neither a shape nor masks, and can be found neither by a box nor by the ground(.|\n)*photo_box",
    ):
        separate(with_bodies(capture, Body(name="block")), views, [], None, None, CONFIG)
    two = with_bodies(capture, Body(name="a"), Body(name="b"))
    with pytest.raises(
        InputDataError, match="'a', 'b' have neither masks, shapes nor boxes, so they cannot be distinguished"
    ):
        separate(two, views, [], Ground(), None, CONFIG)


@pytest.mark.parametrize("low, high", [((0.3, 0.3, 0.1), (0.4, 0.4, 0.2)), ((-0.1, -0.1, -0.2), (0.1, 0.1, -0.1))])
def test_a_box_with_nothing_in_it_is_refused(balls, low, high):
    capture, views, _ = balls
    empty = with_bodies(capture, Body(name="block", photo_box=PhotoBox(min_m=low, max_m=high)))
    with pytest.raises(InputDataError, match=r"nothing solid where body 'block' is looked for(.|\n)*correct photo_box"):
        separate(empty, views, [], Ground(), None, CONFIG.model_copy(update={"iterations": 8}))


def test_a_box_the_wrong_way_round_is_refused():
    with pytest.raises(ValidationError, match=r"min_m must be below max_m in y; found 0\.2 and 0\.1"):
        PhotoBox(min_m=(0, 0.2, 0), max_m=(1, 0.1, 1))


@pytest.mark.evidence
def test_the_fit_shows_what_it_took_for_the_body(capture, found, tmp_path, monkeypatch):
    root = shutil.copytree(capture.root, tmp_path / "capture")
    shutil.rmtree(root / "masks")
    write_manifest(root / "capture.toml", with_bodies(capture, Body(name="block")).manifest)
    monkeypatch.setattr("cgwm.pipeline.sg_gs.stage.separate", lambda *_: found)
    monkeypatch.setattr("cgwm.pipeline.sg_gs.bodies.refine", lambda hull, *_: (hull, Refinement(0.0, 0.0, 0.0)))
    config = CONFIG.model_copy(update={"iterations": 8})
    fit(root, tmp_path / "model", stage="sg-gs", splat_config=config)
    model = read_model(tmp_path / "model")
    assert model.fit.stages["sg-gs"]["separation"] == found.record
    assert found.warnings[0] in model.fit.warnings
    assert 0.01 < model.file.bodies[0].photo_pose.position_m[2] < 0.06
    sheet = cv2.imdecode(np.frombuffer(model.pictures["separation.png"], np.uint8), cv2.IMREAD_COLOR)
    assert sheet.shape == (3 * 198 + 2 * 4, 4 * 264 + 3 * 4, 3)
    first = cv2.resize((found.train[0].labels > 0).astype(np.uint8), (264, 198)) > 0
    core = cv2.erode(first.astype(np.uint8), np.ones((9, 9))) > 0
    around = cv2.dilate(first.astype(np.uint8), np.ones((9, 9))) == 0
    photo = cv2.resize(cv2.imread(str(root / "images" / found.train[0].name)), (264, 198))
    tile = sheet[:198, :264]
    assert np.abs(tile[core].mean(0) - photo[core].mean(0)).max() < 6
    assert np.abs(tile[around].mean(0) - photo[around].mean(0) / 3).max() < 6

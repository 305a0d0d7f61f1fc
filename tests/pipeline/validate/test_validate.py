"""Validation: nothing to complain about in what was just made, and each fault that is put in is found."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import write_model
from cgwm.datasets.rollouts.dataset import shard_name
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.validate import validate
from cgwm.pipeline.validate.newton import _bent
from cgwm.schemas import EffectModel, InputDataError, SynthesizeConfig, UsageError
from helpers.small_model import small_model, write_small_model
from scipy.spatial.transform import Rotation

CONFIG = SynthesizeConfig(rollouts=2, duration_s=0.4, width=80, height=60, device="cpu", seed=2)
SHARD = shard_name(0, 1)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    synthesize(write_small_model(folder / "model", com_m=(0.004, -0.003, 0.002)), folder / "dataset", CONFIG)
    return folder / "dataset"


@pytest.fixture
def broken(good: Path, tmp_path: Path) -> Path:
    return shutil.copytree(good, tmp_path / "dataset")


@pytest.fixture(scope="module")
def single(good: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one rollout, in which a fault is looked for in half of the time."""
    out = tmp_path_factory.mktemp("single") / "dataset"
    synthesize(good / "model", out, CONFIG.model_copy(update={"rollouts": 1, "seed": 7}))
    assert not validate(out).faults
    return out


def change(dataset: Path, edit: Callable[[h5py.Group], None], demo: int = 1) -> tuple[str, ...]:
    """Edit a demo, write the new hash into the manifest (a fault of content, not of transport), and validate."""
    path = dataset / SHARD
    with h5py.File(path, "r+") as file:
        edit(file["data"][f"demo_{demo}"])
    manifest = json.loads((dataset / "dataset.json").read_text())
    manifest["shards"][0]["sha256"] = sha256(path)
    (dataset / "dataset.json").write_text(json.dumps(manifest))
    return validate(dataset).faults


def turned(quat: np.ndarray, angle_deg: float) -> np.ndarray:
    turn = Rotation.from_rotvec([0, 0, angle_deg], degrees=True)
    return (Rotation.from_quat(quat, scalar_first=True) * turn).as_quat(scalar_first=True)


def test_a_fresh_dataset_is_clean(good: Path) -> None:
    report = validate(good)
    assert report.faults == () and report.passed and report.kind == "dataset"
    assert report.facts["rollouts"] == 2 and report.facts["camera_frames"] == 2 * 2 * 13
    assert report.facts["contacts"] > 0
    assert report.facts["impulse_excess_n_s"] < 1e-12
    assert report.facts["angular_excess_share_median"] < 0.05
    assert report.facts["mask_iou_median"] > 0.85 and report.facts["mask_iou_min"] > 0.75
    assert report.facts["depth_error_m_median"] < 0.005 and report.failures == ()
    assert report.facts["mask_centre_error_px_median"] < 1
    assert report.facts["units"]["contacts/impulse_world"] == "N s"


def test_hashes_and_missing_files(broken: Path) -> None:
    data = bytearray((broken / SHARD).read_bytes())
    data[len(data) // 2] ^= 1
    (broken / SHARD).write_bytes(data)
    (broken / "model/fit.json").write_text("{}")
    (broken / "stray.h5").write_bytes(b"")
    faults = validate(broken).faults
    assert faults[0].startswith(f"{SHARD}: its sha256 differs from dataset.json")
    assert "stray.h5: not listed in dataset.json." in faults
    assert "model/: its sha256 differs from dataset.json." in faults
    (broken / SHARD).unlink()
    assert f"{SHARD}: listed in dataset.json, but no such file." in validate(broken).faults


def test_a_shard_that_is_not_there_yet(good: Path, tmp_path: Path) -> None:
    part = CONFIG.model_copy(update={"shards": 2, "shard": 1, "duration_s": 0.1})
    synthesize(good / "model", tmp_path / "part", part)
    assert validate(tmp_path / "part").faults == ("rollouts-0000-of-0002.h5: this shard is missing.",)


def test_a_truncated_shard(broken: Path) -> None:
    data = (broken / SHARD).read_bytes()
    (broken / SHARD).write_bytes(data[: len(data) // 2])
    assert any("not a readable HDF5 file" in fault for fault in validate(broken).faults)


def nan_position(demo: h5py.Group) -> None:
    demo["bodies/pos"][3, 0, 1] = np.nan


def long_quaternion(demo: h5py.Group) -> None:
    demo["bodies/quat_wxyz"][5, 0] *= 1.01


def backward_time(demo: h5py.Group) -> None:
    demo["time"][4] = demo["time"][2]


def other_impulses(demo: h5py.Group) -> None:
    impulse = demo["contacts/impulse_world"]
    impulse[...] = 1.001 * impulse[()]


def other_mass(demo: h5py.Group) -> None:
    demo["bodies/mass"][0] *= 1.01


def pulling_contact(demo: h5py.Group) -> None:
    impulse = demo["contacts/impulse_world"]
    impulse[...] = -impulse[()]


def far_contact(demo: h5py.Group) -> None:
    demo["contacts/distance"][4] += 0.5


def buried_contact(demo: h5py.Group) -> None:
    demo["contacts/distance"][4] -= 0.5


def lost_contacts(demo: h5py.Group) -> None:
    demo["contacts/offsets"][-1] -= 1


def wild_body(demo: h5py.Group) -> None:
    demo["contacts/body_b"][0] = 7


def crooked_normal(demo: h5py.Group) -> None:
    demo["contacts/normal_world"][0] *= 1.1


def shifted_camera(demo: h5py.Group) -> None:
    demo["cameras/view0/T_world_cam"][0, 3] += 0.1


def opengl_camera(demo: h5py.Group) -> None:
    demo["cameras/view1/T_world_cam"][:3, 1:3] *= -1


def moved_mask(demo: h5py.Group) -> None:
    mask = demo["obs/view0_mask"]
    mask[...] = np.roll(mask[()], 12, axis=2)


def unknown_label(demo: h5py.Group) -> None:
    demo["obs/view0_mask"][0, :4, :4] = 9


def depth_in_millimetres(demo: h5py.Group) -> None:
    depth = demo["obs/view1_depth"]
    depth[...] = 1000 * depth[()]


def flipped_quaternion(demo: h5py.Group) -> None:
    demo["bodies/quat_wxyz"][6, 0, 1:] *= -1  # the inverse rotation


def turned_pose(demo: h5py.Group) -> None:
    demo["bodies/quat_wxyz"][3, 0] = turned(demo["bodies/quat_wxyz"][3, 0], 20)


def shifted_pose(demo: h5py.Group) -> None:
    demo["bodies/pos"][7, 0, 0] += 0.06


def lost_body(demo: h5py.Group) -> None:
    demo["obs/view1_mask"][5] = 0


def masks_of_the_other_camera(demo: h5py.Group) -> None:
    one, two = (demo[f"obs/view{k}_mask"] for k in (0, 1))
    one[...], two[...] = two[()], one[()]


def nearer_depth(demo: h5py.Group) -> None:
    depth = demo["obs/view0_depth"][4]
    demo["obs/view0_depth"][4] = np.where(demo["obs/view0_mask"][4] == 1, depth - 0.08, depth)


def places_in_the_body_frame(demo: h5py.Group) -> None:
    place = demo["contacts/pos_world"]
    place[...] = place[()] + [0.0, 0.06, 0.0]


def faster_spin(demo: h5py.Group) -> None:
    demo["bodies/omega_body"][2, 0] *= 1.05


def other_inertia(demo: h5py.Group) -> None:
    demo["bodies/inertia"][0, :1] *= 1.3


def miscounted_pixels(demo: h5py.Group) -> None:
    demo["bodies/visible_px"][2, 1, 0] += 3


def other_object(demo: h5py.Group) -> None:
    demo["obs/object"][1, 0] += 1e-3


def wild_parameter(demo: h5py.Group) -> None:
    demo["parameters/friction"][()] = 2.5


def wrong_force(demo: h5py.Group) -> None:
    demo["bodies/contact_force"][7, 0, 2] += 0.1


def wrong_row_force(demo: h5py.Group) -> None:
    force = demo["contacts/force_world"]
    force[...] = -force[()]


def wrong_torque(demo: h5py.Group) -> None:
    demo["bodies/contact_torque"][5, 0, 1] += 1e-3


def wrong_fraction(demo: h5py.Group) -> None:
    demo["bodies/visible_fraction"][4, 0, 0] = 0.25


def other_bit(demo: h5py.Group) -> None:
    amodal = demo["obs/view1_amodal"]
    amodal[3] = amodal[3] << 1  # of a body that there is not


def no_unit(demo: h5py.Group) -> None:
    del demo["bodies/vel"].attrs["unit"]


def no_velocity(demo: h5py.Group) -> None:
    del demo["bodies/vel"]


def short_action(demo: h5py.Group) -> None:
    attributes, values = dict(demo["actions"].attrs), demo["actions"][()]
    del demo["actions"]
    demo.create_dataset("actions", data=values[:-1]).attrs.update(attributes)


def wrong_count(demo: h5py.Group) -> None:
    demo.parent.attrs["total"] = 5


def lost_parameter(demo: h5py.Group) -> None:
    del demo["parameters/friction"]


def other_settings(demo: h5py.Group) -> None:
    demo.file.attrs["config_json"] = "{}"


FAULTS = [
    (nan_position, "bodies/pos: frame 3: contains numbers that are not finite"),
    (long_quaternion, "bodies/quat_wxyz: frame 5: a norm differs from 1 by 0.01"),
    (backward_time, "time: not increasing at frame 4"),
    (other_impulses, "contacts/impulse_world: body 'cube', frame"),
    (other_mass, "contacts/impulse_world: body 'cube', frame"),
    (pulling_contact, "a contact pulls by"),
    (far_contact, "m; where the bodies are, spheres of 'cube' miss that by 0."),
    (buried_contact, "m; where the bodies are, spheres of 'cube' miss that by 0."),
    (lost_contacts, "contacts/offsets: they do not divide"),
    (wild_body, "contacts/body_b: frame 5: 7 is not among what is documented, -1024 to B - 1, here at most 0"),
    (crooked_normal, "contacts/normal_world: frame 5: a norm differs from 1 by 0.1"),
    (shifted_camera, "of its mask lies outside the projected body; the pose or the camera is wrong"),
    (opengl_camera, "of its mask lies outside the projected body; the pose or the camera is wrong"),
    (moved_mask, "of its mask lies outside the projected body; the pose or the camera is wrong"),
    (unknown_label, "obs/view0_mask: frame 0: 9 is not among what is documented, 0 to B, here at most 1"),
    (depth_in_millimetres, "its depth differs from that of its pose by"),
    (flipped_quaternion, "body 'cube', frame "),
    (turned_pose, "bodies/omega_body: body 'cube', frame "),
    (shifted_pose, "obs/view0, frame 7, body 'cube': "),
    (
        lost_body,
        "obs/view1, frame 5, body 'cube': mask and projected body overlap by 0.00 (IoU); at least 0.7 is required",
    ),
    (masks_of_the_other_camera, "obs/view0, frame "),
    (nearer_depth, "obs/view0, frame 4, body 'cube': its depth differs from that of its pose by 0.0"),
    (places_in_the_body_frame, "contacts/pos_world: body 'cube': in half of the"),
    (faster_spin, "bodies/omega_body: body 'cube', frame "),
    (other_inertia, "bodies/omega_body: body 'cube', frame "),
    (miscounted_pixels, "bodies/visible_px: frame 2, camera view1, body 'cube'"),
    (other_object, "obs/object: frame 1: differs from the bodies' poses and velocities"),
    (wild_parameter, "parameters/friction: 2.5 1; 0.01 to 2 is allowed"),
    (wrong_force, "bodies/contact_force: frame 7: differs from the impulses over the time between frames by 0.1 N"),
    (wrong_row_force, "contacts/force_world: frame "),
    (
        wrong_torque,
        "bodies/contact_torque: frame 5: differs from the change of angular momentum over that time by 0.001 N",
    ),
    (wrong_fraction, "bodies/visible_fraction: frame 4, camera view0, body 'cube': 0.25; the masks have 1."),
    (other_bit, "bodies/amodal_px: frame 3, camera view1, body 'cube': "),
    (no_unit, "bodies/vel: has no attribute unit"),
    (no_velocity, "bodies/vel: this array is missing"),
    (short_action, "actions: its shape is (12, 1); (T, A) is documented, here (13, 1)"),
    (wrong_count, "data/@total is 5; the demos sum up to 13"),
    (lost_parameter, "parameters/friction: this array is missing"),
    (other_settings, "its attribute config_json differs from the settings in dataset.json"),
]
"""Edits of a dataset, each with a part of what `validate` says of it."""
LATE = (
    other_mass,
    buried_contact,
    opengl_camera,
    moved_mask,
    flipped_quaternion,
    shifted_pose,
    places_in_the_body_frame,
    other_inertia,
    wrong_row_force,
    other_bit,
    no_velocity,
    short_action,
    nearer_depth,
    masks_of_the_other_camera,
)
"""Faults whose like is among the others; `make evidence` has them."""


@pytest.mark.parametrize(
    ("edit", "message"),
    [pytest.param(*one, id=one[0].__name__, marks=pytest.mark.evidence if one[0] in LATE else ()) for one in FAULTS],
)
def test_each_fault_is_found(single: Path, tmp_path: Path, edit: Callable[[h5py.Group], None], message: str) -> None:
    faults = change(shutil.copytree(single, tmp_path / "dataset"), edit, demo=0)
    assert any(message in fault for fault in faults), faults
    if not message.startswith(("data/", "mask", "@", "its attribute")):  # those are of the whole file
        assert all(fault.startswith((f"{SHARD}, demo_0: ", "and ")) for fault in faults), faults


def test_models(good: Path, tmp_path: Path) -> None:
    model = shutil.copytree(good / "model", tmp_path / "model")
    assert validate(model).faults == ()
    text = json.loads((model / "model.json").read_text())
    path = model / "model.json"
    for changes, message in (
        (
            {"inertia_kg_m2": [1e-4, 1e-4, 9e-4, 0, 0, 0]},
            r"line \d+: \[\[bodies\]\] 'cube' inertia_kg_m2: no body has this",
        ),
        ({"collision": None, "splats": None}, "body 'cube' has no collision spheres"),
    ):
        path.write_text(json.dumps(text | {"bodies": [text["bodies"][0] | changes, *text["bodies"][1:]]}, indent=1))
        with pytest.raises(InputDataError, match=message):
            validate(model)


def test_what_is_none_of_the_three(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"no capture, model, dataset, ladder, run or masks"):
        validate(tmp_path)
    with pytest.raises(InputDataError, match=r"no such directory"):
        validate(tmp_path / "absent")


def test_a_manifest_with_a_misspelt_field(broken: Path) -> None:
    text = (broken / "dataset.json").read_text().replace('"shard_count"', '"shard_cont"')
    (broken / "dataset.json").write_text(text)
    with pytest.raises(InputDataError, match=r"unknown field 'shard_cont'[\s\S]*Did you mean 'shard_count'"):
        validate(broken)


def test_failures_are_in_numbers(broken: Path) -> None:
    change(broken, shifted_pose)
    failures = validate(broken).failures
    seen = [failure for failure in failures if failure.check == "reprojection"]
    assert {(failure.demo, failure.frame, failure.body) for failure in seen} == {("demo_1", 7, "cube")}
    assert {failure.camera for failure in seen} == {"view0", "view1"}
    assert all(failure.value is not None and failure.limit is not None for failure in seen)
    assert all(failure.text.startswith(f"{SHARD}, demo_1: ") for failure in failures)


def test_a_sample_looks_at_some(broken: Path) -> None:
    assert change(broken, shifted_pose, demo=0)
    reports = [validate(broken, sample=1, seed=seed) for seed in range(4)]
    assert {report.facts["rollouts"] for report in reports} == {1}
    found = [{failure.demo for failure in report.failures} for report in reports]
    assert {"demo_0"} in found and set() in found  # it depends on the seed which one is looked at
    again = validate(broken, sample=1, seed=0)
    assert again == reports[0] and again.facts["sampled"] == "1 of 2 rollouts, seed 0"
    assert validate(broken, sample=99).facts["rollouts"] == 2
    with pytest.raises(UsageError, match="--sample 0: not a valid number of rollouts"):
        validate(broken, sample=0)
    with pytest.raises(UsageError, match="is a model, which is checked whole"):
        validate(broken / "model", sample=1)


def test_a_sample_reads_the_hashes_of_its_shards_only(good: Path, tmp_path: Path) -> None:
    short = CONFIG.model_copy(update={"shards": 2, "duration_s": 0.1})
    for shard in (0, 1):
        synthesize(good / "model", tmp_path / "out", short.model_copy(update={"shard": shard}))
    second = tmp_path / "out" / shard_name(1, 2)
    data = bytearray(second.read_bytes())
    data[-1] ^= 1  # of equal size
    second.write_bytes(data)
    looked_at = [bool(validate(tmp_path / "out", sample=1, seed=seed).faults) for seed in range(4)]
    assert True in looked_at and False in looked_at
    assert validate(tmp_path / "out").faults


def test_loads_in_a_bounce_may_be_larger_than_at_the_frames_around_it() -> None:
    pull = np.zeros((8, 3))
    pull[1] = [0.0, 3.0, 4.0]
    bound = _bent(pull, np.array([False, False, False, True, True, False, False]))
    np.testing.assert_allclose(bound, [5.0, 5.0, 0.0, 10.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "effect",
    [
        *(
            pytest.param(name, marks=pytest.mark.evidence)
            for name in ("linear_drag", "gravity_scale", "constant_force")
        ),
        "spin_damping",
        "com_offset",
    ],
)
def test_newton_holds_with_effects(effect: str, tmp_path: Path) -> None:
    """What effects give is part of the balance; a drag that is not the labelled one is found."""
    values = {
        "linear_drag": {"c": 0.8},
        "spin_damping": {"d": 2.0},
        "com_offset": {"d_x": 0.01, "d_y": 0.0, "d_z": -0.005},
        "gravity_scale": {"s": 0.2},
        "constant_force": {"f_x": 1.0, "f_y": 0.0, "f_z": 0.5},
    }[effect]
    model = small_model(visible=False)
    active = (EffectModel(name=effect, parameters=values),)
    write_model(tmp_path / "model", replace(model, file=model.file.model_copy(update={"effects": active})))
    synthesize(tmp_path / "model", tmp_path / "dataset", CONFIG.model_copy(update={"rollouts": 1}))
    report = validate(tmp_path / "dataset")
    assert report.faults == () and report.facts["contacts"] > 0

    def stronger(demo: h5py.Group) -> None:
        listed = json.loads(str(demo.attrs["effects_json"]))
        first = next(iter(listed[effect]))
        listed[effect][first] *= 1.5
        demo.attrs["effects_json"] = json.dumps(listed)

    def heavier(demo: h5py.Group) -> None:
        demo["bodies/gravity"][2] *= 1.1

    def elsewhere(demo: h5py.Group) -> None:
        demo["bodies/com"][0, 0] += 0.005

    edit = {"com_offset": elsewhere, "gravity_scale": heavier}.get(effect, stronger)
    faults = change(tmp_path / "dataset", edit, demo=0)
    assert any("body 'cube', frame " in fault for fault in faults), faults


def test_amodal_masks_are_compared_with_the_poses(broken: Path) -> None:
    assert validate(broken).facts["amodal_iou_median"] > 0.8

    def roll(demo: h5py.Group) -> None:
        made = demo["obs/view1_amodal"]
        made[...] = np.roll(made[()], 20, 2)

    faults = change(broken, roll)
    assert any("obs/view1, frame 0, body 'cube': amodal mask and pose overlap by 0." in fault for fault in faults)


@pytest.mark.parametrize("array", ["bodies/pos", "obs/view0_depth"])
def test_a_damaged_block_is_named(broken: Path, array: str) -> None:
    path = broken / SHARD
    with h5py.File(path) as file:
        block = file[f"data/demo_1/{array}"].id.get_chunk_info(0)
    data = bytearray(path.read_bytes())
    data[block.byte_offset + 4 : block.byte_offset + 20] = bytes(16)
    path.write_bytes(data)
    faults = change(broken, lambda demo: None, demo=0)  # with the hash of what is there now
    assert any(fault.startswith(f"{SHARD}, demo_1: a block cannot be read: ") for fault in faults), faults
    assert not any("demo_0" in fault for fault in faults)

"""Validation: nothing to complain about in what was just made, and each fault that is put in is found."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.atomic import sha256
from cgwm.datasets.dataset import shard_name
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.validate import validate
from cgwm.schemas import InputDataError, SynthesizeConfig
from small_model import write_small_model

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


def change(dataset: Path, edit: Callable[[h5py.Group], None], demo: int = 1) -> tuple[str, ...]:
    """Edit a demo, write the new hash into the manifest (a fault of content, not of transport), and validate."""
    path = dataset / SHARD
    with h5py.File(path, "r+") as file:
        edit(file["data"][f"demo_{demo}"])
    manifest = json.loads((dataset / "dataset.json").read_text())
    manifest["shards"][0]["sha256"] = sha256(path)
    (dataset / "dataset.json").write_text(json.dumps(manifest))
    return validate(dataset).faults


def test_a_fresh_dataset_is_clean(good: Path) -> None:
    report = validate(good)
    assert report.faults == () and report.passed and report.kind == "dataset"
    assert report.facts["rollouts"] == 2 and report.facts["camera_frames"] == 2 * 2 * 13
    assert report.facts["contacts"] > 0
    assert report.facts["impulse_excess_n_s"] < 1e-12
    assert report.facts["mask_iou_median"] > 0.8
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


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (nan_position, "bodies/pos: holds numbers that are not finite"),
        (long_quaternion, "bodies/quat_wxyz: a norm is off 1 by 0.01"),
        (backward_time, "time: not increasing at frame 4"),
        (other_impulses, "contacts/impulse_world: body 'cube', frame"),
        (other_mass, "contacts/impulse_world: body 'cube', frame"),
        (pulling_contact, "a contact pulls by"),
        (lost_contacts, "contacts/offsets: they do not divide"),
        (wild_body, "contacts: body indices outside 0 to 0"),
        (crooked_normal, "contacts/normal_world: not all of unit length"),
        (shifted_camera, "of its mask lies outside the projected body; pose or camera is wrong"),
        (opengl_camera, "of its mask lies outside the projected body; pose or camera is wrong"),
        (moved_mask, "of its mask lies outside the projected body; pose or camera is wrong"),
        (unknown_label, "obs/view0_mask, frame 0: label 9; there are 1 bodies"),
        (depth_in_millimetres, "the depth of 100 % of its mask lies outside the body"),
        (no_unit, "bodies/vel: has no attribute unit"),
        (no_velocity, "an array or attribute is missing"),
        (short_action, "actions: 12 frames; num_samples says 13"),
        (wrong_count, "data/@total is 5; the demos sum up to 26"),
        (lost_parameter, "params_json names 'friction', which is not in parameters/"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_each_fault_is_found(broken: Path, edit: Callable[[h5py.Group], None], message: str) -> None:
    faults = change(broken, edit)
    assert any(message in fault for fault in faults), faults
    if edit is not wrong_count:
        assert all(fault.startswith(f"{SHARD}, demo_1: ") for fault in faults), faults


def test_models(good: Path, tmp_path: Path) -> None:
    model = shutil.copytree(good / "model", tmp_path / "model")
    assert validate(model).faults == ()
    text = json.loads((model / "model.json").read_text())
    text["bodies"][0]["inertia_kg_m2"] = [1e-4, 1e-4, 9e-4, 0, 0, 0]
    text["parameters"][0]["estimate"] = 7.0
    (model / "model.json").write_text(json.dumps(text))
    faults = validate(model).faults
    assert any("body 'cube': no body has the principal moments 0.0001, 0.0001, 0.0009 kg m2" in f for f in faults)
    assert any("parameter 'friction' is 7 1, outside its bounds 0.01 to 2" in f for f in faults)
    text["bodies"][0]["collision"] = text["bodies"][0]["splats"] = None
    (model / "model.json").write_text(json.dumps(text))
    assert any("body 'cube' has no colliding spheres" in fault for fault in validate(model).faults)


def test_what_is_none_of_the_three(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match=r"neither a capture, nor a model, nor a dataset"):
        validate(tmp_path)
    with pytest.raises(InputDataError, match=r"no such directory"):
        validate(tmp_path / "absent")


def test_a_manifest_with_a_misspelt_field(broken: Path) -> None:
    text = (broken / "dataset.json").read_text().replace('"shard_count"', '"shard_cont"')
    (broken / "dataset.json").write_text(text)
    with pytest.raises(InputDataError, match=r"unknown field 'shard_cont'[\s\S]*Did you mean 'shard_count'"):
        validate(broken)

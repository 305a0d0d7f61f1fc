"""The documentation of a rollout's arrays is one table, and every deviation of a file from it is found."""

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.models.model import read_model
from cgwm.datasets.rollouts.array_entry import ArrayEntry
from cgwm.datasets.rollouts.array_table import ARRAYS, JPEG, table_rows
from cgwm.datasets.rollouts.dataset import read_manifest, shard_name
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.validate.mjcf_text import mjcf_fault
from cgwm.pipeline.validate.rollout import Dataset
from cgwm.pipeline.validate.structure import check_file, check_structure, listing_fault
from cgwm.schemas import SynthesizeConfig
from helpers.small_model import write_small_model

CONFIG = SynthesizeConfig(rollouts=2, duration_s=0.4, width=80, height=60, device="cpu", seed=2)
DOCS = Path(__file__).resolve().parents[3] / "docs" / "datasets.md"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, bytes]:
    """A dataset of two rollouts, and its shard."""
    folder = tmp_path_factory.mktemp("made")
    synthesize(write_small_model(folder / "model", com_m=(0.004, -0.003, 0.002)), folder / "dataset", CONFIG)
    dataset = Dataset(manifest=read_manifest(folder / "dataset"), model=read_model(folder / "model"))
    return dataset, (folder / "dataset" / shard_name(0, 1)).read_bytes()


def faults(made: tuple[Dataset, bytes], edit: Callable[[h5py.Group], None] = lambda demo: None) -> list[str]:
    """Edit demo_1 of a copy of the shard in memory, and check the file and its rollouts."""
    dataset, data = made
    with h5py.File(io.BytesIO(data), "r+") as file:
        edit(file["data/demo_1"])
        listing = listing_fault(file)
        if listing is not None:
            return [listing]
        found = check_file(file)
        for name, demo in file["data"].items():
            found += [f"{name}: {fault.text}" for fault in check_structure(demo, name, dataset)[1]]
        return found


def test_the_documentation_is_the_table() -> None:
    rows = table_rows()
    written = DOCS.read_text().split("<!-- arrays -->\n\n")[1].split("\n\n")[0].splitlines()
    assert written == rows, "docs/datasets.md lacks what datasets/rollouts/array_table.py says:\n" + "\n".join(rows)


def test_a_rollout_has_what_is_documented_and_nothing_else(made: tuple[Dataset, bytes]) -> None:
    seen = set()
    with h5py.File(io.BytesIO(made[1])) as file:
        file["data/demo_1"].visititems(lambda name, item: seen.add(name) if isinstance(item, h5py.Dataset) else None)
    listed = {
        place for entry in ARRAYS.values() if entry.presence not in ("optional", "joints") for place in places(entry)
    }
    assert {name for name in seen if not name.startswith("next_obs/")} == listed
    assert JPEG.name in ARRAYS and faults(made) == []


def places(entry: ArrayEntry) -> Iterator[str]:
    """Yield the arrays of the dataset that an entry documents."""
    if "{camera}" in entry.name:
        yield from (entry.name.format(camera=f"view{number}") for number in range(2))
    elif "{parameter}" in entry.name:
        yield from (entry.name.format(parameter=name) for name in ("friction", "damping_ratio", "cube.mass_kg"))
    else:
        yield entry.name


def without(demo: h5py.Group, name: str) -> None:
    del demo[name]


def of_other_kind(demo: h5py.Group, name: str) -> None:
    values = demo[name][()]
    replace_array(demo, name, np.zeros(values.shape, "i2"))


def of_other_rank(demo: h5py.Group, name: str) -> None:
    replace_array(demo, name, np.asarray(demo[name][()])[None])


def of_other_unit(demo: h5py.Group, name: str) -> None:
    demo[name].attrs["unit"] = "furlong"


def undescribed(demo: h5py.Group, name: str) -> None:
    del demo[name].attrs["description"]


def empty_on_disk(demo: h5py.Group, name: str) -> None:
    attributes, shape, dtype = dict(demo[name].attrs), demo[name].shape, demo[name].dtype
    del demo[name]
    demo.create_dataset(name, shape, dtype).attrs.update(attributes)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without, "{name}: this array is missing"),
        (of_other_kind, "{name}: its type is int16; "),
        (of_other_rank, "{name}: its shape is "),
        (of_other_unit, "{name}: its unit is 'furlong'; "),
        (undescribed, "{name}: has no attribute description"),
        (empty_on_disk, "{name}: not all of its numbers are in the file"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_each_array_is_compared_with_its_entry(
    made: tuple[Dataset, bytes], damage: Callable[[h5py.Group, str], None], message: str
) -> None:
    names = [next(places(entry)) for entry in ARRAYS.values() if entry.presence not in ("optional", "joints")]
    if damage is empty_on_disk:  # without those that others depend on, and one that is empty
        first = {"bodies/names", "bodies/motions", *(f"cameras/view0/{key}" for key in ("width", "height", "dist"))}
        names = [name for name in names if name not in first]

    def edit(demo: h5py.Group) -> None:
        for name in names:
            damage(demo, name)

    found = faults(made, edit)
    assert [name for name in names if not any(message.format(name=name) in fault for fault in found)] == [], found


def including(demo: h5py.Group) -> None:
    demo.attrs["model_file"] = "<mujoco><include file='/etc/passwd'/></mujoco>"


def other_state(demo: h5py.Group) -> None:
    demo["states"][2, 9] += 1e-3


def pixels_shifted_in_next_obs(demo: h5py.Group) -> None:
    del demo["next_obs/view0_mask"]
    demo["next_obs/view0_mask"] = demo["obs/view0_mask"][()]


def other_rate(demo: h5py.Group) -> None:
    demo["time"][...] = 2 * demo["time"][()]
    demo["states"][:, 0] = demo["time"][()]


def early_end(demo: h5py.Group) -> None:
    demo["dones"][3] = 1


def command_without_driven(demo: h5py.Group) -> None:
    demo["actions"][...] = 0.5


def rewarded(demo: h5py.Group) -> None:
    demo["rewards"][1] = 1


def other_mode(demo: h5py.Group) -> None:
    demo["contacts/mode"][0] = 7


def millimetres(demo: h5py.Group) -> None:
    demo["bodies/pos"].attrs["unit"] = "mm"


def of_the_body(demo: h5py.Group) -> None:
    demo["bodies/vel"].attrs["frame"] = "body"


def scalar_last(demo: h5py.Group) -> None:
    demo["bodies/quat_wxyz"].attrs["order"] = "x y z w"


def replace_array(demo: h5py.Group, name: str, values: np.ndarray) -> None:
    attributes = dict(demo[name].attrs)
    del demo[name]
    demo.create_dataset(name, data=values).attrs.update(attributes)


def single_precision(demo: h5py.Group) -> None:
    replace_array(demo, "bodies/mass", demo["bodies/mass"][()].astype(np.float32))


def other_json(demo: h5py.Group) -> None:
    listed = json.loads(str(demo.attrs["params_json"]))
    listed["friction"]["value"] += 0.01
    demo.attrs["params_json"] = json.dumps(listed)


def name_that_steers(demo: h5py.Group) -> None:
    demo["bodies/names"][0] = b"cu\x1b["


def driven_cube(demo: h5py.Group) -> None:
    replace_array(demo, "bodies/motions", np.array([b"driven"]))
    replace_array(demo, "states", demo["time"][()][:, None])
    replace_array(demo, "actions", np.zeros((13, 3)))


def other_index(demo: h5py.Group) -> None:
    demo.attrs["episode_index"] = 0


def no_frames(demo: h5py.Group) -> None:
    demo.attrs["num_samples"] = 0


def parameter_without_unit(demo: h5py.Group) -> None:
    demo.attrs["params_json"] = '{"friction": {"value": 0.4}}'


def json_twice(demo: h5py.Group) -> None:
    demo.attrs["params_json"] = '{"a": 1, "a": 2}'


def zero_focal_length(demo: h5py.Group) -> None:
    demo["cameras/view0/K"][0, 0] = 0


def singular_pose(demo: h5py.Group) -> None:
    demo["cameras/view1/T_world_cam"][:3, 0] = 0


def nan_camera(demo: h5py.Group) -> None:
    demo["cameras/view0/K"][1, 1] = np.nan


def far_principal_point(demo: h5py.Group) -> None:
    demo["cameras/view0/K"][0, 2] = 4000


def linked(demo: h5py.Group) -> None:
    demo.move("bodies/vel", "bodies/moved")
    demo["bodies/vel"] = h5py.SoftLink("moved")


def no_moments(demo: h5py.Group) -> None:
    demo["bodies/inertia"][...] = 0


def split(demo: h5py.Group, name: str, *members: str) -> None:
    group = demo.file["mask"]
    if name in group:
        del group[name]
    group[name] = np.array([member.encode() for member in members])


def unknown_in_split(demo: h5py.Group) -> None:
    split(demo, "train", "demo_0", "demo_\x1b[7")


def twice_in_split(demo: h5py.Group) -> None:
    split(demo, "train", "demo_0", "demo_0")


def in_both_splits(demo: h5py.Group) -> None:
    split(demo, "valid", "demo_1")


def split_above(demo: h5py.Group) -> None:
    split(demo, "..", "demo_1")


def no_environment(demo: h5py.Group) -> None:
    demo.parent.attrs["env_args"] = "{}"


def other_convention(demo: h5py.Group) -> None:
    demo.file.attrs["convention"] = "z down"


def stray_demo(demo: h5py.Group) -> None:
    demo.parent.create_group("demo_x")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (including, "the attribute model_file includes a file."),
        (other_state, "states: frame 2: differs from the times and the free bodies' poses and velocities"),
        (
            pixels_shifted_in_next_obs,
            "next_obs/view0_mask: is not obs/view0_mask one frame later",
        ),
        (other_rate, "time: frame 12: 0.8 s; 0.4 s at the 30 frames/s of dataset.json"),
        (early_end, "dones: frame 3: is not 1 at the last frame alone"),
        (command_without_driven, "actions: frame 0: is not 0, although no body is driven"),
        (rewarded, "rewards: frame 1: 1 is not among what is documented, 0"),
        (other_mode, "contacts/mode: frame 4: 7 is not among what is documented, 0 to 1"),
        (millimetres, "bodies/pos: its unit is 'mm'; 'm' is documented"),
        (of_the_body, "bodies/vel: its frame is 'body'; 'world' is documented"),
        (scalar_last, "bodies/quat_wxyz: its order is 'x y z w'; 'w x y z' is documented"),
        (single_precision, "bodies/mass: its type is float32; f8 is documented"),
        (other_json, "parameters/friction: 0.4"),
        (name_that_steers, r"bodies/names: cu\x1b[; dataset.json has cube"),
        (driven_cube, "bodies/motions: 'cube' is driven; in the dataset's model it is free"),
        (other_index, "episode_index is 0, in a group of another number"),
        (no_frames, "num_samples is 0; the settings in dataset.json give 13"),
        (parameter_without_unit, "params_json: 'friction' is no finite value with a unit"),
        (json_twice, "the attribute params_json is no JSON object"),
        (zero_focal_length, "cameras/view0: the focal lengths in K are 0 and "),
        (singular_pose, "cameras/view1: the pose is no rotation and translation: R R^T differs from 1 by 0."),
        (nan_camera, "cameras/view0/K: contains numbers that are not finite"),
        (far_principal_point, "cameras/view0: the principal point in K, "),
        (linked, "bodies/vel: is a link; a shard contains its arrays itself"),
        (no_moments, "bodies/inertia: 'cube' has a principal moment of"),
        (unknown_in_split, r"mask/train names 'demo_\x1b[7', which is no rollout of this file"),
        (twice_in_split, "mask/train names 'demo_0' twice"),
        (in_both_splits, "mask: 'demo_1' is in train and in valid"),
        (split_above, "mask: the name '..' is no name of a file"),
        (no_environment, "data/@env_args is no JSON object with env_name, type and env_kwargs"),
        (other_convention, "@convention is 'z down'"),
        (stray_demo, "data/demo_x is no rollout; these are groups called demo_<index>"),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_each_contradiction_is_found(
    made: tuple[Dataset, bytes], edit: Callable[[h5py.Group], None], message: str
) -> None:
    found = faults(made, edit)
    assert any(message in fault for fault in found), found
    assert all("\x1b" not in fault and not fault.startswith("demo_0") for fault in found), found


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco", "is no XML: unclosed token"),
        ("", "is no XML: no element found"),
        ("<mujoco/><mujoco/>", "is no XML: junk after document element"),
        ("<mujoco>" * 200_000, "is no XML: no element found"),
        ("<mujoco a='\udcff'/>", "is no XML: it holds what is no character"),
        ("<robot/>", "is XML with another root than mujoco"),
        ("<!DOCTYPE m [<!ENTITY a 'b'>]><mujoco>&a;</mujoco>", "declares a document type"),
        ("<mujoco><worldbody><include file='x.xml'/></worldbody></mujoco>", "includes a file"),
        ("<mujoco><compiler meshdir='/etc'/></mujoco>", "names the file /etc, which lies outside"),
        ("<mujoco><mesh file='a/../../b.obj'/></mujoco>", "names the file a/../../b.obj, which"),
        ("<mujoco><texture fileup='C:\\b.png'/></mujoco>", "names the file C:\\b.png, which"),
        ("<mujoco><mesh file='meshes/b..c.obj'/></mujoco>", None),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_model_file_stands_alone(text: str, message: str | None) -> None:
    found = mjcf_fault(text)
    assert found is None if message is None else found is not None and message in found, found


def test_what_is_not_documented_is_no_fault(made: tuple[Dataset, bytes]) -> None:
    def edit(demo: h5py.Group) -> None:
        demo["obs/embedding"] = np.full((13, 4), np.nan)
        demo.file["mask/20_percent"] = np.array([b"demo_1"])

    assert faults(made, edit) == []

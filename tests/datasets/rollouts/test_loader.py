"""Reading of datasets: windows across shards and workers are what lies in the files, whoever reads them."""

import os
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.rollouts import loader
from cgwm.datasets.rollouts.dataset import shard_entry
from cgwm.datasets.rollouts.index import write_index
from cgwm.datasets.rollouts.loader import RolloutDataset, RolloutReader, shard_files
from cgwm.pipeline.synthesize import synthesize
from cgwm.schemas import SynthesizeConfig, UsageError
from helpers.small_model import HALF, write_small_model

CONFIG = SynthesizeConfig(rollouts=3, shards=2, duration_s=0.3, width=32, height=24, device="cpu", seed=3)
FRAMES = 10
DOCS = Path(__file__).resolve().parents[3] / "docs" / "datasets.md"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loader")
    model = write_small_model(folder / "model")
    for shard in (0, 1):
        synthesize(model, folder / "dataset", CONFIG.model_copy(update={"shard": shard}))
    return folder / "dataset"


def raw(dataset: Path, demo: int, key: str) -> np.ndarray:
    for path in dataset.glob("rollouts-*.h5"):
        with h5py.File(path) as file:
            if f"data/demo_{demo}" in file:
                return np.asarray(file[f"data/demo_{demo}/{key}"])
    raise KeyError(demo)


def test_windows_across_shards(dataset: Path) -> None:
    windows = RolloutDataset(dataset, length=3, stride=2, every=2, keys=["bodies/pos", "obs/{camera}_depth"])
    assert len(windows) == 3 * 3  # starts 0, 2, 4 of ten frames: the last frame read is 4 + 4
    for number in (8, 0, 4, 7, -1):  # in any order
        item = windows[number]
        demo, start = int(item["rollout"]), int(item["start"])
        assert (demo, start) == (number % 9 // 3, 2 * (number % 3))
        for key in ("bodies/pos", "obs/view0_depth", "obs/view1_depth"):
            np.testing.assert_array_equal(item[key], raw(dataset, demo, key)[start : start + 5 : 2])
        np.testing.assert_array_equal(item["view1_T_world_cam"], raw(dataset, demo, "cameras/view1/T_world_cam"))
    with pytest.raises(IndexError):
        windows[9]


def test_keys_and_cameras_are_chosen(dataset: Path) -> None:
    default = RolloutDataset(dataset)
    assert set(default[0]) == {
        *("bodies/pos", "bodies/quat_wxyz", "obs/view0_image", "obs/view1_image", "rollout", "start"),
        *("view0_K", "view1_K", "view0_T_world_cam", "view1_T_world_cam"),
    }
    one = RolloutDataset(dataset, cameras=["view1"], keys=["actions", "obs/{camera}_mask"])[0]
    assert set(one) == {"actions", "obs/view1_mask", "view1_K", "view1_T_world_cam", "rollout", "start"}
    assert set(RolloutDataset(dataset, keys=["time"])[0]) == {"time", "rollout", "start"}
    assert len(RolloutDataset(dataset, length=5, split="train")) == 6 and not len(RolloutDataset(dataset, length=11))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cameras": ["view7"]}, r"no camera 'view7'.*\nAllowed: view0, view1"),
        ({"keys": ["bodies/poss"]}, "no array 'bodies/poss'. Did you mean 'bodies/pos'"),
        ({"keys": ["contacts/pos_world"]}, r"'contacts/pos_world' has the axes \(N, 3\), so it has no windows"),
        ({"keys": ["contacts/offsets"]}, r"has the axes \(T \+ 1,\)"),
        ({"length": 0}, "length 0, stride None, every 1"),
        ({"stride": -1}, "stride -1"),
        ({"split": "test"}, "no split 'test'"),
    ],
)
def test_what_is_not_there_is_told_at_once(dataset: Path, options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        RolloutDataset(dataset, **options)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("method", "count"), [("fork", 2), pytest.param("spawn", 1, marks=pytest.mark.evidence)])
def test_workers_read_the_same(dataset: Path, method: str, count: int) -> None:
    from torch.utils.data import DataLoader

    windows = RolloutDataset(dataset, length=5)
    windows[0]  # opens a file in this process, which a fork must not use
    alone = list(DataLoader(windows, batch_size=4))  # pyright: ignore[reportArgumentType]
    loader = DataLoader(windows, batch_size=4, num_workers=count, multiprocessing_context=method)  # pyright: ignore
    shared = list(loader)
    assert len(alone) == len(shared) == 2
    for one, other in zip(alone, shared, strict=True):
        for key, value in one.items():
            np.testing.assert_array_equal(value, other[key], err_msg=key)
    assert sorted({int(value) for batch in shared for value in batch["rollout"]}) == [0, 1, 2]


def test_a_process_keeps_few_files_open(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loader, "MOST_OPEN", 1)
    reader = RolloutReader(dataset)
    for number in (0, 2, 1, 0, 2):
        position = reader.read(number, "bodies/pos")
        np.testing.assert_array_equal(position, raw(dataset, number, "bodies/pos"))
        assert len([key for key in reader._files if key[0] == os.getpid()]) == 1
    reader.close()


def test_the_index_of_a_merged_dataset_is_read_in_place_of_its_shards(dataset: Path, tmp_path: Path) -> None:
    shards = sorted(dataset.glob("rollouts-*.h5"))
    merged = tmp_path / "merged"
    merged.mkdir()
    shutil.copy(dataset / "dataset.json", merged)
    entries = [shard_entry(shard, k, rollouts=1, frames=1) for k, shard in enumerate(shards)]
    write_index(merged / "index.h5", [(s, os.path.relpath(s, merged), e) for s, e in zip(shards, entries, strict=True)])
    assert shard_files(merged) == [merged / "index.h5"] and shard_files(dataset) == shards
    whole, parts = RolloutDataset(merged, length=4), RolloutDataset(dataset, length=4)
    assert len(whole) == len(parts) == 6
    for number in range(6):
        for key, value in parts[number].items():
            np.testing.assert_array_equal(whole[number][key], value, err_msg=key)


def test_the_reader_of_the_docs(dataset: Path) -> None:
    """The plain reader of docs/datasets.md, 30 lines, runs as it stands and finds what ours finds."""
    (code,) = re.findall(r"```python\n(import h5py\n[\s\S]*?)```", DOCS.read_text())
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 30
    names: dict[str, object] = {"__name__": "reader"}
    exec(compile(code, str(DOCS), "exec"), names)
    read = names["read_rollouts"]
    rollouts = list(read(dataset, ["view1"]))  # pyright: ignore
    assert [rollout["index"] for rollout in rollouts] == [0, 1, 2]
    reader = RolloutReader(dataset)
    for number, rollout in enumerate(rollouts):
        np.testing.assert_array_equal(rollout["pos"], reader.read(number, "bodies/pos"))
        np.testing.assert_array_equal(rollout["view1"]["image"], reader.read(number, "obs/view1_image"))
        np.testing.assert_array_equal(rollout["view1"]["T_world_cam"], reader.read(number, "cameras/view1/T_world_cam"))
        assert rollout["parameters"] == reader.parameters(number)
        for frame in range(FRAMES):
            rows = reader.contacts(number, frame)
            np.testing.assert_array_equal(rollout["contacts"][frame]["impulse_world"], rows["impulse_world"])
            view = rollout["view1"]
            seen = names["points"](rollout, "view1", frame)[(view["mask"] == 1)[frame][view["depth"][frame] > 0]]  # pyright: ignore
            assert np.linalg.norm(seen - rollout["pos"][frame, 0], axis=1).max() < 2 * HALF  # half a diagonal: 1.7
    reader.close()

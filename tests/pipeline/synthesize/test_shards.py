"""Shards: any split gives the same demos; whole ones are kept, damaged ones named; joined they read as one file."""

import errno
import json
import multiprocessing
import os
import re
import resource
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.rollouts.dataset import check_hashes, new_dataset, read_manifest, shard_entry
from cgwm.datasets.rollouts.index import INDEX
from cgwm.datasets.rollouts.loader import RolloutDataset, RolloutReader
from cgwm.datasets.rollouts.shards import shard_name
from cgwm.pipeline.synthesize import merge, synthesize
from cgwm.pipeline.synthesize.shards import synthesize_shards
from cgwm.schemas import (
    DamagedShardError,
    DatasetManifest,
    InputDataError,
    NotConvergedError,
    NotEnoughSpaceError,
    SamplingPlan,
    SynthesizeConfig,
    UsageError,
)
from helpers.commands import Ended
from helpers.forked import Forked, forked
from helpers.small_model import write_small_model

CONFIG = SynthesizeConfig(
    rollouts=5, duration_s=0.3, width=32, height=24, device="cpu", seed=3, shards=3, plan=SamplingPlan(views=1)
)


def shard(number: int, **changes: object) -> SynthesizeConfig:
    return CONFIG.model_copy(update={"shard": number, **changes})


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("models") / "model")


@pytest.fixture(scope="module")
def whole(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "dataset"
    synthesize(model, out, shard(0, shards=1))
    return out


@pytest.fixture(scope="module")
def made(model: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "dataset"
    for number in (2, 0, 1):
        synthesize(model, out, shard(number))
    return out


@pytest.fixture
def parts(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "dataset")


def content(group: h5py.Group) -> dict[str, object]:
    """Everything that a group holds: bytes, type, filters and attributes of each array, and of each group."""
    found: dict[str, object] = {".": dict(group.attrs)}

    def visit(name: str, item: h5py.Group | h5py.Dataset) -> None:
        found[name] = {key: str(value) for key, value in item.attrs.items()}
        if isinstance(item, h5py.Dataset):
            found[name + ":"] = (item.dtype, item.shape, np.asarray(item[()]).tobytes())

    group.visititems(visit)
    return found


@cache
def demos(*files: Path) -> dict[str, dict[str, object]]:
    """Return the content of each demo; once for files that several tests compare with and none changes."""
    found: dict[str, dict[str, object]] = {}
    for file in files:
        with h5py.File(file) as handle:
            found |= {name: content(group) for name, group in handle["data"].items()}
    return found


def flip(file: Path, array: str) -> None:
    """Change a byte in the middle of an array's first block."""
    with h5py.File(file) as handle:
        block = handle[array].id.get_chunk_info(0)
    with file.open("r+b") as stream:
        stream.seek(block.byte_offset + block.size // 2)
        byte = stream.read(1)[0]
        stream.seek(-1, os.SEEK_CUR)
        stream.write(bytes([byte ^ 0x55]))


# In the suite: sharding changes no rollout in test_synthesize.py.
@pytest.mark.evidence
def test_any_split_gives_the_same_demos(whole: Path, made: Path) -> None:
    expected = demos(whole / shard_name(0, 1))
    assert demos(*sorted(made.glob("*.h5"))) == expected and len(expected) == 5
    entries = read_manifest(made).shards
    assert [entry.rollouts for entry in entries] == [1, 2, 2]
    for entry in entries:
        assert entry.sha256 == sha256(made / entry.file) and entry.bytes == (made / entry.file).stat().st_size
        assert entry.device == "cpu" and entry.versions == read_manifest(whole).versions
        assert (made / entry.file).with_suffix(".json").is_file()
    assert check_hashes(made, read_manifest(made)) == []


@pytest.mark.parametrize("rollouts", [4, 6, 10**12])
def test_shards_hold_the_rollouts_that_were_promised(made: Path, tmp_path: Path, rollouts: int) -> None:
    copy = shutil.copytree(made, tmp_path / "copy")
    manifest = read_manifest(made).model_copy(update={"rollouts": rollouts})
    (copy / "dataset.json").write_text(manifest.model_dump_json())
    promise = f"dataset.json promises {rollouts} rollouts in its 3 of 3 shards; they are listed with 5."
    assert check_hashes(copy, read_manifest(copy)) == [promise]
    with pytest.raises(InputDataError, match=re.escape(promise)):
        merge([copy], tmp_path / "index.h5")
    assert not (tmp_path / "index.h5").exists()


def publish(out: Path, source: Path, number: int, start: object) -> None:
    manifest = read_manifest(source).model_copy(update={"shards": ()})
    start.wait()  # pyright: ignore[reportAttributeAccessIssue]
    with new_dataset(out, manifest, source / "model", number, False) as (path, entries):
        path.write_bytes(b"shard %d" % number)
        entries.append(shard_entry(path, number, 1, 1, shard_name(number, manifest.shard_count)))


def test_shards_that_end_together_lose_no_entry(made: Path, tmp_path: Path) -> None:
    count, processes = 12, multiprocessing.get_context("fork")
    source = shutil.copytree(made, tmp_path / "source")
    (source / "dataset.json").write_text(
        read_manifest(made).model_copy(update={"shard_count": count, "rollouts": count, "shards": ()}).model_dump_json()
    )
    for file in source.glob("rollouts-*"):
        file.unlink()
    start, out = processes.Barrier(count), tmp_path / "out"
    tasks = [processes.Process(target=publish, args=(out, source, k, start)) for k in range(count)]
    for task in tasks:
        task.start()
    for task in tasks:
        task.join(60)
        assert task.exitcode == 0
    manifest = read_manifest(out)
    assert [entry.index for entry in manifest.shards] == list(range(count))
    assert check_hashes(out, manifest) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "source"]


def test_resume_keeps_what_is_whole_and_names_what_is_not(model: Path, parts: Path) -> None:
    before = sha256(parts)
    summary = synthesize(model, parts, shard(1), resume=True)
    assert summary.up_to_date and summary.rollouts == 2 and summary.contacts > 0
    assert sha256(parts) == before
    (parts / shard_name(1, 3)).unlink()  # its entry stays, as a kill between the two leaves it
    assert [entry.index for entry in read_manifest(parts).shards] == [0, 2]
    assert not synthesize(model, parts, shard(1), resume=True).up_to_date
    assert sha256(parts) == before
    flip(parts / shard_name(2, 3), "data/demo_4/bodies/quat_wxyz")
    damaged = sha256(parts)
    with pytest.raises(DamagedShardError) as caught:
        synthesize(model, parts, shard(2), resume=True)
    assert str(caught.value) == (
        f"{parts}/rollouts-0002-of-0003.h5: its sha256 differs from dataset.json: "
        "data/demo_4/bodies/quat_wxyz, rows 0 to 9, cannot be read.\n"
        "Allowed: the bytes that were written, or no such file.\n"
        "Next: pass --overwrite as well, which keeps whole shards and makes this one again, or move it away."
    )
    assert sha256(parts) == damaged
    assert not synthesize(model, parts, shard(2), overwrite=True, resume=True).up_to_date
    assert synthesize(model, parts, shard(0), overwrite=True, resume=True).up_to_date
    assert sha256(parts) == before


def test_resume_of_one_shard_and_of_none(model: Path, whole: Path, tmp_path: Path) -> None:
    before = sha256(whole)
    assert synthesize(model, whole, shard(0, shards=1), resume=True).up_to_date
    assert sha256(whole) == before
    assert not synthesize(model, tmp_path / "out", shard(0), resume=True).up_to_date
    with pytest.raises(UsageError, match=r"another dataset: its config.plan.views is 1, here 2\."):
        plan = CONFIG.plan.model_copy(update={"views": 2})
        synthesize(model, tmp_path / "out", shard(1, plan=plan), resume=True)


def test_other_versions_are_refused(model: Path, parts: Path) -> None:
    text = (parts / "dataset.json").read_text()
    torch = read_manifest(parts).versions["torch"]
    (parts / "dataset.json").write_text(text.replace(f'"torch": "{torch}"', '"torch": "1.0"'))
    with pytest.raises(UsageError, match=rf"its versions.torch is '1.0', here '{torch[:4]}"):
        synthesize(model, parts, shard(0), overwrite=True)


def test_the_index_reads_as_one_file(whole: Path, parts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(parts.parent.parent)
    summary = merge([parts])
    assert summary.shards == 3 and summary.rollouts == 5 and summary.index == str(parts / INDEX)
    assert demos(parts / INDEX) == demos(whole / shard_name(0, 1))
    with h5py.File(parts / INDEX) as index, h5py.File(whole / shard_name(0, 1)) as single:
        assert dict(index["data"].attrs) == dict(single["data"].attrs)
        assert {**index.attrs, "config_json": ""} == {**single.attrs, "config_json": ""}  # which has shards = 1
        for split in ("train", "valid"):
            np.testing.assert_array_equal(index["mask"][split], single["mask"][split])
        assert index["data/demo_3/obs/view0_image"].is_virtual
    for joined, alone in zip(RolloutDataset(parts / INDEX, 4), RolloutDataset(whole, 4), strict=True):
        assert joined.keys() == alone.keys()
        for key, value in alone.items():
            np.testing.assert_array_equal(joined[key], value)
    for split in ("train", "valid"):
        assert len(RolloutReader(parts / INDEX, split)) == len(RolloutReader(whole, split))
    assert check_hashes(parts, read_manifest(parts)) == []


def test_the_index_has_equal_bytes_wherever_and_whenever_it_is_made(made: Path, parts: Path, tmp_path: Path) -> None:
    elsewhere = shutil.copytree(made, tmp_path / "deep" / "er")
    first, second = merge([parts]), merge([elsewhere])
    assert first.sha256 == second.sha256 == sha256(elsewhere / INDEX)
    assert read_manifest(parts) == read_manifest(elsewhere)
    assert not list(parts.glob("rollouts-*.json"))  # their content is in dataset.json now
    stamp = (parts / INDEX).stat().st_mtime_ns
    assert merge([parts]).up_to_date and (parts / INDEX).stat().st_mtime_ns == stamp
    moved = parts.rename(tmp_path / "moved")
    assert demos(moved / INDEX) == demos(*sorted(made.glob("*.h5")))


def split_up(made: Path, folder: Path, *groups: tuple[int, ...]) -> list[Path]:
    """Return directories as machines without a common disk make them, each with some of the shards."""
    roots = []
    for name, numbers in zip("abc", groups, strict=False):
        root = shutil.copytree(made, folder / name)
        for number in set(range(3)) - set(numbers):
            for suffix in (".h5", ".json"):
                (root / shard_name(number, 3)).with_suffix(suffix).unlink()
        roots.append(root)
    return roots


def test_directories_of_several_machines_are_joined_by_links(made: Path, parts: Path, tmp_path: Path) -> None:
    a, b = split_up(made, tmp_path, (0, 2), (1, 2))
    before = sha256(a), sha256(b)
    summary = merge([a, b], tmp_path / "all")
    assert summary.notes == (f"{shard_name(2, 3)} is in {a} and, byte for byte, in {b}: the first is taken",)
    assert os.readlink(tmp_path / "all" / shard_name(1, 3)) == f"../b/{shard_name(1, 3)}"
    assert check_hashes(tmp_path / "all", read_manifest(tmp_path / "all")) == []
    assert summary.sha256 == merge([parts]).sha256
    merge([a, b], tmp_path / "some" / "rollouts.h5")
    expected = demos(*sorted(made.glob("*.h5")))
    assert demos(tmp_path / "all" / INDEX) == demos(tmp_path / "some" / "rollouts.h5") == expected
    assert (sha256(a), sha256(b)) == before
    with pytest.raises(UsageError, match=r"2 directories and no --out"):
        merge([a, b])
    with pytest.raises(UsageError, match="exists"):
        merge([a, b], tmp_path / "all")


def edited(manifest: Path, **changes: object) -> None:
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | changes))


def foreign_seed(a: Path, b: Path) -> str:
    settings = read_manifest(b).config | {"seed": 4}
    edited(b / "dataset.json", config=settings)
    return rf"b/dataset.json: another dataset: its config.seed is 4, in {a} 3\."


def foreign_plan(a: Path, b: Path) -> str:
    settings = read_manifest(b).config
    edited(b / "dataset.json", config=settings | {"plan": settings["plan"] | {"push_miss": 0.1}})
    return r"b/dataset.json: another dataset: its config.plan.push_miss is 0.1, in \S+ 0.4\."


def foreign_model(a: Path, b: Path) -> str:
    edited(b / "dataset.json", model_sha256="0" * 64)
    return r"b/dataset.json: another dataset: its model_sha256 is '0000"


def foreign_version(a: Path, b: Path) -> str:
    edited(b / "dataset.json", versions=read_manifest(b).versions | {"numpy": "1.0"})
    return r"b/dataset.json: another dataset: its versions.numpy is '1.0', in "


def foreign_engine(a: Path, b: Path) -> str:
    edited(b / "dataset.json", versions=read_manifest(b).versions | {"rollout_engine": "fused on cuda"})
    return r"b/dataset.json: another dataset: its versions.rollout_engine is 'fused on cuda', in \S+ '[^']+'\."


def foreign_engine_of_a_shard(a: Path, b: Path) -> str:
    file = (b / shard_name(1, 3)).with_suffix(".json")
    edited(file, versions=read_manifest(b).versions | {"rollout_engine": "fused on cuda"})
    return r"b/rollouts-0001-of-0003.h5: made with rollout_engine fused on cuda; the dataset's is (torch|fused on cpu)"


def foreign_entry(a: Path, b: Path) -> str:
    file = (b / shard_name(1, 3)).with_suffix(".json")
    edited(file, model_sha256="1" * 64)
    return r"b/rollouts-0001-of-0003.h5: made from another model \(1111"


def other_rollouts(a: Path, b: Path) -> str:
    """Shard 0 under the name and number of shard 1, with an entry that fits it."""
    shutil.copy(a / shard_name(0, 3), b / shard_name(1, 3))
    entry = json.loads((a / shard_name(0, 3)).with_suffix(".json").read_text())
    (b / shard_name(1, 3)).with_suffix(".json").write_text(
        json.dumps(entry | {"index": 1, "file": shard_name(1, 3), "bytes": (b / shard_name(1, 3)).stat().st_size})
    )
    return r"b/rollouts-0001-of-0003.h5: holds the rollouts 0; its number stands for 1-2\."


def corrupted_block(a: Path, b: Path) -> str:
    flip(b / shard_name(1, 3), "data/demo_2/bodies/pos")
    return (
        r"b/rollouts-0001-of-0003.h5: its sha256 differs from dataset.json: "
        r"data/demo_2/bodies/pos, rows 0 to 9, cannot be read\."
    )


def changed_label(a: Path, b: Path) -> str:
    with h5py.File(b / shard_name(1, 3), "r+") as file:
        file["data/demo_1/bodies/pos"][0, 0, 0] += 1
    return r"its sha256 differs from dataset.json: changed since it was written; all its blocks can be read\."


def missing(a: Path, b: Path) -> str:
    (b / shard_name(1, 3)).unlink()
    (a / shard_name(2, 3)).unlink()
    return r"2 of 3 shards are missing: rollouts-0001-of-0003.h5, rollouts-0002-of-0003.h5 \(--array=1-2\)\."


def twice(a: Path, b: Path) -> str:
    for suffix in (".h5", ".json"):
        shutil.copy((a / shard_name(2, 3)).with_suffix(suffix), b)
    edited((b / shard_name(2, 3)).with_suffix(".json"), sha256="2" * 64)
    return r"two shards have the number 2: \S+a/rollouts-0002-of-0003.h5 and \S+b/rollouts-0002-of-0003.h5\."


FAULTS = [
    foreign_seed,
    foreign_plan,
    foreign_model,
    foreign_version,
    foreign_engine,
    foreign_engine_of_a_shard,
    foreign_entry,
    other_rollouts,
    corrupted_block,
    changed_label,
    missing,
    twice,
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_what_does_not_belong_is_refused_by_name(
    fault: Callable[[Path, Path], str], made: Path, tmp_path: Path
) -> None:
    a, b = split_up(made, tmp_path, (0, 2), (1,))
    message = fault(a, b)
    before = sha256(a), sha256(b)
    with pytest.raises(InputDataError, match=message) as caught:
        merge([a, b], tmp_path / "all")
    assert "the shards cannot be joined" in str(caught.value)
    assert (sha256(a), sha256(b)) == before and not (tmp_path / "all").exists()


def test_an_index_without_its_shards_is_refused_and_reads_as_nothing_measured(parts: Path) -> None:
    merge([parts])
    (parts / shard_name(1, 3)).rename(parts / "gone")
    with pytest.raises(InputDataError, match=r"an index that looks into rollouts-0001-of-0003.h5: no such file"):
        RolloutReader(parts / INDEX)
    with h5py.File(parts / INDEX) as index:  # other readers are not warned, but find no number to take for a label
        assert np.isnan(index["data/demo_1/bodies/pos"][()]).all()
        assert (index["data/demo_1/obs/view0_image"][()] == 255).all()
        assert np.isfinite(index["data/demo_3/bodies/pos"][()]).all()


def test_an_index_of_other_shards_is_found(model: Path, parts: Path) -> None:
    merge([parts])
    with h5py.File(parts / shard_name(1, 3), "r+") as file:
        file["data/demo_1/bodies/pos"][0, 0, 0] += 1
    assert not synthesize(model, parts, shard(1), overwrite=True, resume=True).up_to_date
    assert check_hashes(parts, read_manifest(parts)) == []  # the same bytes again
    entry = read_manifest(parts).shards[1].model_copy(update={"sha256": "3" * 64})
    (parts / entry.file).with_suffix(".json").write_text(entry.model_dump_json())
    faults = check_hashes(parts, read_manifest(parts))
    assert f"{INDEX}: of other shards than those that are there; make it again with 'cgwm merge --overwrite'." in faults


def small_limit() -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))


def options_of(config: SynthesizeConfig) -> list[str]:
    sizes = {"duration_s": config.duration_s, "width": config.width, "height": config.height}
    sizes["plan.views"] = config.plan.views
    pairs = [f"--set=synthesize.{name}={value}" for name, value in sizes.items()]
    return [f"--rollouts={config.rollouts}", f"--seed={config.seed}", "--device=cpu", "--no-preview", *pairs]


def test_a_full_disk_is_named_and_what_was_complete_stays(model: Path, parts: Path) -> None:
    (parts / shard_name(1, 3)).unlink()
    (parts / shard_name(1, 3)).with_suffix(".json").unlink()
    before = sha256(parts)
    words = ["synthesize", model, "--out", parts, "--shard=1/3", *options_of(CONFIG)]
    with Forked(*words, before=small_limit) as process:
        done = process.ended()
    assert done.stderr == (
        f"{parts}: no room for rollouts-0001-of-0003.h5: File too large. What was unfinished is removed.\n"
        "Allowed: what df, quota and ulimit -f leave.\n"
        "Next: make room, or choose another --out, and run the command again; what is complete is still there.\n"
    )
    assert done.returncode == 1  # HDF5 by itself ends such a process by a segmentation fault
    assert sha256(parts) == before and sorted(path.name for path in parts.parent.iterdir()) == ["dataset"]


def test_a_disk_that_is_full_at_the_end_is_no_complete_shard(
    model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last blocks leave HDF5's cache when the file is closed: that they were lost must not go unseen."""
    real = os.write

    def full(descriptor: int, data: memoryview) -> int:
        if os.lseek(descriptor, 0, os.SEEK_CUR) > 100_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, data)

    monkeypatch.setattr("cgwm.datasets.rollouts.guarded_file.os.write", full)
    with pytest.raises(NotEnoughSpaceError, match=r"no room for rollouts-0000-of-0001.h5: No space left on device"):
        synthesize(model, tmp_path / "out", shard(0, shards=1, rollouts=1))
    assert list(tmp_path.iterdir()) == []


def interrupted(model: Path, out: Path, number: signal.Signals) -> Ended:
    """Make all shards in a process of its own, and send it a signal while it writes the second."""
    with Forked("synthesize", model, "--out", out, "--shards=3", *options_of(CONFIG)) as process:
        end = time.monotonic() + 120
        while not list(out.parent.glob(f".{out.name}.{shard_name(1, 3)}.partial-*")):
            assert process.poll() is None and time.monotonic() < end, process.printed()
            time.sleep(0.002)
        process.send_signal(number)
        return process.ended(60)


# In the suite: a kill and a shard that fails leave them below.
@pytest.mark.evidence
def test_an_interrupt_leaves_the_complete_shards(model: Path, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = interrupted(model, out, signal.SIGINT)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == (
        f"Interrupted; 1 of 3 shards of {out} are complete; the same command with --resume goes on.\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert sorted(path.name for path in out.glob("roll*")) == ["rollouts-0000-of-0003.h5", "rollouts-0000-of-0003.json"]
    summary = synthesize_shards(model, out, CONFIG, resume=True)
    assert (summary.made, summary.shards, summary.rollouts) == (2, 3, 5)
    assert sha256(out) == sha256(made)


def test_a_kill_leaves_what_can_be_resumed(model: Path, made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert interrupted(model, out, signal.SIGKILL).returncode == -signal.SIGKILL
    (left,) = tmp_path.glob(".*")
    elsewhere = tmp_path / ".out.rollouts-0002-of-0003.h5.partial-1-00000000-00000000.h5"
    elsewhere.touch()  # of a process on another machine, which may be alive
    assert [entry.index for entry in read_manifest(out).shards] == [0]
    with pytest.raises(
        UsageError, match=r"rollouts-0000-of-0003.h5 exists.\nNext: .*--resume, which keeps what is whole"
    ):
        synthesize_shards(model, out, CONFIG)
    assert synthesize_shards(model, out, CONFIG, resume=True).made == 2
    assert not left.exists() and elsewhere.exists()
    assert sha256(out) == sha256(made)
    assert merge([out]).notes == (f"left unfinished by a process that may be running: {elsewhere}",)


def test_a_shard_that_fails_does_not_hold_up_the_others(
    model: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverging(path: Path, out: Path, config: SynthesizeConfig, *rest: bool) -> object:
        if config.shard == 1:
            raise NotConvergedError("rollout 1 diverged.", todo="look at it.")
        return synthesize(path, out, config, *rest)

    monkeypatch.setattr("cgwm.pipeline.synthesize.shards.synthesize", diverging)
    with pytest.raises(NotConvergedError) as caught:
        synthesize_shards(model, tmp_path / "out", CONFIG)
    assert str(caught.value) == (
        "shard 1: rollout 1 diverged. (1 of 3 shards failed, 2 are complete.)\nNext: look at it."
    )
    monkeypatch.undo()
    assert synthesize_shards(model, tmp_path / "out", CONFIG, resume=True).made == 1
    assert sha256(tmp_path / "out") == sha256(made)


def test_the_command_line_speaks_of_shards(model: Path, parts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    words = ["synthesize", str(model), "--out", str(parts), *options_of(CONFIG)]
    done = forked(*words, "--shard", "1/3", "--resume")
    assert done.returncode == 0
    first, *rest = done.stdout.splitlines()
    line, last = (next(found for found in rest if found.startswith(start)) for start in ("all 3", "then"))
    assert first == f"{parts}/rollouts-0001-of-0003.h5 is up to date; cameras: view0."
    wrap = "cgwm " + shlex.join(words) + " --shard $SLURM_ARRAY_TASK_ID/3 --resume"
    assert line == f"all 3 on SLURM: sbatch --array=0-2 --wrap {shlex.quote(wrap)}"
    assert last == f"then: cgwm merge {parts}"
    refused = forked(*words, "--shard=1/3", "--shards=3")
    assert (refused.returncode, refused.stderr) == (
        2,
        "--shard 1/3 is one shard, --shards makes all.\nAllowed: one of the two.\nNext: leave one of the two out.\n",
    )


def test_ray_that_is_not_installed_is_named(model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"--ray needs the package ray[\s\S]*pip install 'cgwm\[ray\]'"):
        synthesize_shards(model, tmp_path / "out", CONFIG, ray="local")


def test_manifests_of_before_are_read(made: Path) -> None:
    old = json.loads((made / "dataset.json").read_text())
    del old["index"]
    assert DatasetManifest.model_validate(old).index is None

"""Outputs appear complete or not at all."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cgwm.cli.repeats import request_of
from cgwm.datasets import new_directory, new_file, sha256
from cgwm.datasets.io.atomic import copy_files
from cgwm.datasets.io.outputs import RECORD, signed
from cgwm.schemas import InputDataError, UsageError


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != RECORD)


def test_directory_appears_at_the_end(tmp_path: Path) -> None:
    out = tmp_path / "made" / "on" / "the" / "way" / "out"
    with new_directory(out, "model") as directory:
        (directory / "a").write_text("1")
        assert directory.parent == out.parent and not out.exists()
        assert re.fullmatch(rf"\.out\.partial-{os.getpid()}-[0-9a-f]{{8}}-[0-9a-f]{{8}}", directory.name)
    assert names(out) == ["a"] and names(out.parent) == ["out"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_nothing_stays_after_an_exception(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), new_directory(tmp_path / "out", "model") as directory:
        (directory / "a").write_text("1")
        raise error
    with pytest.raises(error), new_file(tmp_path / "out.json", "effect") as file:
        file.write_text("1")
        raise error
    assert names(tmp_path) == []


def test_existing_output_is_refused_before_work(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "file").write_text("old")
    for make, name in ((new_directory, "out"), (new_file, "file")):
        with pytest.raises(UsageError) as caught, make(tmp_path / name, "model" if name == "out" else "effect"):
            raise AssertionError("not reached")
        assert str(caught.value) == f"{tmp_path / name} exists.\nNext: choose another name or pass --overwrite."
        assert caught.value.exit_code == 2
    assert names(tmp_path) == ["file", "out"]


def test_output_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(UsageError), new_directory(tmp_path / "out", "model") as directory:
        (directory / "mine").touch()
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "theirs").touch()
    with pytest.raises(UsageError), new_file(tmp_path / "file", "effect") as file:
        file.write_text("mine")
        (tmp_path / "file").write_text("theirs")
    assert names(tmp_path / "out") == ["theirs"] and (tmp_path / "file").read_text() == "theirs"
    assert names(tmp_path) == ["file", "out"]


def test_overwrite_keeps_the_old_until_the_new_is_complete(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with new_directory(out, "model") as directory:
        (directory / "old").touch()
    with pytest.raises(ValueError), new_directory(out, "model", overwrite=True):
        assert names(out) == ["old"]
        raise ValueError
    assert names(out) == ["old"] and names(tmp_path) == ["out"]
    with new_directory(out, "model", overwrite=True) as directory:
        (directory / "new").touch()
    assert names(out) == ["new"] and names(tmp_path) == ["out"]
    with new_file(tmp_path / "file", "effect", overwrite=True) as file:
        file.write_text(signed("1\n"))
    with new_file(tmp_path / "file", "effect", overwrite=True) as file:
        file.write_text(signed("2\n"))
    assert (tmp_path / "file").read_text() == signed("2\n")


def test_overwrite_does_not_remove_a_home_or_a_work_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "repository" / ".git").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(tmp_path / "people" / "me"))
    (tmp_path / "people" / "me").mkdir(parents=True)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    for name, reason in (
        ("repository", "holds a .git"),
        ("people", "is, or contains, the home or working directory"),
        ("work", "is, or contains, the home or working directory"),
    ):
        with pytest.raises(UsageError) as caught, new_directory(tmp_path / name, "model", overwrite=True):
            raise AssertionError("not reached")
        expected = f"{tmp_path / name} {reason}; --overwrite does not remove it.\nNext: choose another name."
        assert str(caught.value) == expected


_KILLED = """
import sys, time
from cgwm.datasets import new_directory, new_file
with new_directory(sys.argv[1], "model") as directory, new_file(sys.argv[2], "effect") as file:
    (directory / "half").write_text("x")
    file.write_text("x")
    print("writing", flush=True)
    time.sleep(60)
"""


def test_a_killed_process_leaves_no_output_and_is_tidied_up_after(tmp_path: Path) -> None:
    out, file = tmp_path / "out", tmp_path / "file.json"
    process = subprocess.Popen([sys.executable, "-c", _KILLED, str(out), str(file)], stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "writing\n"
    with new_directory(tmp_path / "out2", "model"):
        pass
    process.send_signal(signal.SIGSTOP)
    with new_directory(tmp_path / "other", "model"):
        pass
    process.kill()
    process.wait()
    left = names(tmp_path)
    assert "out" not in left and "file.json" not in left
    partial = [name for name in left if ".partial-" in name]
    assert len(partial) == 2 and all(name.startswith(".") for name in partial)
    with new_directory(out, "model"), new_file(file, "effect") as temporary:
        temporary.write_text("whole")
    assert names(tmp_path) == ["file.json", "other", "out", "out2"]


def test_what_a_living_process_or_another_machine_writes_stays(tmp_path: Path) -> None:
    living = tmp_path / f".out.partial-{os.getpid()}-00000000-11111111"
    elsewhere = tmp_path / ".out.partial-999999999-00000000-11111111"
    other_output = tmp_path / ".out.b.partial-999999999-11111111"
    dead = tmp_path / ".out.partial-999999999-11111111"
    for folder in (living, elsewhere, other_output, dead):
        folder.mkdir()
    with new_directory(tmp_path / "out", "model"):
        pass
    assert living.exists() and elsewhere.exists() and other_output.exists() and not dead.exists()


def test_a_replaced_directory_comes_back_if_its_replacement_never_arrived(tmp_path: Path) -> None:
    aside = tmp_path / ".out.replaced-999999999-11111111"
    aside.mkdir()
    (aside / "old").touch()
    with pytest.raises(UsageError), new_directory(tmp_path / "out", "model"):
        raise AssertionError("not reached")
    assert names(tmp_path / "out") == ["old"]


def test_sha256_of_a_directory_sees_names_and_contents(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "sub" / "file").write_text("1")
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    (tmp_path / "empty").touch()
    assert sha256(tmp_path / "empty") == empty
    assert sha256(tmp_path / "a") == sha256(tmp_path / "b")
    (tmp_path / "b" / "sub" / "file").rename(tmp_path / "b" / "sub" / "other")
    assert sha256(tmp_path / "a") != sha256(tmp_path / "b")


def test_import_is_light() -> None:
    code = (
        "import sys; import cgwm.datasets as d; from cgwm.datasets import Capture, Model, import_contactnets;"
        "print([m for m in ('torch', 'mujoco', 'pycolmap') if m in sys.modules])"
    )
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n" and time.perf_counter() - start < 10


def test_every_public_name_exists() -> None:
    import cgwm.datasets

    for name in cgwm.datasets.__all__:
        assert getattr(cgwm.datasets, name) is not None
    assert set(cgwm.datasets.__all__) == set(cgwm.datasets._PUBLIC)


def test_a_copy_has_the_files_that_the_hash_counts(tmp_path: Path) -> None:
    source = tmp_path / "model"
    (source / "tracks").mkdir(parents=True)
    (source / "tracks" / "a.csv").write_text("1")
    (source / "linked").symlink_to("tracks/a.csv")
    (source / "broken").symlink_to("nowhere")
    os.mkfifo(source / "pipe")
    copy_files(source, tmp_path / "copy")
    assert sorted(path.name for path in (tmp_path / "copy").rglob("*")) == ["a.csv", "linked", "tracks"]
    assert not (tmp_path / "copy" / "linked").is_symlink()
    assert sha256(tmp_path / "copy") == sha256(source)


def test_a_file_that_may_not_be_read_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.jpg").write_bytes(b"a")
    monkeypatch.setattr("os.access", lambda path, mode: False)  # root may read what it likes
    for work in (sha256, lambda folder: request_of("mask", {"source": folder})):
        with pytest.raises(InputDataError, match=r"a\.jpg: cannot be read: Permission denied"):
            work(tmp_path)


def test_an_output_inside_of_its_input_is_no_part_of_the_request(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"a")
    first = request_of("mask", {"source": tmp_path, "out": tmp_path / "masks"})
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.png").write_bytes(b"1")
    assert request_of("mask", {"source": tmp_path, "out": tmp_path / "masks"}) == first
    assert request_of("mask", {"source": tmp_path, "out": tmp_path / "other"}) != first

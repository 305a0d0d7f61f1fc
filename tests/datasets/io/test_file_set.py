"""Files that are replaced together: whatever the moment of a kill, old or new, and never files of two sets."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from cgwm.datasets.io import atomic, file_set
from cgwm.datasets.io.file_set import new_files, settle_files

NAMES = ("cameras.json", "calibration.json", "sparse_points.ply")
TEXTS = ('{"format": "cgwm-cameras/1", "set": "%s"}', '{"format": "cgwm-calibration/1", "set": "%s"}', "%s")
Moment = Callable[[], None]


def write(folder: Path, name: str, overwrite: bool = False) -> None:
    with new_files(folder / NAMES[0], NAMES[1:], "calibration", overwrite) as temporary:
        for file, text in zip(NAMES, TEXTS, strict=True):
            (temporary / file).write_text(text % name)


def found(folder: Path) -> dict[str, str]:
    texts = {file: text % "|" for file, text in zip(NAMES, TEXTS, strict=True)}
    there = {file: (folder / file).read_text() for file in NAMES if (folder / file).exists()}
    return {file: text.removeprefix(texts[file].split("|")[0]).split('"')[0] for file, text in there.items()}


def killed_at(moment: int, monkeypatch: pytest.MonkeyPatch, work: Callable[[], None]) -> bool:
    """Run in a process that dies right before a rename, a removal or a new folder; return whether it did."""
    child = os.fork()
    if child == 0:
        left = moment

        def dying(function: Callable) -> Callable:
            def operation(*given, **named):
                nonlocal left
                left -= 1
                if left < 0:
                    os._exit(9)
                return function(*given, **named)

            return operation

        for name in ("rename", "replace", "mkdir", "unlink", "rmdir"):
            setattr(os, name, dying(getattr(os, name)))
        work()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@pytest.mark.parametrize("old", [False, True])
def test_a_kill_at_every_operation(old: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes, moment, alive = set(), 0, True
    while alive:
        folder = tmp_path / str(moment)
        folder.mkdir()
        if old:
            write(folder, "old")
        alive = killed_at(moment, monkeypatch, lambda folder=folder: write(folder, "new", overwrite=old))
        seen = found(folder)
        assert len(set(seen.values())) <= 1, f"{moment}: {seen}"
        assert NAMES[0] in seen or not old
        settle_files(folder / NAMES[0])
        settled = found(folder)
        assert not [name for name in os.listdir(folder) if name.startswith(".")]
        if old:
            assert len(settled) == 3 and len(set(settled.values())) == 1, f"{moment}: {seen}, then {settled}"
        else:
            assert len(settled) in (0, 1, 2, 3) and (NAMES[0] not in settled or len(settled) == 3)
        outcomes.add(settled.get(NAMES[0]))
        write(folder, "next", overwrite=NAMES[0] in settled)
        assert set(found(folder).values()) == {"next"} and sorted(os.listdir(folder)) == sorted(NAMES)
        moment += 1
    assert outcomes == {"old" if old else None, "new"} and moment > 5


def test_files_that_somebody_put_there_since_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, "old")

    def place(pending: Path, first: Path, others: object) -> None:
        plain(pending, first, others)
        os._exit(9)

    plain = file_set._place
    for moment in range(3, 12):
        if killed_at(moment, monkeypatch, lambda: write(tmp_path, "new", overwrite=True)):
            (tmp_path / NAMES[0]).write_text("mine")
            settle_files(tmp_path / NAMES[0])
            assert (tmp_path / NAMES[0]).read_text() == "mine"
            assert not list(tmp_path.glob(".*.pending-*"))
            for name in NAMES:
                (tmp_path / name).unlink(missing_ok=True)
            write(tmp_path, "old")


def test_a_failure_while_files_are_placed_is_settled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, "old")
    monkeypatch.setattr(file_set, "_place", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, "new", overwrite=True)
    assert set(found(tmp_path).values()) == {"old"} and sorted(os.listdir(tmp_path)) == sorted(NAMES)
    assert atomic.sha256(tmp_path / NAMES[0])

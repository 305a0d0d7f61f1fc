"""What must hold of every command on every input, whatever it is."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path

from .client import Seen

CODES = (0, 1, 2, 130)
MOST_MB = 4000
"""Memory that no command on inputs of some kB may need."""
STARTS = ("c++", "g++", "cc1plus", "clang++", "nvidia-smi", "nvcc", "ldconfig", "gcc", "cc", "uname", "lscpu")
"""Programs that cgwm itself starts: compilers of its kernels, and what says which device there is."""
CRITICAL = ("execution", "process", "inputs changed", "written elsewhere")
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_OPTION = re.compile(r"--[a-z]+|(sg-gs|phys-geo|synthesize|calibrate)\.\w+|\[(sg-gs|phys-geo|synthesize|calibrate)\]")
_OWN_PLACES = ("/dev/null", "/dev/tty", "/proc/self", "/dev/shm")
_LIBRARIES = ("torchinductor_*", "torch-*")
"""Folders that torch makes in the temporary directory when it is imported."""


def snapshot(root: Path) -> dict[str, str]:
    """Return what lies in a folder: each path with the hash of its content or its kind."""
    found = {}
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            found[name] = f"link to {os.readlink(path)}"
        elif stat.S_ISREG(mode):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = oct(stat.S_IFMT(mode))
    return found


def faults(
    seen: Seen,
    root: Path,
    temporary: Path,
    before: dict[str, str],
    changes: Sequence[str],
    places: Sequence[Path],
    words: Sequence[str] = (),
) -> list[tuple[str, str]]:
    """Return what is wrong, as pairs of class and detail.

    Args:
        seen: What the command did.
        root: The folder that it ran in.
        temporary: Its folder for temporary files.
        before: The folder before.
        changes: Patterns of what it may write among its inputs if it succeeds.
        places: Folders that it may write to besides.
        words: What the user typed.
    """
    said = seen.stderr + seen.stdout
    found = [*_safety(seen, root, temporary, places), *_left(seen, root, temporary, before, changes)]
    if seen.timed_out:
        found.append(("hang", f"not done after {seen.seconds:.0f} s"))
        return found
    if seen.code not in CODES:
        found.append(("exit code", f"{seen.code}: {first(said)}"))
    if "Internal error in cgwm" in said:
        found.append(("internal error", first(said, "Internal error")))
    if "Traceback (most recent call last)" in said:
        found.append(("traceback", said.strip().splitlines()[-1]))
    if "Out of memory." in said or seen.peak_mb > MOST_MB:
        found.append(("memory", f"{seen.peak_mb} MB: {first(said)}"))
    raw = _CONTROL.search(said)
    if raw:
        found.append(("control characters", repr(said[max(0, raw.start() - 40) : raw.end() + 10])))
    if seen.code in (1, 2) and not any(kind in ("internal error", "traceback", "memory") for kind, _ in found):
        found += _message(seen, before, words)
    found += [
        ("warning without file", line)
        for line in seen.stderr.splitlines()
        if line.startswith("Warning:") and not _names(line, before, folders=False)
    ]
    return found


def _safety(seen: Seen, root: Path, temporary: Path, places: Sequence[Path]) -> list[tuple[str, str]]:
    found = []
    allowed = [os.path.realpath(place) for place in (root, temporary, *places)]
    for event in seen.events:
        if event[0] == "run" or (event[0] == "unpickle" and event[1] in ("os", "posix", "builtins", "subprocess")):
            found.append(("execution", " ".join(event)))
        elif event[0] == "start" and not any(name in os.path.basename(event[2].split(" ")[0]) for name in STARTS):
            found.append(("process", " ".join(event)))
        elif event[0] == "write":
            path = os.path.realpath(os.path.dirname(event[1])) + "/" + os.path.basename(event[1])
            if not any(path.startswith(place + "/") for place in allowed) and not path.startswith(_OWN_PLACES):
                found.append(("written elsewhere", event[1]))
    if list(root.glob("**/CANARY")):
        found.append(("execution", "the canary is there"))
    return found


def _left(
    seen: Seen, root: Path, temporary: Path, before: dict[str, str], changes: Sequence[str]
) -> list[tuple[str, str]]:
    after = snapshot(root)
    failed = seen.code != 0 or seen.timed_out
    lost = [name for name in before if after.get(name) != before[name]]
    may = () if failed else changes
    lost = [name for name in lost if not any(fnmatch(name, pattern) for pattern in may)]
    found = [("inputs changed", ", ".join(lost[:4]))] if lost else []
    new = sorted(set(after) - set(before))
    if failed:
        kept = [name for name in new if ".checkpoint" not in name]
        if kept and not seen.timed_out:
            found.append(("left", ", ".join(kept[:4])))
    else:
        hidden = [name for name in new if ".partial" in name or ".replaced" in name]
        strange = [n for n in new if not n.startswith("OUT") and not any(fnmatch(n, p) for p in may)]
        if hidden or strange:
            found.append(("left", ", ".join((hidden + strange)[:4])))
    rest = [p.name for p in temporary.iterdir() if not any(fnmatch(p.name, pattern) for pattern in _LIBRARIES)]
    if rest and not seen.timed_out:
        found.append(("left in the temporary directory", ", ".join(sorted(rest)[:4])))
    return found


def _message(seen: Seen, before: dict[str, str], words: Sequence[str]) -> list[tuple[str, str]]:
    told = "\n".join(line for line in seen.stderr.splitlines() if not line.startswith("Warning:"))
    is_report = seen.code == 1 and "fault" in seen.stdout
    text = told + seen.stdout if is_report else told
    if not text.strip():
        return [("no message", f"exit code {seen.code}")]
    found = []
    told_first = text.split("\nAllowed:")[0].split("\nNext:")[0]
    typed = any(len(word) > 1 and word not in before and word in told_first for word in words[1:])
    if not _names(text, before, folders=False) and not _OPTION.search(told_first) and not typed:
        kind = "names only the folder" if _names(text, before, folders=True) else "names no file"
        found.append((kind, first(text)))
    if is_report:
        return found
    if sum(line.startswith("Next:") for line in told.splitlines()) > 1 and not re.match(r".*: \d+ faults", told):
        found.append(("two messages", first(text)))
    if "\nAllowed: " not in told and "\nNext: " not in told:
        found.append(("neither allowed nor next", first(text)))
    return found


def _names(text: str, before: dict[str, str], folders: bool) -> bool:
    """Return whether a text names an input: its path, or at least its name where that is no word."""
    tops = {name.split("/", 1)[0] for name in before}
    if any(re.search(rf"(^|[\s/'\"]){re.escape(top)}/[^\s:]", text) for top in tops):
        return True  # a path within an input, which may be one that should be there
    for name, content in before.items():
        is_folder = content == oct(stat.S_IFDIR)
        base = name.rsplit("/", 1)[-1]
        if is_folder and not folders and "." not in base:
            continue
        if name in text or ("." in base and base in text) or (folders and re.search(rf"\b{re.escape(base)}\b", text)):
            return True
    return False


def first(text: str, beginning: str = "") -> str:
    """Return the first line of a text, or the first one that has some words in it."""
    lines = [line for line in text.splitlines() if line.strip()]
    return next((line for line in lines if beginning in line), lines[0] if lines else "")[:300]

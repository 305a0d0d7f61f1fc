"""A case: a subject, mutations of its files, and a command; drawn by hypothesis, run by a warm server, judged."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from . import hdf5, mutations, oracle
from .client import Runner, Seen
from .subjects import SUBJECTS, Command, Library
from .values import HARD_NUMBERS, HARD_TEXTS


@dataclass(frozen=True)
class Case:
    """What is tried; as JSON it can be tried again."""

    subject: str
    words: tuple[str, ...]
    changes: tuple[dict[str, Any], ...] = ()
    forged: bool = False
    """Whether the hashes in the manifest of a dataset are made to agree with what was changed."""

    def json(self) -> str:
        return json.dumps(asdict(self))

    @staticmethod
    def of(text: str) -> Case:
        data = json.loads(text)
        return Case(data["subject"], tuple(data["words"]), tuple(data["changes"]), data["forged"])

    @property
    def command(self) -> Command:
        return next((c for c in SUBJECTS[self.subject].commands if c.words[:3] == self.words[:3]), Command(self.words))

    def __str__(self) -> str:
        changes = "; ".join(json.dumps(change) for change in self.changes)
        changes = changes if len(changes) < 400 else changes[:300] + " ... " + changes[-60:]
        return f"[{self.subject}] cgwm {' '.join(self.words)}   <- {changes}{' (forged)' if self.forged else ''}"


@dataclass(frozen=True)
class Verdict:
    """How a case went."""

    case: Case
    seen: Seen
    faults: tuple[tuple[str, str], ...]


SETTINGS = {
    "improve": ("improve.steps", "improve.folds", "phys-geo.step_s", "phys-geo.effects", "phys-geo.supervise"),
    "fit": (
        "phys-geo.step_s",
        "phys-geo.population",
        "phys-geo.generations",
        "phys-geo.warmup_s",
        "phys-geo.effects",
        "phys-geo.seed",
        "sg-gs.iterations",
        "phys-geo.supervise",
    ),
    "synthesize": (
        "synthesize.duration_s",
        "synthesize.frame_rate_hz",
        "synthesize.rollouts",
        "synthesize.width",
        "synthesize.batch",
        "synthesize.seed",
        "synthesize.shards",
        "synthesize.compression",
        "synthesize.shadows",
        "synthesize.plan",
    ),
}
OPTIONS = {
    "fit": ("--seed", "--split", "--effects", "--spheres", "--from", "--supervise", "--config"),
    "synthesize": ("--seed", "--rollouts", "--shard", "--shards", "--plan", "--config", "--trust-effects"),
    "validate": ("--sample", "--seed"),
    "eval": ("--split", "--warmup-s", "--trust-effects"),
    "compare": ("--split", "--warmup-s"),
    "diagnose": ("--split", "--candidates", "--throws", "--trust-effects"),
    "control": ("--seeds", "--draws", "--solver", "--clock", "--device"),
    "improve": ("--split", "--steps", "--from", "--candidates", "--throws", "--config", "--seed"),
    "export": ("--split", "--cameras", "--every", "--task", "--rollout", "--mask", "--sh-degree", "--duration"),
    "import": ("--train", "--test", "--seed", "--only", "--columns", "--length-unit", "--time-unit", "--body"),
    "view": ("--port", "--host"),
    "mask": ("--box", "--photo", "--body", "--empty"),
    "calibrate": ("--seed", "--target", "--intrinsics"),
}  # fmt: skip


def commands(subject: str, verbs: tuple[str, ...]) -> st.SearchStrategy[Command]:
    """Return a strategy of the commands of a subject, slow ones less often."""
    allowed = [c for c in SUBJECTS[subject].commands if not verbs or c.words[0] in verbs]
    weighted = [c for c in allowed for _ in range(round(10 * c.weight))]
    return st.sampled_from(weighted)


_mutations = cache(mutations.mutations)


@st.composite
def cases(draw: st.DrawFn, library: Library, subjects: tuple[str, ...] = (), verbs: tuple[str, ...] = ()) -> Case:
    """Draw a case of some subjects (default: all, by their weights) and commands (default: all)."""
    names = subjects or tuple(n for n, s in SUBJECTS.items() if s.weight)
    name = draw(st.sampled_from([n for n in names for _ in range(max(1, round(4 * SUBJECTS[n].weight)))]))
    subject = SUBJECTS[name]
    words = draw(commands(name, verbs)).words
    root = library.built(name)
    files = sorted({p for pattern in subject.files for p in root.glob(pattern) if p.is_file()})
    options = OPTIONS.get(words[0], ())
    if options and draw(st.integers(0, 11)) == 0:
        return Case(name, (*words, *draw(_arguments(words[0]))))
    # a file of each kind is as likely as another: of a hundred frames, one matters as much as the manifest
    kinds = sorted({(p.parent.name if p.stem.isdigit() else p.name, p.suffix) for p in files})
    kind = draw(st.sampled_from(kinds))
    file = draw(
        st.sampled_from([p for p in files if (p.parent.name if p.stem.isdigit() else p.name, p.suffix) == kind])
    )
    change = _mutations(file, file.relative_to(root).as_posix())
    changes = [draw(change)]
    if draw(st.integers(0, 9)) == 0:
        changes.append(draw(change))
    return Case(name, words, tuple(changes), forged=draw(st.booleans()) if "dataset" in name else False)


@st.composite
def _arguments(draw: st.DrawFn, verb: str) -> tuple[str, ...]:
    value = draw(
        st.one_of(st.sampled_from(HARD_NUMBERS), st.sampled_from(HARD_TEXTS[:-1]), st.integers(-5, 50).map(str))
    )
    value = value.replace("\0", "\x01")[:3000]
    if verb in SETTINGS and draw(st.booleans()):
        return ("--set", f"{draw(st.sampled_from(SETTINGS[verb]))}={value}")
    return (draw(st.sampled_from(OPTIONS[verb])), value)


class Trial:
    """Runs cases, each in a folder of its own."""

    def __init__(self, folder: Path, runner: Runner, library: Library) -> None:
        self.folder, self.runner, self.library = folder, runner, library
        self._count = 0

    def run(self, case: Case, keep: bool = False) -> Verdict:
        """Make the inputs of a case, run its command, and judge it."""
        seen, found = self.run_on(case.subject, lambda root: make(root, case), case.words, case.command, keep)
        return Verdict(case, seen, tuple(found))

    def run_on(
        self,
        subject: str,
        prepare: Callable[[Path], None],
        words: Sequence[str],
        command: Command | None = None,
        keep: bool = False,
    ) -> tuple[Seen, list[tuple[str, str]]]:
        """Copy a subject, change the copy, run a command in it, and return what was seen and what is wrong."""
        command = command or Case(subject, tuple(words)).command
        self._count += 1
        place = self.folder / f"case-{self._count}"
        root, temporary = place / "in", place / "tmp"
        temporary.mkdir(parents=True)
        self.library.copy(subject, root)
        try:
            prepare(root)
            before = oracle.snapshot(root)
            limit = 8.0 if command.serves else None
            seen = self.runner.run(list(words), root, temporary, limit, interrupt=command.serves)
            found = oracle.faults(seen, root, temporary, before, command.changes, [self.runner.home], words)
            return seen, list(dict.fromkeys(found))
        finally:
            if not keep:
                shutil.rmtree(place, ignore_errors=True)


def make(root: Path, case: Case) -> None:
    """Apply the mutations of a case to a copy of its subject; those that no longer apply are left out."""
    for change in case.changes:
        try:
            mutations.apply(root, change)
        except (KeyError, IndexError, StopIteration, TypeError, ValueError, OSError, RuntimeError):
            continue
    if case.forged and (root / "dataset").is_dir():
        hdf5.refresh(root / "dataset")

"""Compare what this tree computes with what a reference commit computes: `make same`.

For a change that is to move, rename or split code and to alter no number. Both trees are built as wheels and installed
into folders of their own, the commands run on the same small captures from an empty folder where neither source tree
can be imported, and everything that they write is compared: JSON key by key, HDF5 array by array, other files by byte.
What may differ is named in `MASKS`. Tests are counted, too: none may vanish but those in `DROPPED_TESTS`.

Reference outputs are kept in `build/same/` and made anew when the reference or an installed package changes.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "same"
REFERENCE = "af3142a"
"""Commit whose outputs count."""

MASKS: Sequence[tuple[str, str, str]] = (
    (r"(^|\.)(cgwm|version|versions|packages|software)(\.|$)", ".*", "versions of packages"),
    (
        r"(^|\.)(created|date|finished|started|host|command|argv|parent|out|model|capture|source|path|directory)$",
        ".*",
        "paths, times and the command line of the run",
    ),
    (
        r"(^|\.)(\w*seconds\w*|frames_per_s|\w*_(s_taken|wall_s|elapsed_s)|timing_s|stages_s)(\.|$)",
        ".*",
        "wall times",
    ),
    (r"(^|\.)inputs(\.|$)", ".*", "hashes by path of the files that were read"),
    (r"(^|\.)(model_json|provenance|settings)(\.|$)", ".*", "text that repeats the masked fields"),
    (r"(^|\.)\w*sha256$", ".*", "hashes of files that contain masked fields"),
)
"""What may differ: a pattern of the key's path, one of the value, and the reason."""
WORDS = r"(^|\.)(warnings|notes|what|where|words|messages?|why|text|summary|reason|refused|description|next)(\.|$)"
"""Keys whose text may be worded anew; the numbers in it are compared still."""
DROPPED_TESTS: Mapping[str, str] = {
    r"^test_(all_is_complete|docstring_examples_run)\[cgwm\.": "named by the module, which has moved",
    r"^test_the_commands_exist\[": "named by a line of the README, which became pages",
    r"^test_(errors_and_exit_codes|the_outcome_is_said_plainly|the_page_has_the_numbers)\[": "by a reworded message",
    r"\[(.*-)?(triton|cuda)(-.*)?\]$": "the GPU renderer has one kind of kernels",
}
"""Tests (a pattern of their names) that this tree need not have, with the reason."""
DROPPED_ASSERTS = 0
"""Number of assert statements that went with those tests."""

REWORDED: Mapping[str, str] = {
    "mine.py": "the template of `effects new`: comments, and a parameter by keyword",
    "effects-new.stdout.txt": "its next step",
}
"""Files of words that were reworded; they are not compared."""

INPUTS = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import diagnosis_data, test_sg_gs, tiny_capture
from cgwm.datasets.scenes.hidden import cases, make_capture
root = Path(sys.argv[1])
tiny_capture.write_tiny_capture(root / "tiny")
tiny_capture.write_tiny_capture(root / "tracked")
tiny_capture.with_tracks(root / "tracked", tiny_capture.thrown())
tiny_capture.with_manifest(root / "tracked", "train = [\\"000\\"]", "train = [\\"000\\"]\\ntest = [\\"001\\"]")
tracks = root / "tracked" / "tracks"
(tracks / "001.csv").write_text((tracks / "000.csv").read_text())
test_sg_gs.make_capture(root / "photos")
every = {case.name: case for case in cases("development", nulls=4)}
wanted = ("/ball/quadratic_drag/large", "/cube/com_offset/large", "/cube/torsional_friction/large")
chosen = [next(c for n, c in every.items() if w in "/" + n) for w in wanted]
nulls = [c for n, c in every.items() if not c.effects]
chosen += [next(c for c in nulls if c.thing == thing) for thing in ("ball", "cube")]
from cgwm.datasets.scenes.hidden import UNKNOWN
chosen += [next(c for n, c in every.items() if c.effects == (UNKNOWN[0],) and "large" in n)]
for k, case in enumerate(chosen):
    make_capture(root / f"hidden{k}", case)
    (root / f"hidden{k}.truth.json").unlink()
"""
"""Makes the captures, with helpers of the reference's tests."""

FAST = (
    "--set phys-geo.step_s=0.003 --set phys-geo.population=8 --set phys-geo.generations=2 --set phys-geo.iterations=1"
)
PHOTOS = (
    "--set sg-gs.iterations=40 --set sg-gs.max_body_spheres=200 --set sg-gs.max_scene_spheres=400 "
    "--set sg-gs.max_collision_spheres=60 --set sg-gs.image_size=96 --set sg-gs.exposure=false"
)
HIDDEN = 6
COMMANDS: Sequence[tuple[str, str]] = (
    ("fit-tracks", f"fit {{in}}/tracked --stage phys-geo --from {{in}}/tracked-model {FAST} --out m-tracks --json"),
    (
        "fit-images",
        f"fit {{in}}/tiny --stage phys-geo --from {{in}}/tiny-model --supervise images {FAST} --out m-images --json",
    ),
    ("fit-photos", f"fit {{in}}/photos --stage sg-gs {PHOTOS} --out m-photos --json"),
    ("eval", "eval m-tracks {in}/tracked --json"),
    ("compare", "compare m-tracks {in}/tracked --out compare.html --json"),
    ("synthesize", "synthesize {in}/tracked-model --out ds --rollouts 8 --seed 3 --no-preview --json"),
    ("validate-capture", "validate {in}/tracked --json"),
    ("validate-model", "validate m-tracks --json"),
    ("validate-dataset", "validate ds --json"),
    ("export-mjcf", "export m-tracks --to mjcf --out model.xml --json"),
    ("export-nerfstudio", "export ds --to nerfstudio --out nerf --json"),
    ("effects-list", "effects list --json"),
    ("effects-show", "effects show quadratic_drag --json"),
    ("effects-new", "effects new mine.py"),
    *(
        line
        for k in range(HIDDEN)
        for line in (
            (f"fit-hidden{k}", f"fit {{in}}/hidden{k} --out h{k} --json"),
            (f"diagnose{k}", f"diagnose h{k} {{in}}/hidden{k} --json"),
        )
    ),
    ("eval-hidden0", "eval h0 {in}/hidden0 --json"),
)
"""Name and words of every command; `{in}` is the folder of the captures."""


def run(words: Sequence[str | Path], **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program, and say what it printed where it fails."""
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False, **options)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, words))}\nended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
    return done


def tree_of(commit: str | None, folder: Path) -> Path:
    """Write the files of a commit, or those of the working tree that git knows or would add, into a folder."""
    folder.mkdir(parents=True)
    if commit is not None:
        data = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=BytesIO(data)) as archive:
            archive.extractall(folder, filter="data")
        return folder
    names = run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT).stdout.splitlines()
    for name in names:
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    return folder


def installed(tree: Path, site: Path) -> dict[str, str]:
    """Install a tree into a folder as a wheel, and return the environment in which only that one is found."""
    wheels = site.with_name(site.name + "-wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", wheels, tree], cwd=tree)
    run([*pip, "install", "--no-deps", "--target", site, *wheels.glob("*.whl")])
    environment = os.environ | {
        "PYTHONPATH": str(site),
        "PYTHONSAFEPATH": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "200",
        "NO_COLOR": "1",
    }
    code = "import cgwm, cgwm.pipeline; print(cgwm.__file__); print(cgwm.pipeline.__path__[0])"
    places = run([sys.executable, "-c", code], env=environment, cwd=wheels).stdout.split()
    if not all(Path(place).is_relative_to(site) for place in places):
        sys.exit(f"cgwm was imported from {places}, not from {site}")
    return environment


def outputs(environment: Mapping[str, str], inputs: Path, folder: Path) -> None:
    """Run all commands in a folder that they leave their outputs in."""
    folder.mkdir(parents=True)
    for name, line in COMMANDS:
        begin = time.monotonic()
        words = [word.replace("{in}", str(inputs)) for word in line.split()]
        done = subprocess.run(
            [sys.executable, "-m", "cgwm", *words],
            cwd=folder,
            env=dict(environment),
            capture_output=True,
            text=True,
            check=False,
        )
        suffix = "json" if "--json" in words and done.stdout.strip() else "txt"
        (folder / f"{name}.stdout.{suffix}").write_text(done.stdout)
        (folder / f"{name}.code.txt").write_text(f"{done.returncode}\n")
        if done.returncode:
            (folder / f"{name}.stderr.log").write_text(done.stderr)
        print(f"  {name}: exit code {done.returncode}, {time.monotonic() - begin:.1f} s", flush=True)
    (folder / "options.txt").write_text("\n".join(option_lines(environment, folder)) + "\n")


def option_lines(environment: Mapping[str, str], folder: Path) -> list[str]:
    """Return every verb with its options, types and defaults, as the command line declares them; no help texts."""
    code = (
        "from typer.main import get_command; from cgwm.cli.app import app\n"
        "def show(command, name):\n"
        "    for p in command.params:\n"
        "        print(name, sorted(p.opts + p.secondary_opts), p.required, p.default)\n"
        "    for n, c in sorted(getattr(command, 'commands', {}).items()): show(c, f'{name} {n}')\n"
        "show(get_command(app), 'cgwm')"
    )
    return run([sys.executable, "-c", code], env=dict(environment), cwd=folder).stdout.splitlines()


def tests_of(tree: Path, environment: Mapping[str, str]) -> tuple[Counter[str], int]:
    """Return the tests of a tree by function and parameters, without their files, and the number of asserts."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "evidence or not evidence", "tests"],
        cwd=tree, env=dict(environment) | {"PYTHONSAFEPATH": "1"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    names = [line.split("::", 1)[1] for line in done.stdout.splitlines() if "::" in line]
    if done.returncode or not names:
        sys.exit(f"tests of {tree} were not collected:\n{done.stdout[-3000:]}{done.stderr[-3000:]}")
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (tree / "tests").rglob("*.py")]
    return Counter(names), sum(isinstance(node, ast.Assert) for one in trees for node in ast.walk(one))


class Differences:
    """What differs between two outputs: lines to print, and how many exceed the rounding that is allowed."""

    def __init__(self, rounding: float) -> None:
        self.rounding, self.lines, self.masked, self.failed = rounding, [], Counter(), 0

    def add(self, where: str, one: object, other: object) -> None:
        """Note a difference; numbers within the rounding are named and pass."""
        note = ""
        if isinstance(one, int | float) and isinstance(other, int | float) and not isinstance(one, bool):
            relative = abs(one - other) / max(abs(one), abs(other), 1e-300)
            note = f" (relative {relative:.2e})"
            if relative <= self.rounding:
                self.lines.append(f"rounding: {where}: {one!r} -> {other!r}{note}")
                return
        self.failed += 1
        self.lines.append(f"{where}: {str(one)[:160]!r} -> {str(other)[:160]!r}{note}")

    def values(self, where: str, key: str, one: Any, other: Any) -> None:
        """Compare two JSON values."""
        for pattern, value, reason in MASKS:
            if re.search(pattern, key) and not isinstance(one, dict | list) and re.fullmatch(value, str(one), re.S):
                self.masked[reason] += one != other
                return
        if isinstance(one, dict) and isinstance(other, dict):
            for name in sorted({*one, *other}):
                if name in one and name in other:
                    self.values(where, f"{key}.{name}", one[name], other[name])
                else:
                    self.add(f"{where} {key}.{name}", one.get(name, "absent"), other.get(name, "absent"))
        elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
            for k, (a, b) in enumerate(zip(one, other, strict=True)):
                self.values(where, f"{key}.{k}", a, b)
        elif isinstance(one, str) and isinstance(other, str) and (re.search(WORDS, key) or " " in one.strip()):
            numbers = [re.findall(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", text) for text in (one, other)]
            if numbers[0] != numbers[1] and "/" not in one:
                self.add(f"{where} {key} (numbers in the text)", one, other)
        elif one != other and not (one is other or (_is_nan(one) and _is_nan(other))):
            self.add(f"{where} {key}", one, other)

    def files(self, one: Path, other: Path, where: str) -> None:
        """Compare two files by what their kind says."""
        if one.suffix == ".json":
            self.values(where, "", json.loads(one.read_text()), json.loads(other.read_text()))
        elif one.suffix == ".h5":
            self.arrays(one, other, where)
        elif one.suffix in (".html", ".log"):
            self.masked["pages and messages: their words are not compared"] += one.read_bytes() != other.read_bytes()
        elif one.suffix in (".txt", ".xml", ".toml"):
            texts = [re.sub(r"(/[\w.+-]+)+", "PATH", path.read_text()) for path in (one, other)]
            if texts[0] != texts[1]:
                pairs = list(zip(texts[0].splitlines(), texts[1].splitlines(), strict=False))
                self.add(where, *next((p for p in pairs if p[0] != p[1]), (len(texts[0]), str(len(texts[1])))))
        elif one.read_bytes() != other.read_bytes():
            self.add(where, f"{one.stat().st_size} bytes", f"{other.stat().st_size} bytes, other content")

    def arrays(self, one: Path, other: Path, where: str) -> None:
        """Compare all arrays, types and attributes of two HDF5 files."""
        import h5py
        import hdf5plugin  # noqa: F401  reads zstd
        import numpy as np

        def plain(value: Any) -> Any:
            if isinstance(value, bytes):
                value = value.decode()
            if isinstance(value, str) and value[:1] in "{[":
                return json.loads(value)
            return value.tolist() if hasattr(value, "tolist") else value

        with h5py.File(one) as first, h5py.File(other) as second:
            names: list[list[str]] = [[], []]
            for file, found in zip((first, second), names, strict=True):
                file.visit(found.append)
            if names[0] != names[1]:
                self.add(where, sorted({*names[0]} - {*names[1]}), sorted({*names[1]} - {*names[0]}))
                return
            for name in ["/", *names[0]]:
                a, b = first[name], second[name]
                attributes = [{key: plain(node.attrs[key]) for key in node.attrs} for node in (a, b)]
                self.values(f"{where}:{name}", "", *attributes)
                if isinstance(a, h5py.Dataset) and isinstance(b, h5py.Dataset):
                    if a.dtype != b.dtype or a.shape != b.shape:
                        self.add(f"{where}:{name}", f"{a.dtype} {a.shape}", f"{b.dtype} {b.shape}")
                    elif a.dtype.kind in "fiub":
                        x, y = np.asarray(a[()]), np.asarray(b[()])
                        if x.tobytes() != y.tobytes():
                            gap = float(np.abs(np.asarray(x, float) - np.asarray(y, float)).max())
                            scale = max(float(np.abs(np.asarray(x, float)).max()), 1e-300)
                            self.add(f"{where}:{name}", scale, scale + gap)
                    elif a.dtype.kind == "O":
                        values = [[plain(v) for v in np.ravel(node[()])] for node in (a, b)]
                        self.values(f"{where}:{name}", name.replace("/", "."), *values)
                    elif a[()].tobytes() != b[()].tobytes():
                        self.add(f"{where}:{name}", "array", "other content")


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def files_in(folder: Path) -> Iterator[str]:
    """Yield the relative paths of all files, sorted."""
    yield from sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def key_of(commit: str) -> str:
    """Return what reference outputs depend on: the commit, this script's commands, and the installed packages."""
    packages = run([sys.executable, "-m", "pip", "--disable-pip-version-check", "freeze", "--exclude-editable"]).stdout
    text = "\n".join([commit, INPUTS, repr(COMMANDS), packages])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def main() -> int:
    """Make what is missing of the reference, run this tree, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", default=REFERENCE, help="commit whose outputs count")
    parser.add_argument("--candidate", help="commit to compare (default: the working tree)")
    parser.add_argument("--rounding", type=float, default=0.0, help="relative difference of numbers that passes, named")
    parser.add_argument("--only-tests", action="store_true", help="compare the tests alone")
    chosen = parser.parse_args()
    commit = run(["git", "rev-parse", chosen.reference], cwd=ROOT).stdout.strip()
    reference = BUILD / f"reference-{key_of(commit)}"
    if not (reference / "done").exists():
        shutil.rmtree(reference, ignore_errors=True)
        print(f"making the reference outputs of {commit[:7]}")
        tree = tree_of(commit, reference / "tree")
        environment = installed(tree, reference / "site")
        (reference / "in").mkdir()
        run([sys.executable, "-c", INPUTS, reference / "in", tree / "tests"], env=environment, cwd=reference)
        outputs(environment, reference / "in", reference / "out")
        names, asserts = tests_of(tree, environment)
        (reference / "tests.json").write_text(json.dumps([dict(names), asserts]))
        (reference / "done").touch()
    candidate = BUILD / "candidate"
    shutil.rmtree(candidate, ignore_errors=True)
    print(f"running {chosen.candidate or 'the working tree'}")
    tree = tree_of(chosen.candidate, candidate / "tree")
    environment = installed(tree, candidate / "site")
    found = Differences(chosen.rounding)
    if not chosen.only_tests:
        outputs(environment, reference / "in", candidate / "out")
        names = [set(files_in(folder / "out")) for folder in (reference, candidate)]
        for name in sorted(names[0] ^ names[1]):
            found.add(name, name in names[0], name in names[1])
        for name in sorted((names[0] & names[1]) - set(REWORDED)):
            found.files(reference / "out" / name, candidate / "out" / name, name)
        print(f"compared {len(names[0] & names[1])} files")
    expected, asserts = json.loads((reference / "tests.json").read_text())
    here, here_asserts = tests_of(tree, environment)
    lost = {name: n for name, n in (Counter(expected) - here).items()}
    for name in lost:
        if not any(re.search(pattern, name) for pattern in DROPPED_TESTS):
            found.add(f"test {name}", "there", "gone")
    if here_asserts < asserts - DROPPED_ASSERTS:
        found.add("assert statements in tests", asserts, here_asserts - 0.5)
    print(f"tests: {sum(expected.values())} -> {sum(here.values())}, asserts: {asserts} -> {here_asserts}")
    for reason, count in found.masked.items():
        print(f"masked: {count} differ: {reason}")
    print(*found.lines, sep="\n")
    print("different: " + str(found.failed) if found.failed else "equal")
    return 1 if found.failed else 0


if __name__ == "__main__":
    sys.exit(main())

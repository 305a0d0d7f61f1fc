"""Compare what this tree computes with what a reference commit computes: `make same`.

For a change that moves, renames or splits code and changes no number. Both trees are built as wheels and installed
into separate folders. The same commands run on the same small captures, on the CPU, in an empty folder where neither
source tree can be imported. Everything that they write is compared:

- JSON key by key and HDF5 array by array, exactly;
- text files and HTML pages line by line and element by element, exactly, style sheets and scripts included;
- other files by byte.

`MASKS` and `FOLDERS` name the parts of values that may differ; the report counts what each of these let pass. Three
checks need no outputs: no test of the reference may be missing, no function of the tests may have lost a check, and the
wheel of this tree has exactly the files of its packages.

The reference is the last commit; `--reference` names another. Outputs are kept in `build/same/`. Those of the reference
are made again when the reference or an installed package changes; `--again` compares the kept outputs of the last run
without running anything.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BUILD = ROOT / "build" / "same"
REFERENCE = "HEAD"
"""Commit whose outputs count, where no other is named."""

MASKS: Sequence[tuple[str, str, str]] = (
    (r"\.json.*\.(seconds|seconds_by_step\.\w+|frames_per_s)$", r"[\d.e+-]+", "wall times"),
    (r"\.cgwm-output\.json\.files\.", r"^[0-9a-f]{64}$", "hashes of files, which are compared themselves"),
    (r"\.(cgwm|creator)$", r"\d+(\.\d+)*\S*", "the version of cgwm itself"),
)
"""Parts of values that may differ: a pattern of the place (file and key), one of the part of its text, the reason."""
FOLDERS = (
    r"((/[\w.+-]+)*/build/same/|(\.\./)+)(reference-\w+/|candidate/)?(?=(in|out|site)/)",
    "the folder in which a tree ran: the rest of the path is compared",
)
"""Part that may differ in every text, and the reason."""

INPUTS = """
import sys
from pathlib import Path
tests = Path(sys.argv[2])
sys.path[:0] = [str(tests), str(tests.parent / "benchmarks"), str(tests / "pipeline" / "sg_gs")]
import test_sg_gs
from helpers import tiny_capture
from hidden_effects import UNKNOWN, cases, make_capture
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
chosen += [next(c for n, c in every.items() if c.effects == (UNKNOWN[0],) and "large" in n)]
for k, case in enumerate(chosen):
    make_capture(root / f"hidden{k}", case)
    (root / f"hidden{k}.truth.json").unlink()
"""
"""Makes the captures, with helpers of the reference's tests and benchmarks."""

FAST = (
    "--set phys-geo.step_s=0.003 --set phys-geo.population=8 --set phys-geo.generations=2 --set phys-geo.iterations=1"
)
PHOTOS = (
    "--set sg-gs.iterations=40 --set sg-gs.max_body_spheres=200 --set sg-gs.max_scene_spheres=400 "
    "--set sg-gs.max_collision_spheres=60 --set sg-gs.image_size=96 --set sg-gs.exposure=false"
)
HIDDEN = 6
ENVIRONMENT: Mapping[str, str] = {
    "CUDA_VISIBLE_DEVICES": "",  # the CPU's results repeat to the byte
    "PYTHONSAFEPATH": "1",
    "PYTHONDONTWRITEBYTECODE": "1",
    "OMP_NUM_THREADS": "1",
    "COLUMNS": "200",
    "NO_COLOR": "1",
}
"""Environment variables of every command."""
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
    wheels = site.with_name("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    run([*pip, "wheel", "--no-index", "--no-deps", "--no-build-isolation", "-w", wheels, tree], cwd=tree)
    run([*pip, "install", "--no-index", "--no-deps", "--target", site, *wheels.glob("*.whl")])
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": str(site)}
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
        side = folder.parent.name.partition("-")[0]
        print(f"  {side} {name}: exit code {done.returncode}, {time.monotonic() - begin:.1f} s", flush=True)
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


def tests_of(tree: Path, environment: Mapping[str, str]) -> list[str]:
    """Return the tests of a tree by function and parameters, without their files."""
    words = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "evidence or not evidence", "tests"]
    lines = run(words, cwd=tree, env=dict(environment)).stdout.splitlines()
    return [line.split("::", 1)[1] for line in lines if "::" in line]


def checks_of(tree: Path) -> Counter[str]:
    """Return the number of assert statements and calls of checks (`raises`, `assert_*`) by function of the tests."""
    found: Counter[str] = Counter()
    for path in (tree / "tests").rglob("*.py"):
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(function, ast.FunctionDef):
                for node in ast.walk(function):
                    name = ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""
                    check = isinstance(node, ast.Assert) or name in ("raises", "warns") or name.startswith("assert_")
                    found[function.name] += check
    return found


class Differences:
    """Differences of two runs: lines to print, what was let pass with its reason, and the number that fail."""

    def __init__(self, rounding: float) -> None:
        self.rounding, self.lines, self.failed = rounding, [], 0
        self.passed = Counter({f"masked: {reason}": 0 for *_, reason in (*MASKS, FOLDERS)})

    def add(self, place: str, one: Any, other: Any) -> None:
        """Add a difference; numbers within the rounding are printed and pass."""
        note = ""
        if _is_number(one) and _is_number(other):
            relative = abs(one - other) / max(abs(one), abs(other), 1e-300)
            note = f" (relative {relative:.2e})"
            if relative < self.rounding:
                self.lines.append(f"rounding: {place}: {one!r} -> {other!r}{note}")
                return
        self.failed += 1
        texts = [str(one), str(other)]
        equal = next((k for k, (a, b) in enumerate(zip(*texts, strict=False)) if a != b), 0)
        begin = max(equal - 80, 0)  # long texts are printed around their first difference
        self.lines.append(f"{place}: {' -> '.join(repr(text[begin : begin + 160]) for text in texts)}{note}")

    def values(self, place: str, one: Any, other: Any) -> None:
        """Compare two JSON values."""
        if isinstance(one, dict) and isinstance(other, dict):
            for name in sorted({*one, *other}):
                if name in one and name in other:
                    self.values(f"{place}.{name}", one[name], other[name])
                else:
                    self.add(f"{place}.{name}", one.get(name, "absent"), other.get(name, "absent"))
        elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
            for k, (a, b) in enumerate(zip(one, other, strict=True)):
                self.values(f"{place}.{k}", a, b)
        else:
            self.scalars(place, one, other)

    def scalars(self, place: str, one: Any, other: Any) -> None:
        """Compare two values of JSON that are not compared part by part."""
        if type(one) is not type(other):
            if not (_is_number(one) and _is_number(other) and one == other):  # 1.0 and 1 are one number in JSON
                self.add(place, one, other)
        elif repr(one) != repr(other):  # NaN equals NaN, and 0 differs from -0
            for pattern, part, reason in MASKS:
                if re.search(pattern, place) and re.sub(part, "", str(one)) == re.sub(part, "", str(other)):
                    self.passed[f"masked: {reason}"] += 1
                    return
            if isinstance(one, str) and isinstance(other, str):
                self.words(place, one, other)
            else:
                self.add(place, one, other)

    def words(self, place: str, one: str, other: str) -> None:
        """Compare two texts but for the folders in their paths."""
        if one == other:
            return
        one, other = (re.sub(FOLDERS[0], "", text) for text in (one, other))
        if one == other:
            self.passed[f"masked: {FOLDERS[1]}"] += 1
            return
        self.add(place, one, other)

    def files(self, place: str, one: Path, other: Path) -> None:
        """Compare two files by what their kind says."""
        if one.suffix == ".h5":
            self.arrays(place, one, other)
            return
        if one.read_bytes() == other.read_bytes():
            return
        if one.suffix not in (".json", ".html", ".py", ".txt", ".xml", ".log"):
            self.add(place, f"{one.stat().st_size} bytes", f"{other.stat().st_size} bytes, other content")
            return
        texts = [path.read_text(encoding="utf-8") for path in (one, other)]
        if one.suffix == ".json":
            self.values(place, *map(json.loads, texts))
        elif one.suffix == ".html":
            self.pages(place, *texts)
        elif one.suffix == ".py":
            self.words(f"{place} code", *map(code_of, texts))
        else:
            self.lists(f"{place} line", *(text.splitlines() for text in texts))

    def pages(self, place: str, one: str, other: str) -> None:
        """Compare two HTML pages: tags with their attributes, texts, style sheets, scripts, and data as JSON."""
        data = [re.findall(r'<script type="application/json"[^>]*>(.*?)</script>', page, re.S) for page in (one, other)]
        self.values(f"{place} data", *([json.loads(text) for text in texts] for texts in data))
        parts = [
            re.split(r"(<style.*?</style>|<script.*?</script>|<[^>]*>)", page, flags=re.S) for page in (one, other)
        ]
        tags = [[_without_comments(tag) for tag in part[1::2] if "application/json" not in tag] for part in parts]
        self.lists(f"{place} tag", *tags)
        for tag, a, b in zip(parts[0][1::2], parts[0][2::2], parts[1][2::2], strict=False):
            self.words(f"{place} text in {tag[:40]}", a, b)

    def lists(self, place: str, one: Sequence[str], other: Sequence[str]) -> None:
        """Compare two lists of texts."""
        if len(one) != len(other):
            self.add(f"{place}s, number", len(one), len(other))
        for k, (a, b) in enumerate(zip(one, other, strict=False)):
            self.words(f"{place} {k + 1}", a, b)

    def arrays(self, place: str, one: Path, other: Path) -> None:
        """Compare all arrays, types and attributes of two HDF5 files."""
        import h5py
        import hdf5plugin  # noqa: F401  reads zstd
        import numpy as np

        def plain(value: Any) -> Any:
            if isinstance(value, bytes):
                value = value.decode()
            if isinstance(value, str):
                return json.loads(value) if value[:1] in ("{", "[") else value
            return value.tolist() if hasattr(value, "tolist") else value

        with h5py.File(one) as first, h5py.File(other) as second:
            names: list[list[str]] = [[], []]
            for file, found in zip((first, second), names, strict=True):
                file.visit(found.append)
            if names[0] != names[1]:
                self.add(place, sorted({*names[0]} - {*names[1]}), sorted({*names[1]} - {*names[0]}))
                return
            for name in ["/", *names[0]]:
                a, b, where = first[name], second[name], f"{place}:{name}"
                attributes = [{key: plain(node.attrs[key]) for key in node.attrs} for node in (a, b)]
                self.values(where, *attributes)
                if not (isinstance(a, h5py.Dataset) and isinstance(b, h5py.Dataset)):
                    if type(a) is not type(b):
                        self.add(where, type(a).__name__, type(b).__name__)
                elif a.dtype != b.dtype or a.shape != b.shape:
                    self.add(where, f"{a.dtype} {a.shape}", f"{b.dtype} {b.shape}")
                elif a.dtype.kind == "O":
                    self.values(where, *([plain(value) for value in np.ravel(node[()])] for node in (a, b)))
                elif (x := np.asarray(a[()])).tobytes() != (y := np.asarray(b[()])).tobytes():
                    if a.dtype.kind not in "fiub":
                        self.add(where, "array", "other content")
                    else:
                        gap = float(np.abs(x.astype(float) - y.astype(float)).max())
                        scale = max(float(np.abs(x.astype(float)).max()), 1e-300)
                        self.add(f"{where}, largest number and with the largest difference", scale, scale + gap)

    def names(self, kind: str, reference: Mapping[str, int], here: Mapping[str, int]) -> None:
        """Compare how often names occur: none may occur less often."""
        for name, count in reference.items():
            if here.get(name, 0) < count:
                self.add(f"{kind} {name}", f"{count}", f"{here.get(name, 0)}")

    def wheel(self, tree: Path, wheel: Path) -> None:
        """Compare the files of a wheel with those of the packages' folders in the source tree: each once, no others."""
        folders = tomllib.loads((tree / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"]
        source = {
            f"{package.replace('.', '/')}/{path.relative_to(tree / folder).as_posix()}": path.read_bytes()
            for package, folder in folders.items()
            for path in (tree / folder).rglob("*")
            if path.is_file() and path.suffix != ".pyc"
        }
        with zipfile.ZipFile(wheel) as archive:
            packed = {name: archive.read(name) for name in archive.namelist() if ".dist-info/" not in name}
        for name in sorted(source.keys() | packed.keys()):
            if source.get(name) != packed.get(name):
                sizes = [f"{len(files[name])} bytes" if name in files else "absent" for files in (source, packed)]
                self.add(f"wheel {name} (source, wheel)", *sizes)
        print(f"wheel: {len(packed)} files, {sum(not name.endswith('.py') for name in packed)} of them data")


def code_of(text: str) -> str:
    """Return Python code without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def files_in(folder: Path) -> Iterator[str]:
    """Yield the relative paths of all files, sorted."""
    yield from sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def key_of(commit: str) -> str:
    """Return what reference outputs depend on: the commit, this script's commands, and the installed packages."""
    packages = run([sys.executable, "-m", "pip", "--disable-pip-version-check", "freeze", "--exclude-editable"]).stdout
    text = "\n".join([commit, INPUTS, repr(COMMANDS), repr(ENVIRONMENT), packages])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def prepared(commit: str | None, folder: Path) -> dict[str, str]:
    """Install a commit into a new folder, list its tests there, and return the environment of its commands."""
    shutil.rmtree(folder, ignore_errors=True)
    tree = tree_of(commit, folder / "tree")
    environment = installed(tree, folder / "site")
    (folder / "tests.json").write_text(json.dumps(tests_of(tree, environment)))
    return environment


def make(commit: str, reference: Path, other: str | None, candidate: Path, *, only_tests: bool) -> None:
    """Write the outputs and tests of the reference, unless they are there, and of the candidate into their folders."""
    inputs, work = reference / "in", []
    if not (reference / "done").exists():
        environment = prepared(commit, reference)
        inputs.mkdir()
        run([sys.executable, "-c", INPUTS, inputs, reference / "tree" / "tests"], env=environment, cwd=reference)
        work.append((reference, environment))
    environment = prepared(other, candidate)
    if not only_tests:
        work.append((candidate, environment))
    with ThreadPoolExecutor() as pool:
        for _ in pool.map(lambda one: outputs(one[1], inputs, one[0] / "out"), work):
            pass
    for folder in (reference, candidate):
        (folder / "done").touch()


def _without_comments(tag: str) -> str:
    """Return an element without the comments of a script at the ends of its lines."""
    return re.sub(r"(?m)\s+// .*$", "", tag) if tag.startswith("<script") else tag


def main() -> int:
    """Make what is missing of the reference, run this tree, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", default=REFERENCE, help="commit whose outputs count")
    parser.add_argument("--candidate", help="commit to compare (default: the working tree)")
    parser.add_argument("--rounding", type=float, default=0.0, help="relative difference of numbers that passes, named")
    parser.add_argument("--only-tests", action="store_true", help="compare the tests and the wheel alone")
    parser.add_argument("--again", action="store_true", help="compare the kept outputs of the last run; run nothing")
    chosen = parser.parse_args()
    commit = run(["git", "rev-parse", chosen.reference], cwd=ROOT).stdout.strip()
    reference, candidate = BUILD / f"reference-{key_of(commit)}", BUILD / "candidate"
    if not chosen.again:
        make(commit, reference, chosen.candidate, candidate, only_tests=chosen.only_tests)
    elif not all((folder / "done").exists() for folder in (reference, candidate)):
        parser.error("--again: no finished run is kept in build/same")
    found = Differences(chosen.rounding)
    if (candidate / "out").exists():
        names = [set(files_in(folder / "out")) for folder in (reference, candidate)]
        for name in sorted(names[0] ^ names[1]):
            found.add(name, name in names[0], name in names[1])
        for name in sorted(names[0] & names[1]):
            found.files(name, reference / "out" / name, candidate / "out" / name)
        print(f"compared {len(names[0] & names[1])} files")
    tests, functions, checks = [], [], []
    for folder in (reference, candidate):
        tests.append(Counter(json.loads((folder / "tests.json").read_text())))
        functions.append(dict.fromkeys((name.partition("[")[0] for name in tests[-1]), 1))
        checks.append(checks_of(folder / "tree"))
    found.names("test", tests[0], tests[1])
    found.names("test function", functions[0], functions[1])
    found.names("checks in", checks[0], checks[1])
    for kind, counts in (("tests", tests), ("checks in the functions of tests", checks)):
        print(f"{kind}: {counts[0].total()} -> {counts[1].total()}")
    found.wheel(candidate / "tree", next((candidate / "wheel").glob("*.whl")))
    for reason, count in found.passed.items():
        print(f"{count} pass, {reason}")
    for line in found.lines:
        print(line)
    print(f"different: {found.failed}" if found.failed else "equal")
    return 1 if found.failed else 0


if __name__ == "__main__":
    sys.exit(main())

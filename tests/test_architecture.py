"""Laws of the source itself: one-way imports, nothing that executes a stranger's data, text that is run."""

import ast
import doctest
import gc
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from cgwm.pipeline.runtime.doctor import satisfies

import cgwm

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))
import import_graph  # noqa: E402  the tool behind 'make graph'

ROOMS = {"schemas": "schemas", "datasets": "datasets", "pipeline": "pipeline", "cli": "cgwm_cli"}
ORDER = list(ROOMS)
HEAVY = ("torch", "numpy", "scipy", "mujoco", "h5py", "hdf5plugin", "pycolmap", "cv2", "matplotlib", "tqdm", "pydantic")
FILES = sorted(path for folder in ROOMS.values() for path in (ROOT / folder).rglob("*.py"))


def module_name(path: Path) -> str:
    """Return the import name of a source file, `cgwm.<room>...`."""
    folder, *rest = path.relative_to(ROOT).with_suffix("").parts
    room = next(room for room, name in ROOMS.items() if name == folder)
    return ".".join(["cgwm", room, *(part for part in rest if part != "__init__")])


@cache
def nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(import_graph.parsed(path)))


@cache
def import_edges() -> list[import_graph.Import]:
    return import_graph.imports(import_graph.modules())


@pytest.fixture(scope="module", autouse=True)
def trees() -> Iterator[None]:
    """Keep 840,000 nodes of syntax trees while these tests run: Python would look through all of them many times."""
    gc.disable()
    yield
    for kept in (nodes, calls, import_edges, import_graph.parsed):
        kept.cache_clear()
    gc.enable()


def imports(path: Path, *, top_level: bool = False) -> Iterator[tuple[int, str]]:
    """Yield line and absolute name of all that a file imports; `TYPE_CHECKING` blocks count as well."""
    tree = import_graph.parsed(path)
    package = module_name(path) if path.name == "__init__.py" else module_name(path).rpartition(".")[0]
    for node in tree.body if top_level else nodes(path):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            target = ".".join(part for part in (base, node.module) if part)
            yield node.lineno, target
            yield from ((node.lineno, f"{target}.{alias.name}") for alias in node.names)


@cache
def calls(path: Path) -> list[tuple[ast.Call, str]]:
    """Return every call in a file with the dotted name of what is called."""
    return [(node, ast.unparse(node.func)) for node in nodes(path) if isinstance(node, ast.Call)]


def place(path: Path, line: int) -> str:
    return f"{path.relative_to(ROOT)}:{line}"


def test_imports_run_one_way() -> None:
    wrong = []
    for path in FILES:
        room = ORDER.index(module_name(path).split(".")[1])
        for line, name in imports(path):
            parts = name.split(".")
            if parts[0] == "cgwm" and len(parts) > 1 and parts[1] in ORDER and ORDER.index(parts[1]) > room:
                wrong.append(f"{place(path, line)} imports {name}")
    assert wrong == []


ABOUT_INPUT = ("InputDataError", "UsageError", "DamagedShardError")


def test_every_error_about_an_input_says_what_is_allowed_or_what_to_do_next() -> None:
    bare = [
        place(path, node.lineno)
        for path in FILES
        for node, name in calls(path)
        if name in ABOUT_INPUT and len(node.args) + len(node.keywords) < 2
        if not any(isinstance(argument, ast.Starred) for argument in node.args)
    ]
    assert bare == []


def test_rooms_import_lower_floors_only() -> None:
    assert import_graph.upward(import_edges(), import_graph.modules()) == []


@pytest.mark.parametrize("level", ["modules", "rooms"])
def test_imports_form_no_circles(level: str) -> None:
    assert import_graph.circles(import_edges(), level) == []


def test_an_upward_import_is_found_with_both_floors() -> None:
    found = import_graph.modules()
    wrong = import_graph.Import("pipeline.segments.prepare", "pipeline.diagnose.verdict", 7, types_only=False)
    assert import_graph.upward([wrong], found) == [
        "pipeline/segments/prepare.py:7 (floor 3) imports pipeline.diagnose.verdict (floor 4)"
    ]
    back = import_graph.Import("pipeline.diagnose.verdict", "pipeline.segments.prepare", 7, types_only=False)
    assert import_graph.circles([wrong, back]) == [[wrong.source, wrong.target][::-1]]


def test_diagnose_reaches_a_part_of_the_pipeline() -> None:
    """Counted in lines: to divide a module makes nobody read more."""
    found = import_graph.modules()
    reached = import_graph.reach(import_edges(), "cli.diagnose")
    assert sum(len(found[name].read_text(encoding="utf-8").splitlines()) for name in reached) <= 36_200


def test_every_message_to_a_user_says_what_to_do_next() -> None:
    spoken = {"InputDataError", "UsageError", "NotConvergedError", "NotEnoughMemoryError", "NotEnoughSpaceError"}
    wrong = [
        place(path, call.lineno)
        for path in FILES
        for call in nodes(path)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in spoken
        if len(call.args) < 3 and not any(isinstance(one, ast.Starred) for one in call.args)
        if "todo" not in {word.arg for word in call.keywords}
    ]
    assert wrong == []


def test_the_rooms_import_each_other_relatively() -> None:
    # "import datasets" would find another package of that name in many environments.
    wrong = [
        place(path, node.lineno)
        for path in FILES
        for node in nodes(path)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom) and not node.level
            else []
        )
        if name.split(".")[0] in {"cgwm", *ROOMS.values()}
    ]
    assert wrong == []


def test_the_command_line_imports_nothing_heavy_at_module_level() -> None:
    wrong = [
        f"{place(path, line)} imports {name}"
        for path in sorted((ROOT / "cgwm_cli").rglob("*.py"))
        for line, name in imports(path, top_level=True)
        if name.split(".")[0] in HEAVY or (name.startswith("cgwm.") and not name.startswith("cgwm.cli"))
    ]
    assert wrong == []


def test_one_room_alone_speaks_to_colmap() -> None:
    users = {
        path.relative_to(ROOT).parent.as_posix() for path in FILES for _, name in imports(path) if name == "pycolmap"
    }
    assert users == {"pipeline/calibrate/colmap"}


def is_unsafe(call: ast.Call, name: str) -> bool:
    """Tell whether a call executes, or may execute, what a file says."""
    keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
    return (
        name in {"eval", "exec", "compile", "os.system", "torch.save"}
        or name.endswith("yaml.load")
        or (name == "torch.load" and keywords.get("weights_only") != "True")
        or keywords.get("allow_pickle", "False") != "False"
        or keywords.get("shell", "False") != "False"
    )


RUNS_EFFECTS = "pipeline/physics/effects/registry.py"
"""The only module that runs a file: that of a custom effect, after consent (test_trust)."""


def test_nothing_is_unpickled_executed_or_fetched() -> None:
    forbidden = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal", "requests", "httpx"}
    forbidden |= {"urllib.request", "http.client", "ftplib"}
    wrong = []
    for path in FILES:
        wrong += [place(path, line) for line, name in imports(path) if name in forbidden]
        allowed = {"exec", "compile"} if place(path, 0).startswith(RUNS_EFFECTS) else set()
        wrong += [
            f"{place(path, call.lineno)} calls {name}"
            for call, name in calls(path)
            if is_unsafe(call, name) and name not in allowed
        ]
    assert wrong == []


@pytest.mark.parametrize(
    "source",
    ["eval(text)", "torch.load(path)", "torch.load(path, weights_only=False)", "np.load(x, allow_pickle=1)"],
)
def test_the_search_for_unsafe_calls_finds_them(source: str) -> None:
    call = ast.parse(source, mode="eval").body
    assert isinstance(call, ast.Call)
    assert is_unsafe(call, ast.unparse(call.func))


def test_only_the_command_line_prints_on_stdout() -> None:
    wrong = [
        place(path, call.lineno)
        for path in FILES
        if "cgwm_cli" not in path.parts
        for call, name in calls(path)
        if name == "print" and "file" not in {keyword.arg for keyword in call.keywords}
    ]
    assert wrong == []


@pytest.mark.parametrize("path", [path for path in FILES if path.name == "__init__.py"], ids=module_name)
def test_all_is_complete(path: Path) -> None:
    module = importlib.import_module(module_name(path))
    tree = import_graph.parsed(path)
    exported = getattr(module, "__all__", [])
    assert [name for name in exported if not hasattr(module, name)] == []
    assert len(exported) == len(set(exported))
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    assert sorted(name for name in defined - set(exported) if not name.startswith("_")) == []


def test_public_names_of_the_package() -> None:
    assert set(cgwm.__all__) == {"__version__", *cgwm._PUBLIC}
    assert [name for name in cgwm.__all__ if getattr(cgwm, name, None) is None] == []
    with pytest.raises(AttributeError, match="module 'cgwm' has no attribute 'nothing'"):
        _ = cgwm.nothing


def test_every_package_is_installed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = {"cgwm", *(module_name(path) for path in FILES if path.name == "__init__.py")}
    assert set(project["tool"]["setuptools"]["packages"]) == packages
    assert {path.parent for path in FILES} == {path.parent for path in FILES if path.name == "__init__.py"}


def test_every_requirement_is_pinned_to_a_version_that_it_admits() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = dict(line.split("==") for line in lines)
    for requirement in project["dependencies"] + project["optional-dependencies"]["dev"]:
        name = re.split(r"[<>=\[]", requirement)[0]
        assert satisfies(pins[name], requirement), requirement


def test_reading_data_does_not_import_torch() -> None:
    code = (
        "import sys, cgwm.datasets, cgwm.datasets.capture, cgwm.datasets.models, cgwm.schemas; "
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    "path", [path for path in FILES if ">>> " in path.read_text(encoding="utf-8")], ids=module_name
)
def test_docstring_examples_run(path: Path) -> None:
    outcome = doctest.testmod(importlib.import_module(module_name(path)))
    assert outcome.attempted > 0
    assert outcome.failed == 0

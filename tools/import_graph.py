"""Print the import graph of the rooms, check its direction and draw it: `make graph`.

A room is a folder (or a chain's file) of `pipeline/` or `datasets/`. A room may import rooms of lower floors only.
Counted are all imports: absolute and relative, at the top of a file and inside functions, and those for types alone.
Importing a module also executes the `__init__` of each package around it, which the reach of a command includes.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"schemas": "schemas", "datasets": "datasets", "pipeline": "pipeline", "cgwm_cli": "cli"}
"""Folders of the source tree and the names that they have inside the package `cgwm`."""

PIPELINE: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("kernels", ("runtime", "geometry", "optimization", "report", "foreground")),
    ("kernels", ("physics", "rendering")),
    ("kernels", ("trajectories",)),
    ("kernels", ("segments",)),
    ("stages", ("mask", "calibrate", "sg_gs", "synthesize", "diagnose", "validate")),
    ("stages", ("phys_geo", "view", "export")),
    ("stages", ("evaluate",)),
    ("stages", ("compare", "control")),
    ("chains", ("fit",)),
    ("chains", ("demo", "improve")),
)
"""Floors of `pipeline/`, the lowest first, with the kind of room on each."""
DATASETS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("files", ("io",)),
    ("files", ("shapes",)),
    ("files", ("robots",)),
    ("files", ("capture",)),
    ("formats", ("importers", "models", "rollouts", "synthetic")),
    ("formats", ("exports",)),
)
"""Floors of `datasets/`, the lowest first."""
LAYERS = ("schemas", "datasets", "pipeline", "cli")
"""Top-level folders, the lowest first."""


@dataclass(frozen=True)
class Import:
    """One import of a module by another.

    Attributes:
        source: Name of the importing module without `cgwm.`, such as `pipeline.fit`.
        target: Name of the imported module.
        line: Line of the statement in the source file.
        types_only: Whether it stands under `TYPE_CHECKING`.
    """

    source: str
    target: str
    line: int
    types_only: bool


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Return the path of every module of the package by its name without `cgwm.`."""
    found = {}
    for folder, name in FOLDERS.items():
        for path in sorted((root / folder).rglob("*.py")):
            parts = [name, *path.relative_to(root / folder).with_suffix("").parts]
            found[".".join(part for part in parts if part != "__init__")] = path
    return found


def imports(found: Mapping[str, Path]) -> list[Import]:
    """Return all imports between modules."""
    return [one for name, path in found.items() for one in _imports_of(name, path, found)]


Statement = ast.Import | ast.ImportFrom


@cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a source file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def _import_statements(
    body: Iterable[ast.AST], typed: bool = False
) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Return the import statements of a body and of all blocks in it, and whether they only serve type checkers."""
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, typed
        test = getattr(node, "test", None)
        inner = typed or "TYPE_CHECKING" in (getattr(test, "id", ""), getattr(test, "attr", ""))
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            block = getattr(node, part, ())
            if isinstance(block, list):
                yield from _import_statements(block, inner)


def _imports_of(name: str, path: Path, known: Mapping[str, Path]) -> Iterator[Import]:
    package = ["cgwm", *name.split(".")]
    package = package if path.name == "__init__.py" else package[:-1]
    for node, typed in _import_statements(parsed(path).body):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            absolute = ".".join([*base, *([node.module] if node.module else [])]).removeprefix("cgwm").strip(".")
            names = [f"{absolute}.{alias.name}" for alias in node.names]
            targets = {one if one in known else absolute for one in names}
        else:
            targets = {alias.name.removeprefix("cgwm.") for alias in node.names}
        for target in sorted(targets & set(known) - {name}):
            yield Import(name, target, node.lineno, typed)


def room_of(module: str) -> str:
    """Return the room of a module: `pipeline.physics` for `pipeline.physics.fused.host`."""
    return ".".join(module.split(".")[:2])


def floor_of(module: str) -> int | None:
    """Return the floor of a module among those of its folder, or None for a folder without floors."""
    folder, _, rest = module.partition(".")
    floors = {"pipeline": PIPELINE, "datasets": DATASETS}.get(folder)
    if floors is None or not rest:
        return None
    name = rest.split(".")[0]
    places = [k for k, (_, rooms) in enumerate(floors) if name in rooms]
    if not places:
        raise ValueError(f"{module}: the room '{name}' is on no floor; name it in {Path(__file__).name}.")
    return places[0]


def upward(edges: Iterable[Import], found: Mapping[str, Path]) -> list[str]:
    """Return one line for each import of a room on the same or a higher floor, with both floors."""
    wrong = []
    for one in edges:
        layers = [LAYERS.index(name.split(".")[0]) for name in (one.source, one.target)]
        rooms, floors = [room_of(name) for name in (one.source, one.target)], [None, None]
        if layers[0] == layers[1] and rooms[0] != rooms[1]:
            floors = [floor_of(name) for name in (one.source, one.target)]
        if layers[1] > layers[0]:
            floors = layers
        if floors[0] is not None and floors[1] is not None and floors[1] >= floors[0]:
            place = f"{found[one.source].relative_to(ROOT)}:{one.line}"
            wrong.append(f"{place} (floor {floors[0]}) imports {one.target} (floor {floors[1]})")
    return wrong


def circles(edges: Iterable[Import], level: str = "modules") -> list[list[str]]:
    """Return the groups of modules, or of rooms, that import each other when they run."""
    graph: dict[str, set[str]] = defaultdict(set)
    for one in edges:
        pair = (one.source, one.target) if level == "modules" else (room_of(one.source), room_of(one.target))
        if pair[0] != pair[1] and not one.types_only:
            graph[pair[0]].add(pair[1])
    reached = {name: _reached(graph, name) for name in list(graph)}
    groups = {
        tuple(sorted({other for other in seen if name in reached.get(other, ())})) for name, seen in reached.items()
    }
    return sorted(list(group) for group in groups if len(group) > 1)


def _reached(graph: Mapping[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    left = list(graph.get(start, ()))
    while left:
        name = left.pop()
        if name not in seen:
            seen.add(name)
            left += graph.get(name, ())
    return seen


def reach(edges: Iterable[Import], start: str, folder: str = "pipeline") -> list[str]:
    """Return the modules of a folder that running a module imports, with the packages around them."""
    graph: dict[str, set[str]] = defaultdict(set)
    for one in edges:
        if not one.types_only:
            parts = one.target.split(".")
            graph[one.source] |= {".".join(parts[: k + 1]) for k in range(1, len(parts))} or {one.target}
    return sorted(name for name in {start} | _reached(graph, start) if name.split(".")[0] == folder)


def drawing(edges: Iterable[Import]) -> str:
    """Return the rooms of `pipeline/` on their floors as SVG, with an arrow to each room that one imports."""
    width, height, gap = 1000, 52, 40
    place: dict[str, tuple[float, float]] = {}
    boxes, lines = [], []
    for k, (kind, rooms) in enumerate(reversed(PIPELINE)):
        y = 20 + k * (height + gap)
        boxes.append(f'<text x="8" y="{y + 22}" class="kind">{kind}</text>')
        step = (width - 90) / len(rooms)
        for j, room in enumerate(rooms):
            x = 90 + (j + 0.5) * step
            place[room] = (x, y)
            boxes.append(
                f'<rect x="{x - 56}" y="{y}" width="112" height="34" rx="6"/>'
                f'<text x="{x}" y="{y + 22}" text-anchor="middle">{room}</text>'
            )
    rooms_of = {(room_of(one.source), room_of(one.target)) for one in edges}
    pairs = sorted((a.partition(".")[2], b.partition(".")[2]) for a, b in rooms_of)
    for a, b in pairs:
        if a in place and b in place and a != b:
            (x0, y0), (x1, y1) = place[a], place[b]
            lines.append(f'<path d="M{x0} {y0 + 34} C{x0} {y0 + 60} {x1} {y1 - 26} {x1} {y1}" marker-end="url(#tip)"/>')
    style = "text{font:13px sans-serif;fill:#222}.kind{fill:#777}rect{fill:#eef3fa;stroke:#4a6fa5}"
    style += "path{fill:none;stroke:#4a6fa5;stroke-opacity:.35}marker path{fill:#4a6fa5;stroke:none}"
    marker = '<marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="6" markerHeight="6" orient="auto">'
    total = 20 + len(PIPELINE) * (height + gap)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {total}"><style>{style}</style>'
        f'<defs>{marker}<path d="M0 0L8 4L0 8z"/></marker></defs>{"".join(lines)}{"".join(boxes)}</svg>\n'
    )


def main() -> int:
    """Print floors, circles, upward imports and the reach of some commands; write `docs/import-graph.svg`."""
    found = modules()
    edges = imports(found)
    for folder, floors in (("pipeline", PIPELINE), ("datasets", DATASETS)):
        print(f"{folder}/, the highest floor first: room (modules), and the rooms that it imports")
        for k, (kind, rooms) in reversed(list(enumerate(floors))):
            for room in rooms:
                own = f"{folder}.{room}"
                count = sum(room_of(name) == own for name in found)
                below = {room_of(e.target) for e in edges if room_of(e.source) == own and e.target.startswith(folder)}
                names = " ".join(sorted(name.partition(".")[2] for name in below - {own, folder}))
                print(f"  {k} {kind:8} {room} ({count}): {names or '-'}")
    wrong, loops, loose = upward(edges, found), circles(edges), circles(edges, "rooms")
    print(f"rooms of pipeline/: {sum(len(rooms) for _, rooms in PIPELINE)} on {len(PIPELINE)} floors")
    print(f"upward imports: {len(wrong)}", *wrong, sep="\n  ")
    print(f"circles of rooms: {len(loose)}", *loose, sep="\n  ")
    print(f"circles of modules: {len(loops)}", *loops, sep="\n  ")
    for verb in ("mask", "calibrate", "fit", "eval", "compare", "diagnose", "improve", "synthesize", "validate"):
        names = reach(edges, f"cli.{verb}")
        lines = sum(len(found[name].read_text(encoding="utf-8").splitlines()) for name in names)
        print(f"reach of cgwm {verb}: {len(names)} modules of pipeline/, {lines} lines")
    picture = ROOT / "docs" / "import-graph.svg"
    picture.write_text(drawing(edges), encoding="utf-8")
    print(f"drawn: {picture.relative_to(ROOT)}")
    return 1 if wrong or loops or loose else 0


if __name__ == "__main__":
    sys.exit(main())

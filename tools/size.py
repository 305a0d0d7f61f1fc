"""Count what makes source hard to read: `python tools/size.py [FOLDER ...]`; each finding is named.

Before them come by folder the number of functions and their mean lines, without docstrings, comments and blank ones,
and mean complexity; `--root TREE` takes those of another checkout, to compare.

Counted with `ast` over the installed packages: files over 400 lines, functions over 60 lines, functions of cyclomatic
complexity over 15 (McCabe: 1 + branches, loops, handlers, comprehensions' conditions and boolean operators), and calls
of a class of this package that pass more than five arguments by position.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("cgwm", "cgwm_cli", "datasets", "pipeline", "schemas")
MOST_LINES, MOST_FUNCTION_LINES, MOST_COMPLEXITY, MOST_POSITIONAL = 400, 60, 15, 5


def complexity(function: ast.AST) -> int:
    """Return the cyclomatic complexity of a function, those inside it included."""
    branches = (ast.If, ast.For, ast.While, ast.IfExp, ast.ExceptHandler, ast.With, ast.Assert, ast.comprehension)
    found = 1
    for node in ast.walk(function):
        found += isinstance(node, branches) and not isinstance(node, ast.With)
        found += len(node.values) - 1 if isinstance(node, ast.BoolOp) else 0
        found += len(node.ifs) if isinstance(node, ast.comprehension) else 0
    return found


def code_lines(tree: ast.AST, text: str) -> set[int]:
    """Return the lines of a source that are neither blank nor comment nor text that stands alone."""
    texts: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            texts |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(text.splitlines(), 1)
    return {number for number, line in lines if line.strip() and not line.strip().startswith("#")} - texts


def means(paths: list[Path]) -> str:
    """Return the number of functions in some files, and their mean lines and complexity, as a text."""
    sizes = []
    for path in paths:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        own = code_lines(tree, text)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                within = range(node.lineno, (node.end_lineno or node.lineno) + 1)
                sizes.append((sum(line in own for line in within), complexity(node)))
    lines, branches = (sum(column) / max(len(sizes), 1) for column in zip(*sizes or [(0, 0)], strict=True))
    return f"{len(sizes)} functions, of {lines:.3f} lines and complexity {branches:.3f}"


def findings(root: Path, paths: list[Path]) -> Iterator[tuple[str, str]]:
    """Yield (kind, place and figure) of everything over a limit."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    classes = {node.name for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}
    for path, tree in trees.items():
        name = path.relative_to(root)
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if lines > MOST_LINES:
            yield "files over 400 lines", f"{name}: {lines}"
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or node.lineno) - node.lineno + 1
                if length > MOST_FUNCTION_LINES:
                    yield "functions over 60 lines", f"{name}:{node.lineno} {node.name}: {length}"
                if complexity(node) > MOST_COMPLEXITY:
                    yield "functions of complexity over 15", f"{name}:{node.lineno} {node.name}: {complexity(node)}"
            elif isinstance(node, ast.Call) and len(node.args) > MOST_POSITIONAL:
                called = ast.unparse(node.func).split(".")[-1]
                if called in classes:
                    yield "constructors called with over five positional arguments", f"{name}:{node.lineno} {called}"


def main() -> int:
    """Print the number of findings of each kind, and every one of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", default=FOLDERS)
    parser.add_argument("--root", type=Path, default=ROOT)
    given = parser.parse_args()
    files = {folder: sorted((given.root / folder).rglob("*.py")) for folder in given.folders}
    for folder, paths in files.items():
        print(f"{folder}: {means(paths)}")
    found: dict[str, list[str]] = {}
    for kind, text in findings(given.root, [path for paths in files.values() for path in paths]):
        found.setdefault(kind, []).append(text)
    for kind, texts in found.items():
        print(f"{kind}: {len(texts)}", *texts, sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""What to change: the mutants of a tree, and a random sample of them."""

from __future__ import annotations

import ast
import hashlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

FOLDERS = ("pipeline/physics", "pipeline/segments", "pipeline/optimization", "pipeline/rendering", "schemas")
NEED_GPU = ("pipeline/rendering/cuda_kernels.py", "pipeline/physics/fused/launch.py")
"""Modules that do nothing without a CUDA device, which the tests have only on request."""
QUIET = ("warn", "warning", "info", "debug", "error", "exception", "print", "echo")
"""Calls that only tell somebody something."""


@dataclass(frozen=True, kw_only=True)
class Mutant:
    """One change of one file."""

    path: str
    """The file, relative to the tree."""
    line: int
    """Line of the change, from 1."""
    statement: int
    """First line of the statement; that of the change may have no instruction of its own."""
    kind: str
    """What is changed: operator, comparison, number, condition, return, call."""
    begin: int
    """First byte of the text that is replaced."""
    end: int
    """Byte after it."""
    new: str
    """Text that takes its place."""
    name: str
    """Function, old text and new text: with `path` it tells mutants apart across edits of other functions."""


BINARY = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.Pow: ("**", "*")}
BINARY |= {ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&")}
OPPOSITE = {ast.Lt: ("<", ">="), ast.LtE: ("<=", ">"), ast.Gt: (">", "<="), ast.GtE: (">=", "<")}
OPPOSITE |= {ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"), ast.In: ("in", "not in")}
EDGE = {ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">")}


class Changes(ast.NodeVisitor):
    """Collects the possible changes of a file."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source, self.found = path, source, []
        self.starts = [0, *(match.end() for match in re.finditer(b"\n", source))]
        self.scope: list[str] = []
        self.inside = self.statement = 0

    def visit(self, node: ast.AST) -> None:
        """Visit a node, and note the statement that it belongs to."""
        before = self.statement
        if isinstance(node, ast.stmt):
            self.statement = node.lineno
        super().visit(node)
        self.statement = before

    def place(self, line: int, column: int) -> int:
        """Return the byte of a line and column."""
        return self.starts[line - 1] + column

    def span(self, node: Any) -> tuple[int, int]:
        """Return the first byte of a node, and that after it."""
        return self.place(node.lineno, node.col_offset), self.place(node.end_lineno, node.end_col_offset)

    def add(self, node: Any, kind: str, begin: int, end: int, new: str) -> None:
        """Note the replacement of some bytes of a node."""
        old, (first, last) = self.source[begin:end].decode(), self.span(node)
        around = self.source[first:last].decode()
        if self.inside and old != new:
            name = f"{'.'.join(self.scope)}: {kind}: {_line(around)}: {_line(old)} -> {_line(new)}"
            line = self.source.count(b"\n", 0, begin) + 1
            place = {"path": self.path, "line": line, "statement": self.statement}
            self.found.append(Mutant(**place, kind=kind, begin=begin, end=end, new=new, name=name))

    def whole(self, node: Any, kind: str, change: Callable[[str], str]) -> None:
        """Note the replacement of a node's whole text."""
        begin, end = self.span(node)
        self.add(node, kind, begin, end, change(self.source[begin:end].decode()))

    def between(self, node: ast.AST, kind: str, left: Any, right: Any, old: str, new: str) -> None:
        """Replace an operator between two operands, of which parentheses may stand around."""
        begin, end = self.span(left)[1], self.span(right)[0]
        gap = self.source[begin:end].decode()
        at = re.search(rf"(?<![\w<>=!*/]){re.escape(old)}(?![\w<>=*/])", gap)
        if at and "#" not in gap:
            self.add(node, kind, begin + at.start(), begin + at.end(), new)

    def function(self, node: Any) -> None:
        """Visit the body of a function, not its defaults, types and decorators."""
        self.scope.append(node.name)
        self.inside += 1
        for statement in node.body:
            self.visit(statement)
        self.inside -= 1
        self.scope.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.function(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> None:
        self.function(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self.scope.append(node.name)
        for statement in node.body:
            self.visit(statement)
        self.scope.pop()

    def visit_Raise(self, node: ast.Raise) -> None:
        """Leave messages alone."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave texts alone."""

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        words = isinstance(node.left, ast.Constant) and isinstance(node.left.value, str)
        if type(node.op) in BINARY and not words:
            self.between(node, "operator", node.left, node.right, *BINARY[type(node.op)])
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1:
            kind, right = type(node.ops[0]), node.comparators[0]
            if kind in OPPOSITE:
                self.between(node, "comparison", node.left, right, *OPPOSITE[kind])
            # one value more or less matters where values are counted; of measured ones it never occurs
            if kind in EDGE and (_counts(node.left) or _counts(right)):
                self.between(node, "comparison", node.left, right, *EDGE[kind])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        if len(node.values) == 2:
            self.between(node, "condition", node.values[0], node.values[1], old, new)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        begin = self.span(node)[0]
        if isinstance(node.op, ast.Not):
            self.add(node, "condition", begin, begin + 3, "")
        elif isinstance(node.op, ast.USub):
            self.add(node, "operator", begin, begin + 1, "+")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool):
            self.whole(node, "number", lambda _: str(not node.value))
        elif isinstance(node.value, int | float):
            value = node.value
            self.whole(node, "number", lambda _: repr(value + 1))

    def condition(self, node: Any) -> None:
        """Note the opposite of a test that is no comparison."""
        if not (isinstance(node.test, ast.UnaryOp | ast.Compare)):
            self.whole(node.test, "condition", lambda text: f"not ({text})")
        self.generic_visit(node)

    visit_If = visit_IfExp = visit_While = condition

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is not None and not (isinstance(node.value, ast.Constant) and node.value.value is None):
            self.whole(node.value, "return", lambda _: "None")
            self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            called = ast.unparse(node.value.func).rpartition(".")[2]
            if called not in QUIET:
                self.whole(node, "call", lambda _: "pass")
                self.visit(node.value)
        elif not isinstance(node.value, ast.Constant):
            self.generic_visit(node)


def _line(text: str) -> str:
    return " ".join(text.split())[:120]


def _counts(node: ast.AST) -> bool:
    whole = isinstance(node, ast.Constant) and type(node.value) is int
    return whole or (isinstance(node, ast.Call) and ast.unparse(node.func) == "len")


def changes_of(root: Path, path: str) -> list[Mutant]:
    """Return every change of a file that can be compiled."""
    source = (root / path).read_bytes()
    visitor = Changes(path, source)
    visitor.visit(ast.parse(source))
    return visitor.found


def applied(source: bytes, mutant: Mutant) -> bytes:
    """Return the source with the change."""
    return source[: mutant.begin] + mutant.new.encode() + source[mutant.end :]


def sample(root: Path, count: int, seed: int, folders: Sequence[str]) -> list[Mutant]:
    """Return a random sample of the mutants of some folders, the same for the same code."""
    ranked = []
    for folder in folders:
        for path in sorted((root / folder).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            seen: Counter[str] = Counter()
            for mutant in changes_of(root, name) if name not in NEED_GPU else ():
                seen[mutant.name] += 1
                text = f"{seed}\n{name}\n{mutant.name}\n{seen[mutant.name]}"
                ranked.append((hashlib.sha256(text.encode()).hexdigest(), mutant))
    return [mutant for _, mutant in sorted(ranked, key=lambda pair: pair[0])[:count]]

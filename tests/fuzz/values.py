"""Values that are put where others stand: what is hard for programs, and what people write by mistake."""

from __future__ import annotations

import json
from typing import Any

from hypothesis import strategies as st

HARD_NUMBERS = (
    *("0", "-0.0", "1", "-1", "1e-320", "1e-30", "1e-9", "1e-3", "1e3", "1e9", "1e30", "1e308", "-1e308"),
    *("2147483648", "-2147483649", "9223372036854775808", "18446744073709551616", "1000000000000", "0.1", "7"),
)
BEYOND = {
    "json": ("NaN", "Infinity", "-Infinity", "1e400", "9" * 5000, "-" + "9" * 5000, "0x10", "01", "1_000", "+1"),
    "toml": (
        "nan",
        "inf",
        "-inf",
        "1e400",
        "9" * 5000,
        "-" + "9" * 5000,
        "0x10",
        "1_000",
        "+1",
        "1979-05-27T07:32:00Z",
    ),
}
"""Numbers that a schema cannot mean; some of them are no syntax of the format either."""
HARD_TEXTS = (
    *("", " ", "a", "cube", "000", "-9.81", "0.5", "true", "null", "nan", "../x", "../../etc/passwd", "/dev/zero"),
    *("/dev/stdin", "/proc/self/environ", "a/b", "a\\b", "~", "$HOME", "%s%s%n", "{0}", "x" * 300, "x" * 70_000),
    *("\x00", "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\r\nCRLF", "\x08\x08", "\x9b31m", "\u202egnp", "é", "😀"),
    *("\ufeff", "\u2028", "a\tb", "'; drop", "`id`", "os:system", "pipeline.py:X", "http://localhost:1/x"),
)
NESTED = 100_000


def literal(value: Any, form: str) -> str:
    """Return a value as text of JSON or TOML."""
    if form == "json" or isinstance(value, int | float | bool):
        return json.dumps(value)
    if value is None:
        return '"null"'
    if isinstance(value, str):
        return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in value) + '"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{literal(str(k), form)} = {literal(v, form)}" for k, v in value.items()) + " }"
    return "[" + ", ".join(literal(v, form) for v in value) + "]"


def texts() -> st.SearchStrategy[str]:
    """Return a strategy of texts."""
    return st.one_of(st.sampled_from(HARD_TEXTS), st.text(st.characters(exclude_categories=["Cs"]), max_size=12))


def numbers() -> st.SearchStrategy[str]:
    """Return a strategy of numbers, as text."""
    return st.one_of(
        st.sampled_from(HARD_NUMBERS),
        st.floats(allow_nan=False, allow_infinity=False).map(repr),
        st.floats(-1e4, 1e4).map(repr),
        st.integers(-(10**6), 10**6).map(str),
    )


def literals(form: str) -> st.SearchStrategy[str]:
    """Return a strategy of values as text of `json` or `toml`."""
    plain = st.one_of(
        st.sampled_from([None, True, False, [], {}, [[]], [{}], {"a": 1}, [1, 2], [0.0] * 3, [1, "a", None]]),
        texts(),
        st.lists(st.floats(-10, 10), max_size=7),
        st.lists(st.lists(st.floats(-10, 10), max_size=4), max_size=4),
    )
    deep = [f"{'[' * depth}{']' * depth}" for depth in (30, 200, 1500, NESTED)]
    deep += [f"{'[' * NESTED}", f"[{', '.join(['0.5'] * 100_000)}]"]
    deep += ['{"a":' * 2000 + "1" + "}" * 2000] if form == "json" else ["{a=" * 1000 + "1" + "}" * 1000]
    return st.one_of(
        numbers(),
        numbers(),
        plain.map(lambda value: literal(value, form)),
        st.sampled_from(BEYOND[form]),
        st.sampled_from(deep),
    )

"""The command to type after a diagnosis: it adds what was found, saves the law, or tests what seems complete."""

from __future__ import annotations

import re
from pathlib import Path

from ....schemas import DiagnoseResult


def next_command(result: DiagnoseResult, model: Path, capture: Path, split: str = "train") -> list[str]:
    """Return the words of the command to type next, with the paths of the diagnosis.

    Args:
        result: The diagnosis.
        model: The model.
        capture: The capture.
        split: The episodes that were used.
    """
    splits = ["--split", split] if split != "train" else []
    added = [*result.selected, *([result.saved_law] if result.saved_law is not None else [])]
    if added:
        grown = ["--from", str(model), *splits, "--effects", ",".join(added), "--out", str(successor(model))]
        return ["cgwm", "fit", str(capture), *grown]
    if result.residual_law is not None and result.residual_law.terms:
        law = model.with_name(f"{model.name}_law.py")
        return ["cgwm", "diagnose", str(model), str(capture), *splits, "--save-law", str(law)]
    return ["cgwm", "compare", str(model), str(capture)]


def successor(model: Path) -> Path:
    """Return the path of the model that follows another one, which does not exist yet: its number is one larger.

    The number is that of a part `m0` of the name, else the one at its end.

    >>> successor(Path("a/m0")), successor(Path("m0_throws7")), successor(Path("base"))
    (PosixPath('a/m1'), PosixPath('m1_throws7'), PosixPath('base-1'))
    """
    found = re.fullmatch(r"((?:.*[_-])?m)(\d{1,6})([_-].*)", model.name) or re.fullmatch(
        r"(.*?)(\d{1,6})()", model.name
    )
    stem, number, rest = (found[1], int(found[2]), found[3]) if found else (f"{model.name}-", 0, "")
    while (path := model.with_name(f"{stem}{number + 1}{rest}")).exists():
        number += 1
    return path

"""Warnings that say the same of several episodes, folded into one."""

from __future__ import annotations

import re
from collections.abc import Sequence

SHOWN = 6
"""Number of names that a folded warning lists at most."""
_SUBJECT = re.compile(r"^(episode) '([^']*)' (is|has|begins|ends) ")
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w])")
_PLURAL = {"is": "are", "has": "have", "begins": "begin", "ends": "end"}


def fold_repeated(messages: Sequence[str]) -> list[str]:
    """Return messages in their order, each once; those that differ in the episode and in numbers only are one.

    >>> fold_repeated(["episode 'a' begins 2 ms late.", "no cameras.", "episode 'b' begins 3 ms late.", "no cameras."])
    ['2 episodes (a, b) begin 2 to 3 ms late.', 'no cameras.']
    >>> fold_repeated(["episode 'a' begins 2 ms late.", "episode 'a' begins 3 ms late."])
    ["episode 'a' begins 2 to 3 ms late."]
    """
    alike: dict[str, list[str]] = {}
    for message in dict.fromkeys(messages):
        about = _SUBJECT.match(message)
        key = message if about is None else f"{about[1]} {about[3]} {_NUMBER.sub('#', message[about.end() :])}"
        alike.setdefault(key, []).append(message)
    return [same[0] if len(same) == 1 else _folded(same) for same in alike.values()]


def _folded(same: Sequence[str]) -> str:
    """Return messages about episodes as one, with the range of each number; several models may tell of one episode."""
    found = [match for message in same if (match := _SUBJECT.match(message))]
    names = list(dict.fromkeys(match[2] for match in found))
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    rests = [message[match.end() :] for message, match in zip(same, found, strict=True)]
    ranges = map(_range, zip(*(_NUMBER.findall(rest) for rest in rests), strict=True))
    rest = _NUMBER.sub(lambda _: next(ranges), rests[0])
    if len(names) == 1:
        return found[0][0] + rest
    return f"{len(names)} {found[0][1]}s ({', '.join(names[:SHOWN])}{more}) {_PLURAL[found[0][3]]} {rest}"


def _range(numbers: Sequence[str]) -> str:
    """Return the smallest and the largest of some numbers as a text, one of them where they are equal."""
    least, most = min(numbers, key=float), max(numbers, key=float)
    return least if float(least) == float(most) else f"{least} to {most}"

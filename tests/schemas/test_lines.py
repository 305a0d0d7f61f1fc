"""Lines of fields in TOML and JSON texts, as messages name them."""

import pytest
from cgwm.schemas.lines import LONGEST_KEY, find_line

TOML = """\
format = "cgwm-capture/1"
[world]  # of all bodies
gravity.direction = [0, 0, -1]
"odd key" = 1
[[bodies]]
name = "one"

[[bodies]]
name = "two"
shape = { box = 1 }
[bodies.limits]
low = 0
[[bodies.joints]]
axis = 1
[[bodies.joints]]
axis = 2
[[bodies]]
[[bodies.joints]]
axis = 3
[ splits . 'a b' ]
test = []
"""


@pytest.mark.parametrize(
    ("location", "line"),
    [
        (("format",), 1),
        (("world",), 2),
        (("world", "gravity", "direction"), 3),
        (("world", "odd key"), 4),
        (("world", "absent"), 2),  # of what holds it
        (("bodies", 0), 5),
        (("bodies", 0, "name"), 6),
        (("bodies", 1, "name"), 9),
        (("bodies", 1, "shape", "box", "half"), 10),
        (("bodies", 1, "limits", "low"), 12),
        (("bodies", 1, "joints", 0, "axis"), 14),
        (("bodies", 1, "joints", 1, "axis"), 16),
        (("bodies", 2), 17),
        (("bodies", 2, "joints", 0, "axis"), 19),  # of the third body, the first
        (("splits", "a b", "test"), 21),
        (("nowhere",), None),
        ((), None),
    ],
)
def test_the_line_of_a_toml_field(location: tuple, line: int | None) -> None:
    assert find_line(TOML, location) == line


JSON = '{"one": 1,\n "two": {"three": [{"four": 4},\n {"four" : 5, "fi.ve": 0}]}}'


@pytest.mark.parametrize(
    ("location", "line"),
    [
        (("one",), 1),
        (("two", "three"), 2),
        (("two", "three", 7), 2),  # of the innermost key
        (("two", "three", 1, "four"), None),  # two have that name
        (("two", "three", 1, "fi.ve"), 3),
        (("two", "three", 1, "fixve"), None),
        ((0,), None),
        ((), None),
    ],
)
def test_the_line_of_a_json_field(location: tuple, line: int | None) -> None:
    assert find_line(JSON, location, ".json") == line


def test_a_key_that_takes_long_to_search_for_is_not() -> None:
    for length, line in ((LONGEST_KEY, 1), (LONGEST_KEY + 1, None)):
        assert find_line(f'{{"{"k" * length}": 1}}', ("k" * length,), ".json") == line
    assert find_line("", ("one",)) is None

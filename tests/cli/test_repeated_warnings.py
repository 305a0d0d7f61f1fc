"""Warnings that say the same of several episodes are one."""

from cgwm.cli.output import warnings
from cgwm.pipeline.segments.release_detection import release_warnings


def test_episodes_that_begin_in_a_hand_are_one_warning_with_the_range_of_their_numbers() -> None:
    starts = {f"{k:03d}": 0.0 for k in range(8)}
    (text,) = warnings(release_warnings({name: 0.02 + 0.01 * k for k, name in enumerate(starts)}, starts))
    assert text.startswith("warning: 8 episodes (000, 001, 002, 003, 004, 005 and 2 more) begin in a hand: ")
    assert "for the first 20 to 90 ms the body moves or turns unlike the rest" in text
    assert "0.020 to 0.090 on the track's clock" in text


def test_what_differs_in_words_stays_apart_in_its_order_and_a_repeated_message_is_one() -> None:
    messages = [
        "episode 'a' is left out: no track of 'ball'.",
        "2 frames are wrong.",
        "episode 'b' is left out: no track of 'cube'.",
        "3 frames are wrong.",
        "2 frames are wrong.",
    ]
    assert warnings(messages) == [f"warning: {text}" for text in messages[:4]]
    assert warnings(["episode 'a' is left out: 1 of 3."]) == ["warning: episode 'a' is left out: 1 of 3."]

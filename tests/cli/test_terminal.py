"""What names from files can do to a terminal: nothing."""

import json
import logging
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from cgwm.cli import main
from cgwm.cli.terminal import escape_logs, print_result, say
from cgwm.schemas import InputDataError
from cgwm.schemas.printable import in_one_line, printable, printable_json

EVIL = "a\x1b[2J\x07\x9b31m\x7f\u202egpj\r\u2028"


@pytest.mark.parametrize(
    "letter", [*map(chr, (*range(9), *range(11, 32), *range(127, 160))), *"\u200e\u202e\u2066\ud800"]
)
def test_control_characters_are_escaped(letter: str) -> None:
    shown = printable(f"a{letter}b")
    assert shown.isascii() and shown.isprintable() and shown[0] + shown[-1] == "ab"
    if not "\ud800" <= letter <= "\udfff":
        document = json.dumps({"name": f"a{letter}b"}, ensure_ascii=False)
        assert printable_json(document).isprintable() and json.loads(printable_json(document)) == json.loads(document)


@pytest.mark.parametrize("text", ["Würfel 3 \u03bc, 立方体", "two\nlines\tand a tab", "", "\U0001f468\u200d\U0001f469"])
def test_text_stays(text: str) -> None:
    assert printable(text) == printable_json(text) == text


def test_everything_that_is_printed_is_escaped(capfd: pytest.CaptureFixture[str]) -> None:
    say(EVIL)
    print_result(EVIL, json=False)
    print_result(json.dumps(EVIL, ensure_ascii=False), json=True)
    before = warnings.formatwarning
    escape_logs()
    escape_logs()
    text = warnings.formatwarning(UserWarning(EVIL), UserWarning, EVIL, 1)
    warnings.formatwarning = before
    assert printable(text) == text
    assert logging.lastResort is not None
    logging.lastResort.handle(logging.LogRecord(EVIL, logging.WARNING, EVIL, 1, EVIL, (), None))
    out, err = capfd.readouterr()
    assert printable(out + err) == out + err
    assert json.loads(out.splitlines()[1]) == EVIL


def test_a_name_adds_no_line_to_a_message() -> None:
    error = InputDataError("a\nNext: run this: wrong.", "b\nb.", "correct it:\n  [table]\n  key = 1")
    assert str(error) == "a\\nNext: run this: wrong.\nAllowed: b\\nb.\nNext: correct it:\n  [table]\n  key = 1"
    assert in_one_line("2 faults.\n1. one\n2. two") == "2 faults.\n1. one\n2. two"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such file names")
def test_a_file_name_that_is_no_text(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    name = os.fsdecode(os.fsencode(tmp_path) + b"/x\xff\x1b")
    with pytest.raises(SystemExit) as ended:
        main(["validate", name])
    out, err = capfd.readouterr()
    assert (ended.value.code, out) == (2, "")
    assert err.startswith(f"{tmp_path}/x\\udcff\\x1b: no such directory.\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("buffered", ["", "1"])
def test_a_result_that_cannot_be_written_is_an_error(buffered: str) -> None:
    command = [sys.executable, "-c", "from cgwm.cli import main; main()", "--version"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": buffered}, check=False
        )
    assert (done.returncode, done.stderr) == (1, b"No space left on device.\n")

"""What the README says is true: its manifest is legal, its commands exist, its error is the one that is printed."""

import re
import shlex
from pathlib import Path

import pytest
from cgwm.cli.app import app
from cgwm.cli.settings import StageSettings
from cgwm.pipeline.diagnosis.throws import read_throws
from cgwm.schemas import CaptureManifest, InputDataError, PhysConfig, SplatConfig, read_toml
from typer.main import get_command

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(
    {line.split(" || ")[0].split(" > ")[0].strip() for line in re.findall(r"^ *(cgwm .*)$", README, re.M)}
)


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.M | re.S)


def test_the_manifest_is_legal(tmp_path: Path) -> None:
    text, _ = blocks("toml")
    path = tmp_path / "capture.toml"
    path.write_text(text)
    manifest = read_toml(path, CaptureManifest)
    assert manifest.bodies[0].mass_kg == 0.37
    assert manifest.calibration.markers[0].side_m == 0.08


def test_the_error_is_what_is_printed(tmp_path: Path) -> None:
    text, _ = blocks("toml")
    path = tmp_path / "capture.toml"
    path.write_text(text.replace("mass_kg", "mass"))
    with pytest.raises(InputDataError) as error:
        read_toml(path, CaptureManifest)
    message = str(error.value).replace(str(tmp_path), "capture")
    assert f"```\n{message}\n```" in README


def test_the_throws_are_legal(tmp_path: Path) -> None:
    _, text = blocks("toml")
    path = tmp_path / "throws.toml"
    path.write_text(text)
    # without spin its axis counts for nothing
    assert len(read_throws(path)) == 2 * 2 * 3 + 2 * 2


@pytest.mark.parametrize("line", COMMANDS)
def test_the_commands_exist(line: str) -> None:
    verb, *words = shlex.split(line, comments=True)[1:]
    verbs = get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    assert verb in verbs
    if hasattr(verbs[verb], "commands"):  # a group
        verbs, (verb, *words) = verbs[verb].commands, words
        assert verb in verbs
    options = {name for parameter in verbs[verb].params for name in parameter.opts}
    assert {word for word in words if word.startswith("-")} <= options


def test_the_settings_exist() -> None:
    stages = {"sg-gs": SplatConfig, "phys-geo": PhysConfig}
    assignments = re.findall(r"--set (\S+)", README)
    assert assignments
    settings = StageSettings(stages, None, assignments)
    for stage, config in stages.items():
        assert settings.configure(stage, config) != config()


def test_there_are_commands() -> None:
    assert len(COMMANDS) >= 8

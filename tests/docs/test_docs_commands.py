"""What the README and the pages say is true: manifests are legal, commands exist, blocks run, links lead somewhere."""

import re
import shlex
import shutil
import signal
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from cgwm.cli import main
from cgwm.cli.app import app
from cgwm.cli.execution import with_values
from cgwm.cli.settings import StageSettings
from cgwm.datasets.capture.tracks import read_tracks
from cgwm.pipeline.diagnose.next_experiment.experiments import read_experiments
from cgwm.pipeline.diagnose.thresholds import THRESHOLDS
from cgwm.pipeline.synthesize import synthesize
from cgwm.schemas import (
    CalibrateConfig,
    CaptureManifest,
    FileModel,
    InputDataError,
    PhysConfig,
    SplatConfig,
    SynthesizeConfig,
    read_plan,
    read_toml,
)
from helpers.small_model import write_small_model
from typer.main import get_command

ROOT = Path(__file__).resolve().parents[2]
PAGES = {
    path.relative_to(ROOT).as_posix(): path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
TEXTS = {name: path.read_text(encoding="utf-8") for name, path in PAGES.items()}
BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>run|illustrative)(?:: (?P<word>[^\n]+))? -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.M | re.S,
)
FOLDERS = {"capture", "dataset"}
"""What a block marked `run: ...` finds in its folder, besides `model`."""
MANIFEST = """\
format = "cgwm-capture/1"
[world]
ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }
[[bodies]]
name = "cube"
mass_kg = 0.2
shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }
[splits]
train = ["000"]
test = ["001"]
"""
TARGETS = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
MOST_LINES = 150


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; mark: run, illustrative or nothing; word: the reason, or the folder to run in."""

    page: str
    line: int
    language: str
    text: str
    mark: str
    word: str

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def blocks_of(page: str, text: str) -> list[Block]:
    return [
        Block(page, text[: m.start()].count("\n") + 1, m["language"], m["text"], m["mark"] or "", m["word"] or "")
        for m in BLOCK.finditer(text)
    ]


BLOCKS = [block for page, text in TEXTS.items() for block in blocks_of(page, text)]


def blocks(page: str, language: str) -> list[str]:
    return [block.text for block in BLOCKS if (block.page, block.language) == (page, language)]


def command_in(line: str) -> str:
    """Return the `cgwm ...` command of a line of shell, without what follows it; empty if there is none."""
    found = re.search(r"(?:^|[\s'])(cgwm [^|]*)", line)
    return re.split(r" \|\| | >>? |'$| +# ", found[1])[0].strip() if found else ""


COMMANDS = sorted(
    {command_in(line) for block in BLOCKS if block.language == "sh" for line in block.text.splitlines()} - {""}
)
INLINE = sorted(
    {
        re.split(r" > | \|", code.replace("\\|", "|"))[0]
        for text in TEXTS.values()
        for code in re.findall(r"`(cgwm [a-z][^`]*)`", text)
    }
)


@cache
def command_line() -> Any:
    return get_command(app)


def words_of(command: str) -> list[str]:
    return with_values(shlex.split(command, comments=True)[1:])


# Files and messages


def test_the_manifest_is_legal(tmp_path: Path) -> None:
    text, *others = blocks("docs/capture.md", "toml")
    order = ("[[materials]]", "[[surfaces]]", "[[articulations]]")
    materials, surfaces, joints = (next(block for block in others if word in block) for word in order)
    path = tmp_path / "capture.toml"
    path.write_text('format = "cgwm-capture/1"\n' + materials)
    assert read_toml(path, CaptureManifest).pairs[0].friction == 0.3
    path.write_text('format = "cgwm-capture/1"\n' + surfaces)
    assert [surface.name for surface in read_toml(path, CaptureManifest).surfaces] == ["ramp", "post"]
    path.write_text('format = "cgwm-capture/1"\n' + joints)
    assert [one.path for one in read_toml(path, CaptureManifest).articulations] == ["elbow.urdf"]
    path.write_text(text)
    manifest = read_toml(path, CaptureManifest)
    assert manifest.bodies[0].mass_kg == 0.37
    assert manifest.calibration.markers[0].side_m == 0.08


def test_camera_and_scale_in_the_manifest_are_legal(tmp_path: Path) -> None:
    camera, scale = blocks("docs/calibrate.md", "toml")
    path = tmp_path / "capture.toml"
    path.write_text('format = "cgwm-capture/1"\n' + scale + camera)
    calibration = read_toml(path, CaptureManifest).calibration
    assert calibration.known_distance is not None and calibration.known_distance.distance_m == 0.3
    assert calibration.intrinsics[0].fx == 3120.5


def test_the_plan_is_legal(tmp_path: Path) -> None:
    (text,) = blocks("docs/datasets.md", "toml")
    path = tmp_path / "plan.toml"
    path.write_text(text)
    assert read_plan(path).parameter_spread == 2


def test_the_error_is_what_is_printed(tmp_path: Path) -> None:
    text = blocks("docs/capture.md", "toml")[0]
    path = tmp_path / "capture.toml"
    path.write_text(text.replace("mass_kg", "mass"))
    with pytest.raises(InputDataError) as error:
        read_toml(path, CaptureManifest)
    message = str(error.value).replace(str(tmp_path), "capture")
    assert f"{message}\n" in blocks("docs/quickstart.md", "text")


def test_the_throws_are_legal(tmp_path: Path) -> None:
    (text,) = blocks("docs/diagnose.md", "toml")
    path = tmp_path / "throws.toml"
    path.write_text(text)
    # without spin its axis counts for nothing
    assert len(read_experiments(path)) == 2 * 2 * 3 + 2 * 2


def test_the_tracks_are_legal(tmp_path: Path) -> None:
    (text,) = blocks("docs/capture.md", "csv")
    path = tmp_path / "000.csv"
    path.write_text(text)
    tracks = read_tracks(path, ["cube"])[0]
    assert list(tracks) == ["cube"]


# Commands


@pytest.mark.parametrize("line", [*COMMANDS, *(line for line in INLINE if line not in COMMANDS)])
def test_the_commands_exist(line: str) -> None:
    verb, *words = words_of(line)
    verbs = command_line().commands
    assert verb in verbs
    if hasattr(verbs[verb], "commands") and words:  # a group
        verbs, (verb, *words) = verbs[verb].commands, words
        assert verb in verbs
    options = {name for parameter in verbs[verb].params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in words if word.startswith("-")} <= options


@pytest.mark.parametrize("line", COMMANDS)
def test_the_command_line_takes_the_commands(line: str) -> None:
    """Every command of a block is parsed by the real command line: verb, arguments, options and their values."""
    command, name, words = command_line(), "cgwm", words_of(line)
    context = None
    while hasattr(command, "commands"):  # a group: its own options come before the verb
        context = command.make_context(name, words, parent=context, resilient_parsing=True)
        place = next((k for k, word in enumerate(words) if not word.startswith("-")), None)
        assert place is not None, "a verb is missing"
        name, command, words = command.resolve_command(context, words[place:])
        assert name is not None and command is not None
    assert command.make_context(name, words, parent=context).args == []


def test_the_settings_exist() -> None:
    stages: dict[str, type[FileModel]] = {"sg-gs": SplatConfig, "phys-geo": PhysConfig}
    assignments = re.findall(r"--set (\S+)", TEXTS["docs/fit.md"])
    assert assignments
    settings = StageSettings(stages, None, assignments)
    for stage, config in stages.items():
        assert settings.configure(stage, config) != config()


def test_every_setting_that_is_named_exists() -> None:
    stages: dict[str, type[FileModel]] = {
        "calibrate": CalibrateConfig,
        "sg-gs": SplatConfig,
        "phys-geo": PhysConfig,
        "synthesize": SynthesizeConfig,
    }
    named = {name for text in TEXTS.values() for name in re.findall(rf"\b((?:{'|'.join(stages)})\.[a-z_]+)\b", text)}
    named -= {name for name in named if name.endswith((".py", ".md"))}
    assert len(named) >= 8
    unknown = [name for name in sorted(named) if name.split(".")[1] not in stages[name.split(".")[0]].model_fields]
    assert unknown == []


def test_there_are_commands() -> None:
    assert len(COMMANDS) >= 8
    assert len(blocks("README.md", "sh")) >= 4


# Blocks


def test_the_first_page_is_short() -> None:
    assert len(TEXTS["README.md"].splitlines()) <= MOST_LINES


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.place)
def test_every_block_is_run_checked_or_marked(block: Block) -> None:
    """A block is tested above or below, or a comment before it says why it is not."""
    assert block.language, "name the language of the block: sh, python, toml, csv or text"
    if block.mark == "illustrative":
        assert len(block.word) > 10, "say why it is only an illustration"
    elif block.language == "sh":
        for line in filter(None, map(str.strip, block.text.splitlines())):
            words = shlex.split(line, comments=True)
            is_make = words[0] == "make" and set(words[1:]) <= TARGETS
            assert line.startswith("cgwm ") or is_make, line
    elif block.language == "python":
        assert block.mark == "run", "run it, or mark it as illustrative"
    if block.language == "python":
        compile(block.text, block.place, "exec")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `capture`, `model`, `dataset`, and poses in other formats."""
    root = tmp_path_factory.mktemp("docs")
    model = write_small_model(root / "model")
    config = SynthesizeConfig(rollouts=4, duration_s=0.3, width=32, height=24, device="cpu", seed=3)
    synthesize(model, root / "dataset", config)
    capture = root / "capture"
    capture.mkdir()
    (capture / "capture.toml").write_text(MANIFEST)
    times = [0.02 * k for k in range(15)]
    rows = [f"{t},cube,{0.2 * t},0,{0.4 - 4.9 * t**2},1,0,0,0" for t in times]
    text = "\n".join(["time_s,body,px_m,py_m,pz_m,qw,qx,qy,qz", *rows]) + "\n"
    (capture / "tracks").mkdir()
    (root / "tracks").mkdir()
    for name in ("000", "001"):
        (capture / "tracks" / f"{name}.csv").write_text(text)
        (root / "tracks" / f"{name}.csv").write_text(text)
    return root


RUN = [block for block in BLOCKS if block.mark == "run"]


def test_there_are_blocks_to_run() -> None:
    assert {block.language for block in RUN} == {"sh", "python"}
    assert {block.word for block in RUN} <= FOLDERS


def shell_block(block: Block) -> object:
    """Return a block of commands as a parameter; each format of an export has its tests in the suite."""
    marks = pytest.mark.evidence if block.place.startswith("docs/exports.md") else ()
    return pytest.param(block, id=block.place, marks=marks)


@pytest.mark.parametrize("block", [shell_block(block) for block in RUN if block.language == "sh"])
def test_the_commands_run(
    block: Block, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every command of the block ends with exit code 0, in a folder with a tiny capture, model and dataset."""
    monkeypatch.chdir(shutil.copytree(folder, tmp_path / "folder"))
    monkeypatch.setenv("CGWM_QUIET", "")
    monkeypatch.setattr("logging.disable", lambda level: None)
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = {number: signal.getsignal(number) for number in signals}
    try:
        for line in filter(None, map(command_in, block.text.splitlines())):
            with warnings.catch_warnings(), pytest.raises(SystemExit) as ended:
                main(words_of(line))
            assert not ended.value.code, (line, capfd.readouterr().err)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("block", [block for block in RUN if block.language == "python"], ids=lambda block: block.place)
def test_the_code_runs(block: Block, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    exec(compile(block.text, block.place, "exec"), {"__name__": "block"})


# Links and paths


def test_every_link_leads_to_a_file_and_a_heading() -> None:
    """`make docs` checks the pages; the README is no page of the site."""
    wrong = []
    for page, text in TEXTS.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.S)):
            name, _, anchor = target.partition("#")
            if name.startswith(("http", "api/")):
                continue
            path = (PAGES[page].parent / name) if name else PAGES[page]
            if not path.exists() or (anchor and anchor not in anchors_of(path)):
                wrong.append(f"{page}: {target}")
    assert wrong == []


def anchors_of(path: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


@pytest.mark.parametrize("page", ["docs/architecture.md", "docs/contributing.md"])
def test_every_module_that_is_named_exists(page: str) -> None:
    named = {name for name in re.findall(r"`([\w/]+\.py)`", TEXTS[page]) if "/" in name}
    assert len(named) >= 8
    below = (ROOT, ROOT / "pipeline")
    assert [name for name in sorted(named) if not any((folder / name).exists() for folder in below)] == []


def test_every_threshold_is_where_the_map_says() -> None:
    (line,) = [one for one in TEXTS["docs/architecture.md"].splitlines() if "which threshold decides" in one]
    named = re.findall(r"`(\w+)\.(\w+)`", line)
    assert len(named) >= 4
    assert [name for name in named if not hasattr(getattr(THRESHOLDS, name[0]), name[1])] == []

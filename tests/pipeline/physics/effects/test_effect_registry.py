"""Effects by name, by file and by package; `cgwm effects`; and what the docs say of them."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cgwm.pipeline.physics import simulate
from cgwm.pipeline.physics.effects import ActiveEffect, Effect, effect_names, load_effect
from cgwm.pipeline.physics.effects import effect as module
from cgwm.pipeline.physics.effects.catalogue import list_effects, new_effect, show_effect
from cgwm.pipeline.physics.effects.registry import BUILT_IN, FLIGHT_ALIASES
from cgwm.schemas import UsageError
from cgwm.schemas.effects import EffectCard, EffectList
from helpers.commands import cgwm
from helpers.worlds import ball_body, batch, state_of, times, world_of

DOCS = Path(__file__).resolve().parents[4] / "docs" / "effects.md"

OWN = """
from cgwm.pipeline.physics.effects import Effect, EffectParameter, Wrench

class Lift(Effect):
    name = "lift"
    summary = "A steady lift."
    formula = "a = b e_z"
    parameters = (EffectParameter("b", "m/s2", scale=0.1, limit=10.0),)
    phase = "flight"
    reveals = "flight"
    source = "a test"

    def wrench(self, values, motion):
        return Wrench(force=(values["b"] * motion.mass)[:, None] * motion.up)
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(OWN)
    return path


def test_an_effect_of_ones_own_works_in_a_rollout(own: Path) -> None:
    effect = load_effect(f"{own}:Lift")
    assert isinstance(effect, Effect)
    world = replace(world_of(ball_body(), gravity=9.81), effects=(ActiveEffect.of(effect, {"b": 2.0}),))
    rollout = simulate(world, state_of(((0, 0, 5.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))), times(0.1))
    torch.testing.assert_close(rollout.velocity_m_s[0, -1, 0], 0.1 * batch([0.0, 0.0, -7.81])[0], rtol=0, atol=1e-9)


def test_an_effect_of_an_installed_package_is_found(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "lifts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lifts\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[cgwm.effects]\nlift = own:Lift\nbroken = nowhere:Lift\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert effect_names() == [*BUILT_IN, "broken", "lift"]
    assert load_effect("lift").formula == "a = b e_z"
    assert refused("broken") == (
        "effect 'broken' (nowhere:Lift): cannot be imported: ModuleNotFoundError: No module named 'nowhere'.\n"
        "Next: repair or remove the package that provides it."
    )


def refused(spec: str) -> str:
    with pytest.raises(UsageError) as error:
        load_effect(spec)
    return str(error.value)


def test_an_unknown_effect_is_refused_with_the_nearest_name() -> None:
    message = refused("linear_darg")
    assert message.startswith("there is no effect 'linear_darg'.\nAllowed: linear_drag, quadratic_drag, magnus_lift, ")
    assert message.endswith(
        "marker_offset, or a file of your own as path/to/file.py:ClassName. Did you mean 'linear_drag'?\n"
        "Next: run 'cgwm effects list'."
    )


def test_wrong_files_are_refused(own: Path, tmp_path: Path) -> None:
    assert refused(f"{tmp_path}/none.py:Lift") == (
        f"{tmp_path}/none.py: no such file.\nNext: write one with 'cgwm effects new FILE'."
    )
    name = "\nNext: name one of these classes after the colon."
    assert refused(str(own)) == f"{own}: names no class.\nAllowed: {own}:Lift.{name}"
    found = refused(f"{own}:Lfit")
    assert found == f"{own}:Lfit: has no class 'Lfit'.\nAllowed: {own}:Lift. Did you mean 'Lift'?{name}"
    assert refused(f"{own}:Wrench") == (
        f"{own}:Wrench: not an effect.\nAllowed: a subclass of cgwm.pipeline.physics.effects.Effect."
        "\nNext: derive the class from Effect, as 'cgwm effects new FILE.py' does."
    )
    own.write_text("x = 1\n")
    assert refused(f"{own}:Lift") == (
        f"{own}:Lift: the file holds no effect.\nNext: write a subclass of Effect, as 'cgwm effects new FILE' does."
    )
    own.write_text("x = 1\nclass Lift(:\n")
    message = refused(f"{own}:Lift")
    assert message.startswith(f"{own}, line 2: cannot be imported: SyntaxError: ")
    assert message.endswith("\nNext: correct the file.")


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('"A steady lift."', '""', "its summary is ''; it is a text"),
        ('    source = "a test"\n', "", "its source is missing; it is a text"),
        ('"flight"\n    reveals', '"air"\n    reveals', "its phase is 'air'; legal are flight, contact, measurement"),
        ("scale=0.1", "scale=0.0", "b has scale 0.0 and limit 10.0; it takes 0 < scale <= limit, both finite"),
        ("scale=0.1", "scale=20.0", "b has scale 20.0 and limit 10.0; it takes 0 < scale <= limit, both finite"),
        ('EffectParameter("b"', 'EffectParameter("b c"', "'b c' is no name of a number"),
        (
            '(EffectParameter("b", "m/s2", scale=0.1, limit=10.0),)',
            "()",
            "its parameters are not a tuple of at least one",
        ),
        (
            '(EffectParameter("b", "m/s2", scale=0.1, limit=10.0),)',
            '("b",)',
            "'b' is neither an EffectParameter nor, among the",
        ),
        ("limit=10.0),)", "limit=10.0),) * 2", "two of its numbers are called 'b'"),
        ("def wrench", "def wrnech", "it has none of the methods world, flow, wrench, contact, times, observe"),
        (
            "    phase",
            '    needs = ("luck",)\n    phase',
            "it needs 'luck'; legal are ground, drag, contact, spin, unmeasured_spin, orientation, driven",
        ),
    ],
)
def test_a_bad_declaration_is_refused(own: Path, old: str, new: str, fault: str) -> None:
    assert OWN.count(old) == 1
    own.write_text(OWN.replace(old, new))
    message = refused(f"{own}:Lift")
    assert message.startswith(f"{own}:Lift: badly declared: {fault}")
    assert message.endswith("\nNext: compare it with what 'cgwm effects new' writes.")


def test_a_class_that_wants_arguments_is_refused(own: Path) -> None:
    own.write_text(OWN + "\n    def __init__(self, more):\n        pass\n")
    assert "Lift: cannot be made: TypeError: " in refused(f"{own}:Lift")


def test_the_built_in_effects_are_the_files_of_the_folder() -> None:
    folder = Path(module.__file__).parent
    others = {"__init__", "catalogue", "effect", "recording", "registry", "residual_wrench", "template", "trust"}
    assert sorted(path.stem for path in folder.glob("*.py") if path.stem not in others) == sorted(BUILT_IN)


# In the suite: a measurement of imports; cgwm --help is held to its time in test_cli.py.
@pytest.mark.evidence
def test_one_effect_is_imported_without_the_others() -> None:
    code = (
        "import sys; from cgwm.pipeline.physics.effects import load_effect; load_effect('wind'); "
        "print([n for n in sys.modules if n.startswith('cgwm.pipeline.physics.effects.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = {name.rpartition(".")[2] for name in quoted(done.stdout)}
    assert names == {"effect", "recording", "registry", "trust", "wind"}


def quoted(text: str) -> list[str]:
    return re.findall("'([^']*)'", text)


# The command


def test_the_list_has_every_effect() -> None:
    done = cgwm("effects", "list", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found = EffectList.model_validate_json(done.stdout)
    assert tuple(card.name for card in found.effects) == BUILT_IN
    assert found == list_effects()


def test_an_effect_is_shown_with_what_it_can_be_mistaken_for() -> None:
    done = cgwm("effects", "show", "ground_magnet")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == [
        "ground_magnet: An attraction by the ground, magnetic or electrostatic, that fades with the height.",
        "  a = -A exp(-h / l) n, h the height of the lowest sphere",
        "  parameter  unit  sign          scale  at most",
        "  A          m/s2  not negative      1      100",
        "  constant  unit  tried at",
        "  l         m     each of 0.01, 0.02, 0.05, 0.1",
        "  acts in                     flight",
        "  needs                       ground",
        "  shown best by               low bounces and slow passes just over the ground, and flights high above it",
        "  in free flight the same as  no other effect",
        "  source                      a stand-in with one range for the fields of magnets and charges",
    ]
    card = EffectCard.model_validate_json(cgwm("effects", "show", "wind", "--json").stdout)
    assert card.aliases == (
        "at a fixed drag: gravity_tilt",
        "at a fixed drag: frame_tilt",
        "at a fixed drag: constant_force (horizontal)",
    )
    assert show_effect("com_offset").aliases == ("marker_offset",)
    assert {name for group in FLIGHT_ALIASES for name in group} <= set(BUILT_IN)


def test_an_unknown_effect_ends_the_command_with_2() -> None:
    done = cgwm("effects", "show", "winde", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("there is no effect 'winde'.\n")
    assert "Did you mean 'wind'?" in done.stderr


def test_the_template_runs_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    done = cgwm("effects", "new", path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"Wrote {path}.\nNext: edit it, then cgwm effects show {path}:MyEffect\n"
    assert show_effect(f"{path}:MyEffect").phase == "flight"
    effect = ActiveEffect.of(load_effect(f"{path}:MyEffect"), {"w": 4.0})
    world = replace(world_of(ball_body(), ground=False), effects=(effect,))
    rollout = simulate(world, state_of(((0.1, 0.0, 1.0), (1, 0, 0, 0), (0, 0, 0), (0, 0, 0))), times(0.1))
    assert -0.04 < float(rollout.velocity_m_s[0, -1, 0, 0]) < -0.02


def test_the_template_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text("mine")
    with pytest.raises(UsageError) as error:
        new_effect(path)
    assert str(error.value) == f"{path} exists.\nNext: choose another name or pass --overwrite."
    assert path.read_text() == "mine"
    with pytest.raises(UsageError, match="no effect template of cgwm, or was changed"):
        new_effect(path, overwrite=True)
    assert path.read_text() == "mine"
    new_effect(tmp_path / "new.py")
    assert "class MyEffect(Effect):" in (tmp_path / "new.py").read_text()
    new_effect(tmp_path / "new.py", overwrite=True)
    with (tmp_path / "new.py").open("a") as file:
        file.write("# mine\n")
    with pytest.raises(UsageError, match="was changed"):
        new_effect(tmp_path / "new.py", overwrite=True)
    with pytest.raises(UsageError) as error:
        new_effect(tmp_path / "mine.txt")
    assert str(error.value) == (
        f"{tmp_path}/mine.txt: an effect is a Python file.\nAllowed: a name that ends with .py.\n"
        "Next: end the name with .py: cgwm effects new FILE.py."
    )


# The docs


def test_the_docs_say_of_every_effect_what_the_command_says() -> None:
    text = DOCS.read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| `") and "(values, " not in line]
    assert rows == [docs_row(card) for card in list_effects().effects]


def docs_row(card: EffectCard) -> str:
    """Return the row of an effect in docs/effects.md."""
    numbers = [f"{p.name} [{p.unit}]{' ≥ 0' if p.sign == 'nonnegative' else ''}" for p in card.parameters]
    numbers += [f"{c.name} [{c.unit}] on a grid" for c in card.constants]
    if len(numbers) > 8:
        numbers = [f"{numbers[0]} to {numbers[len(card.parameters) - 1]}", *numbers[len(card.parameters) :]]
    formula = card.formula.replace("|", "\\|")
    return f"| `{card.name}` | {formula} | {', '.join(numbers)} | {card.reveals} |"

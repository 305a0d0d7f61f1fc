"""`fit --resume` of a finished model: kept where the same would be made, refused where it would not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from cgwm.datasets.capture.capture import Capture
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.fit_inputs import motion_inputs, photo_inputs
from cgwm.datasets.models.model import read_model, write_model
from cgwm.pipeline import fit as fitting
from cgwm.pipeline.phys_geo.effects.requested_effects import with_effects
from cgwm.pipeline.physics.effects.trust import _VARIABLE, is_trusted
from cgwm.pipeline.runtime.checkpoint import Checkpoint
from cgwm.schemas import CgwmError, EffectModel, ModelFile, PhysConfig, SplatConfig, UsageError
from helpers.small_model import small_model
from helpers.tiny_capture import thrown, with_tracks, write_tiny_capture
from pipeline.physics.effects.test_trust import template

Change = Callable[[Path, dict], object]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a capture and an effect; what takes long in a fit is left out, and counted."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv(_VARIABLE, "")
    write_tiny_capture(tmp_path / "capture")
    with_tracks(tmp_path / "capture", thrown())
    (tmp_path / "mine.py").write_text(template())
    write_model(tmp_path / "parent", small_model())

    def fitted(request, *_):
        (tmp_path / "fits").open("a").write("x")
        model = small_model()
        effects = with_effects((), request.phys_config.effects)
        return replace(model, file=model.file.model_copy(update={"effects": effects}))

    monkeypatch.setattr(fitting, "_fitted_model", fitted)
    return tmp_path


def fit(place: Path, **changed: object) -> tuple[ModelFile, bool]:
    given = {"stage": "all", "splat_config": SplatConfig(), "phys_config": physics(place), "resume": True} | changed
    return fitting.fit_or_keep(place / "capture", place / "model", **given)


def physics(place: Path) -> PhysConfig:
    return PhysConfig(effects=(f"{place / 'mine.py'}:MyEffect",))


def fits(place: Path) -> int:
    return len((place / "fits").read_text())


def test_the_same_fit_keeps_a_finished_model(place: Path) -> None:
    made, kept = fit(place)
    before, written = sha256(place / "model"), (place / "model" / "model.json").stat().st_mtime_ns
    assert not kept and fits(place) == 1
    assert fit(place)[1] and fit(place, overwrite=True)[1] and fits(place) == 1
    assert (sha256(place / "model"), (place / "model" / "model.json").stat().st_mtime_ns) == (before, written)
    (place / "model" / "thesis.txt").write_text("mine")  # nothing is written, so nothing of the user's is lost
    again, kept = fit(place)
    assert kept and again.provenance == made.provenance and again.bodies == made.bodies


def append(name: str, text: str = "\n") -> Change:
    def change(place: Path, given: dict) -> None:
        with (place / name).open("a") as file:
            file.write(text)

    return change


def other(**settings: object) -> Change:
    return lambda place, given: given.update(phys_config=PhysConfig(), **settings)


CHANGES: dict[str, tuple[Change, str]] = {
    "the seed": (other(splat_config=SplatConfig(seed=3)), "sg-gs.seed (0, here 3)"),
    "the effects": (other(), "phys-geo.effects"),
    "the stage": (other(stage="sg-gs"), "stage ('all', here 'sg-gs')"),
    "a parent": (lambda place, given: given.update(parent=place / "parent"), "parent model"),
    "a setting of the photos": (
        lambda place, given: given.update(splat_config=SplatConfig(iterations=7)),
        "sg-gs.iterations",
    ),
    "a track": (append("capture/tracks/000.csv"), "tracks/000.csv"),
    "the manifest": (append("capture/capture.toml", "# more\n"), "capture.toml"),
    "a photo": (append("capture/images/more.txt"), "images"),
    "the source of an effect": (append("mine.py", "# more\n"), "mine.py:MyEffect"),
}

LATE = ("the seed", "the stage", "the manifest", "a photo")
"""Changes whose like is tested in the suite: another setting, another file."""


@pytest.mark.parametrize(
    "change", [pytest.param(name, marks=pytest.mark.evidence if name in LATE else ()) for name in CHANGES]
)
def test_a_finished_model_of_others_is_refused_and_named(place: Path, change: str) -> None:
    if change == "a photo":
        (place / "capture" / "images").mkdir(exist_ok=True)
    fit(place)
    before, given = sha256(place / "model"), {}
    CHANGES[change][0](place, given)
    with pytest.raises(UsageError) as refusal:
        fit(place, **given)
    message = str(refusal.value)
    assert "model is complete, and was made with other" in message and CHANGES[change][1] in message
    assert "\nNext: " in message and fits(place) == 1 and sha256(place / "model") == before
    assert not fit(place, overwrite=True, **given)[1] and fits(place) == 2  # who says so gets another one
    assert fit(place, **given)[1]


def test_what_a_killed_process_left_out_is_made_up_for(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "_complete", killed)
        with pytest.raises(KeyboardInterrupt):
            fit(place)
    capture = Capture.open(place / "capture", splits=("train",))
    made_of = photo_inputs(capture, SplatConfig()) | motion_inputs(capture, None, "train", physics(place))
    checkpoint = Checkpoint(place / "model.checkpoint", made_of)
    checkpoint.write("background", {"k": 1})
    monkeypatch.setenv(_VARIABLE, "")
    assert not is_trusted(sha256(place / "mine.py"))
    assert fit(place)[1] and not checkpoint.path.exists()
    monkeypatch.setenv(_VARIABLE, "")
    assert is_trusted(sha256(place / "mine.py"))
    others = Checkpoint(checkpoint.path, made_of | {"settings": "others"})
    others.write("background", {"k": 1})  # of an interrupted fit with --overwrite
    assert fit(place)[1] and others.path.exists()


def test_a_model_of_a_stranger_gains_no_trust_by_resuming(place: Path) -> None:
    fit(place)
    model = read_model(place / "model")
    other = place / "other.py"
    other.write_text(template().replace('"my_effect"', '"other_effect"').replace("MyEffect", "Other"))
    planted = EffectModel(name=f"{other}:Other", sha256=sha256(other))
    effects = (*model.file.effects, planted)
    write_model(place / "planted", replace(model, file=model.file.model_copy(update={"effects": effects})))
    (place / "planted").rename(place / "model2")
    fitting.fit_or_keep(place / "capture", place / "model2", phys_config=physics(place), resume=True)
    assert is_trusted(sha256(place / "mine.py")) and not is_trusted(sha256(other))


def test_a_damaged_finished_model_is_an_error_and_stays(place: Path) -> None:
    fit(place)
    (place / "model" / "model.json").write_text("{")
    before = sha256(place / "model")
    with pytest.raises(CgwmError, match=r"model\.json"):
        fit(place)
    assert sha256(place / "model") == before

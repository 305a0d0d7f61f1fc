"""The Python of a stranger's model or dataset is not run without consent."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from cgwm.cli import main
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.models.model import read_model, write_model
from cgwm.pipeline.phys_geo.effects.requested_effects import with_effects
from cgwm.pipeline.physics.effects import load_effect, trust_effects
from cgwm.pipeline.physics.effects.registry import effect_of
from cgwm.pipeline.physics.effects.trust import _VARIABLE, keep_trust, trusted_effects
from cgwm.pipeline.synthesize import shards, stage, synthesize
from cgwm.schemas import EffectModel, InputDataError, SynthesizeConfig, UsageError
from helpers.small_model import small_model

SMALL = ("--set", "synthesize.width=20", "--set", "synthesize.height=16", "--set", "synthesize.duration_s=0.1")
TINY = SynthesizeConfig(rollouts=2, duration_s=0.1, width=20, height=16)


def template() -> str:
    text = Path(__file__).parents[4].joinpath("pipeline/physics/effects/template.py").read_text(encoding="utf-8")
    return text.replace("from .effect import", "from cgwm.pipeline.physics.effects import")


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A model from elsewhere with an effect of its own, which leaves a witness when it is run."""
    monkeypatch.setenv(_VARIABLE, "")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    source = tmp_path / "author" / "lift.py"
    source.parent.mkdir()
    source_text = f"{template()}\n\nfrom pathlib import Path\n\nPath({str(tmp_path / 'ran')!r}).touch()\n"
    source.write_text(source_text)
    model = small_model()
    effect = EffectModel(name=f"{source}:MyEffect", parameters={"w": 0.5, "r": 0.2})
    write_model(tmp_path / "model", replace(model, file=model.file.model_copy(update={"effects": (effect,)})))
    shutil.rmtree(source.parent)
    return tmp_path / "model"


def ran(model: Path) -> bool:
    return (model.parent / "ran").exists()


def test_the_source_lies_in_the_model_with_its_hash(stranger: Path) -> None:
    entry = json.loads((stranger / "model.json").read_text())["effects"][0]
    assert entry["name"] == "effects/lift.py:MyEffect"
    assert entry["sha256"] == hashlib.sha256((stranger / "effects" / "lift.py").read_bytes()).hexdigest()
    assert read_model(stranger).file.effects[0].name == f"{stranger / 'effects' / 'lift.py'}:MyEffect"
    assert not ran(stranger)


def call(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.mark.parametrize(
    "arguments",
    [
        pytest.param(["synthesize", "MODEL", "--out", "OUT", "--rollouts", "2", *SMALL], marks=pytest.mark.evidence),
        ["export", "MODEL", "--to", "mjcf", "--out", "OUT.xml"],
        ["validate", "MODEL"],
    ],
)
def test_nothing_runs_without_consent(stranger: Path, arguments: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    words = [word.replace("MODEL", str(stranger)).replace("OUT", str(stranger.parent / "out")) for word in arguments]
    code = call(*words)
    said = capfd.readouterr()
    assert not ran(stranger)
    if arguments[0] == "validate":
        assert (code, "effects/lift.py:MyEffect" in said.out + said.err) == (0, True)
        return
    assert code == 2
    source = stranger / "effects" / "lift.py"
    assert str(source) in said.err and hashlib.sha256(source.read_bytes()).hexdigest() in said.err
    assert f"--trust-effects {source}" in said.err
    assert call(*words, "--trust-effects", source) == 0
    assert ran(stranger)


def hash_of(model: Path) -> str:
    return hashlib.sha256((model / "effects" / "lift.py").read_bytes()).hexdigest()


@pytest.mark.parametrize(
    "consent", [pytest.param(lambda m: m, marks=pytest.mark.evidence), lambda m: m / "effects" / "lift.py", hash_of]
)
def test_consent_is_to_a_model_a_file_or_a_hash(stranger: Path, consent: Callable[[Path], object]) -> None:
    with pytest.raises(InputDataError, match="nobody has consented"):
        synthesize(stranger, stranger.parent / "ds", TINY)
    trust_effects([str(consent(stranger))])
    synthesize(stranger, stranger.parent / "ds", TINY)
    assert ran(stranger)


def test_a_model_of_ones_own_needs_no_word(stranger: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_trust(read_model(stranger).file.effects)
    monkeypatch.setenv(_VARIABLE, "")  # as in a later process
    synthesize(stranger, stranger.parent / "ds", TINY)
    store = stranger.parent / "state" / "cgwm" / "trusted-effects"
    assert store.stat().st_mode & 0o777 == 0o600
    store.chmod(0o666)  # now somebody else could have written it
    with pytest.raises(InputDataError, match="nobody has consented"):
        synthesize(stranger, stranger.parent / "ds2", TINY)


def test_an_edit_while_the_work_goes_on_changes_neither_what_is_run_nor_what_is_packed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(_VARIABLE, "")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    source = tmp_path / "pull.py"
    source.write_text(template())
    began = sha256(source)
    effects = with_effects((), [f"{source}:MyEffect"])
    source.write_text(template().replace("A pull", "Another pull"))
    assert effect_of(effects[0]).summary.startswith("A pull")
    model = small_model()
    write_model(tmp_path / "model", replace(model, file=model.file.model_copy(update={"effects": effects})))
    assert sha256(tmp_path / "model" / "effects" / "pull.py") == began == effects[0].sha256
    keep_trust(effects)
    assert (tmp_path / "state" / "cgwm" / "trusted-effects").read_text() == f"{began}\n"
    assert load_effect(f"{source}:MyEffect").summary.startswith("Another pull")  # who names a file means what it is now


def test_a_source_that_another_process_finds_changed_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "pull.py"
    source.write_text(template())
    effect = EffectModel(name=f"{source}:MyEffect", sha256="0" * 64)
    with pytest.raises(InputDataError, match="its content has changed since"):
        effect_of(effect)


def test_workers_on_other_machines_get_the_consent(stranger: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert trusted_effects(stranger) == ()
    trust_effects([str(stranger)])
    consent = trusted_effects(stranger)
    assert consent == (hash_of(stranger),)
    monkeypatch.setenv(_VARIABLE, "")  # as on another machine
    call = (str(stranger), str(stranger.parent / "ds"), TINY, False, False, False)
    refused = shards._task(*call)
    assert isinstance(refused, InputDataError) and not ran(stranger)
    assert not isinstance(shards._task(*call, consent), InputDataError) and ran(stranger)


def test_a_model_that_changes_meanwhile_is_not_packed_with_the_rollouts(
    stranger: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trust_effects([str(stranger)])
    count, draw = [0], stage.draw_rollout

    def drawn(*given: object) -> object:
        count[0] += 1
        (stranger / "note.txt").write_text(str(count[0]))
        return draw(*given)

    monkeypatch.setattr(stage, "draw_rollout", drawn)
    with pytest.raises(InputDataError, match="was changed while its rollouts were made"):
        synthesize(stranger, stranger.parent / "ds", TINY)
    assert not (stranger.parent / "ds").exists()


def test_another_content_than_the_recorded_one_is_refused(stranger: Path) -> None:
    trust_effects([str(stranger)])
    with (stranger / "effects" / "lift.py").open("a") as file:
        file.write("# changed\n")
    with pytest.raises(InputDataError, match="another content than when the model was written"):
        read_model(stranger)
    assert not ran(stranger)


@pytest.mark.parametrize("name", ["/tmp/x.py:X", "../x.py:X", "effects/../../x.py:X", "mine.py:X", "effects/a/b.py:X"])
def test_a_file_outside_of_the_model_is_refused(stranger: Path, name: str) -> None:
    text = (stranger / "model.json").read_text().replace("effects/lift.py:MyEffect", name)
    (stranger / "model.json").write_text(text)
    with pytest.raises(InputDataError, match="its file lies outside of the model"):
        read_model(stranger)


def test_a_compiled_file_next_to_it_is_not_run(stranger: Path) -> None:
    trust_effects([str(stranger)])
    planted = stranger.parent / "planted"
    cache = stranger / "effects" / "__pycache__"
    cache.mkdir()
    for file in cache.parent.glob("*.py"):
        (cache / f"{file.stem}.cpython-311.pyc").write_bytes(b"planted")
    synthesize(stranger, stranger.parent / "ds", TINY)
    assert not planted.exists() and ran(stranger)


def test_validate_of_a_dataset_runs_nothing_and_says_what_it_did_not_check(
    stranger: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = stranger.parent / "ds"
    trust_effects([str(stranger)])
    synthesize(stranger, dataset, TINY)
    (stranger.parent / "ran").unlink()
    monkeypatch.setenv(_VARIABLE, "")
    capfd.readouterr()
    call("validate", dataset, "--json")
    report = json.loads(capfd.readouterr().out)
    assert report["facts"]["motion_not_checked_with_effects"] == ["effects/lift.py:MyEffect"]
    shard = next(dataset.glob("*.h5"))
    with h5py.File(shard, "r+") as file:
        file["data/demo_0"].attrs["effects_json"] = '{"/tmp/evil.py:Evil": {}}'
    manifest = json.loads((dataset / "dataset.json").read_text())
    manifest["shards"][0] |= {"sha256": sha256(shard), "bytes": shard.stat().st_size}
    (dataset / "dataset.json").write_text(json.dumps(manifest))
    call("validate", dataset, "--json")
    said = capfd.readouterr()
    assert said.out, said.err
    report = json.loads(said.out)
    assert any("are not among those of the dataset's model" in fault for fault in report["faults"])
    assert not ran(stranger)


def test_attributes_that_are_no_json_are_a_fault(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_model(tmp_path / "model", small_model())
    synthesize(tmp_path / "model", tmp_path / "ds", TINY)
    shard = next((tmp_path / "ds").glob("*.h5"))
    for text in ("{", "[1]", "", "[" * 60_000):
        with h5py.File(shard, "r+") as file:
            file["data/demo_0"].attrs["effects_json"] = text
        manifest = json.loads((tmp_path / "ds" / "dataset.json").read_text())
        manifest["shards"][0] |= {"sha256": sha256(shard), "bytes": shard.stat().st_size}
        (tmp_path / "ds" / "dataset.json").write_text(json.dumps(manifest))
        assert call("validate", tmp_path / "ds") == 1, text[:9]
        assert "effects_json is no JSON object" in capfd.readouterr().out, text[:9]


def test_what_is_no_effect_is_refused() -> None:
    with pytest.raises(UsageError, match="no effect is known by this"):
        trust_effects(["nothing"])

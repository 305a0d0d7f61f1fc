"""Files of well-formed text with values that cannot be: one message with file and field, for every schema."""

import copy
import json
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cgwm.cli.settings import StageSettings
from cgwm.schemas import (
    CalibrateConfig,
    CamerasFile,
    CaptureManifest,
    DatasetManifest,
    FileModel,
    FitFile,
    InputDataError,
    PhysConfig,
    SamplingPlan,
    SplatConfig,
    SynthesizeConfig,
    parse,
    plan_toml,
    read_json,
    read_plan,
    read_toml,
)
from cgwm.schemas.base import _in_document
from cgwm.schemas.diagnose import ThrowsFile
from cgwm.schemas.documents import MAX_DEPTH, parse_json, parse_toml
from cgwm.schemas.field_texts import field_texts
from cgwm.schemas.plan import RejectionRules

CAPTURE = """format = "cgwm-capture/1"
[world]
gravity_m_s2 = [0.0, 0.0, -9.81]
ground = { normal = [0.0, 0.0, 1.0], offset_m = 0.0 }
[[bodies]]
name = "cube"
mass_kg = 0.37
com_m = [0.0, 0.0, 0.0]
inertia_kg_m2 = [1e-3, 1e-3, 1e-3]
shape = { box = { half_extents_m = [0.05, 0.05, 0.05] } }
photo_box = { min_m = [-0.1, -0.1, 0.0], max_m = [0.1, 0.1, 0.1] }
[measurement]
position_std_m = 0.001
rotation_std_rad = 0.01
[splits]
train = ["000"]
[episodes.000]
group = "monday"
start_s = 0.0
end_s = 1.5
[video]
frame_rate_hz = 30.0
camera_time_offset_s = { left = 0.1 }
[calibration]
markers = [{ id = 7, side_m = 0.08, pose = { position_m = [0.2, 0.0, 0.0] } }]
"""
POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
CAMERAS = {
    "format": "cgwm-cameras/1",
    "scale": {"kind": "metric", "relative_std": 0.01},
    "cameras": {"c": {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}},
    "images": {"a.png": {"camera": "c", "T_world_cam": POSE}},
    "videos": {"left": {"camera": "c", "T_world_cam": [POSE, POSE]}},
}
SHARD = {"file": "a.h5", "index": 0, "sha256": "a", "bytes": 9, "rollouts": 3, "frames": 3, "rejected": {"off": 1}}
DATASET = {"model_sha256": "a", "config": {}, "rollouts": 3, "shard_count": 1, "shards": [SHARD], "bodies": ["cube"]}
PLAN = tomllib.loads(plan_toml(SamplingPlan(), comments=False)) | {
    "height_m": [0.1, 0.2],
    "parameters": {"friction": {"normal": [0.3, 0.1]}},
}
THROWS = {"throws": [{"height_m": [0.1], "heading_deg": [0], "spin_axis": ["up"], "duration_s": 0.5}]}
DOCUMENTS: list[tuple[type[FileModel], dict[str, Any]]] = [
    (CaptureManifest, tomllib.loads(CAPTURE)),
    (CamerasFile, CAMERAS),
    (DatasetManifest, DATASET),
    (SamplingPlan, PLAN),
    (ThrowsFile, THROWS),
    *(
        (config, json.loads(config().model_dump_json(exclude_none=True)))
        for config in (CalibrateConfig, SplatConfig, PhysConfig, SynthesizeConfig)
    ),
]
WRONG_NUMBERS: tuple[Any, ...] = (True, "-9.81", "", [], {}, 10**250)
WRONG_TEXTS: tuple[Any, ...] = (True, 5, 1.5, [], {}, "\0")


def leaves(value: Any, place: tuple = ()) -> Iterator[tuple[tuple, Any]]:
    """Yield all scalars of a document with their places."""
    if isinstance(value, dict | list):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(entry, (*place, key))
    else:
        yield place, value


def changed(document: Any, place: tuple, value: Any) -> Any:
    """Return a copy with another value at a place."""
    document = copy.deepcopy(document)
    holder = document
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = value
    return document


def refused(model: type[FileModel], text: str, name: str = "file.json") -> str:
    """Return the message with which a JSON text is refused."""
    with pytest.raises(InputDataError) as caught:
        parse(parse_json(text, name), model, name, text)
    message = str(caught.value)
    assert message.startswith(name) and len(message) < 1500, message
    return message


DECIDED_BY_HAND = ("mass_distribution", "length_scale")
"""Settings that are auto, true or false."""


@pytest.mark.parametrize(("model", "document"), DOCUMENTS, ids=lambda found: getattr(found, "__name__", ""))
def test_every_scalar_is_taken_by_its_type(model: type[FileModel], document: dict[str, Any]) -> None:
    parse(parse_json(json.dumps(document), "file.json"), model, "file.json")
    count = 0
    for place, value in leaves(document):
        is_number = isinstance(value, float | int) and not isinstance(value, bool)
        wrong = WRONG_NUMBERS if is_number else (0, 1, "true") if isinstance(value, bool) else WRONG_TEXTS
        for other in wrong:
            if value == "auto" and isinstance(other, bool) and place[-1] in DECIDED_BY_HAND:
                continue
            message = refused(model, json.dumps(changed(document, place, other), indent=1))
            assert str(place[-1]) in message or str(place[-2]) in message or str(place[0]) in message, (place, message)
            count += 1
    assert count > 4


def test_an_integer_serves_as_a_number_and_a_whole_number_as_an_integer() -> None:
    document = changed(CAMERAS, ("cameras", "c", "width"), 640.0)
    camera = parse(parse_json(json.dumps(document), "f"), CamerasFile, "f").cameras["c"]
    assert (camera.width, type(camera.width), camera.fx, type(camera.fx)) == (640, int, 500.0, float)
    assert "valid integer (found 640.5)" in refused(
        CamerasFile, json.dumps(changed(CAMERAS, ("cameras", "c", "width"), 640.5))
    )


TEXTS = {
    "deep": ("[" * 100_000, "nested deeper than 100 levels"),
    "deep but closed": ('{"a": ' * 300 + "1" + "}" * 300, "nested deeper than 100 levels"),
    "twice": ('{"stages": {},\n"warnings": [],\n"stages": {}}', 'line 3: the key "stages" stands twice'),
    "twice inside": ('{"stages": {"a": {"b": 1, "b": 2}}}', 'line 1: the key "b" stands twice'),
    "twice among many": (
        '{"stages": {' + ", ".join(f'"k{number}": {{}}' for number in range(100_000)) + ', "k7": {}}}',
        'line 1: the key "k7" stands twice',
    ),
    "infinite": ('{"stages":\n{"a": {"loss": 1e999}}}', "line 2: stages.a.loss: input should be a finite number"),
    "no number": ('{"stages": {"a": {"loss": [NaN]}}}', "stages.a.loss.0: input should be a finite number (found NaN)"),
    "thousands of digits": (
        '{"stages":\n{"a": {"n": ' + "9" * 5000 + "}}}",
        "line 2: a number of more than 300 digits",
    ),
    "hundreds of digits": ('{"stages": {"a": {"n": ' + "9" * 400 + "}}}", "stages.a.n: a number of more than 300"),
    "half a pair": ('{"warnings": ["\\ud800"]}', "warnings.0: a text with half of a surrogate pair"),
    "half a pair as a key": ('{"stages": {"\\udc00": {}}}', "a text with half of a surrogate pair"),
    "null character": ('{"warnings": ["a\\u0000b"]}', "warnings.0: a text with a null character"),
    "a long key": ('{"' + "x" * 1_000_000 + '": 1}', "unknown field 'xxx"),
    "a long text": ('{"format": "' + "x" * 1_000_000 + '"}', "format: input should be 'cgwm-fit/1' (found \"xxx"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_json_that_no_reader_can_take(name: str) -> None:
    text, expected = TEXTS[name]
    assert expected in refused(FitFile, text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = " + "[" * 5000, "nested deeper"),
        ("a = " + "{ a = " * 5000, "nested deeper"),
        (".".join("a" * 100_000) + " = 1", "nested deeper"),
        ("[" + ".".join(['"]"'] * 100_000) + "]", "nested deeper"),
        ("b = 1\na = " + "9" * 5000, "line 2: a number of more than 300 digits"),
        ("a = 0x" + "f" * 1000, "line 1: a: a number of more than 300 digits"),
        ("[t]\na = 1e999", "line 2: t.a: input should be a finite number (found Infinity)"),
        ("a = nan", "line 1: a: input should be a finite number (found NaN)"),
        ('a = "\\u0000"', "a text with a null character"),
        ("a = 1\na = 2", "not valid TOML"),
        ("a = 2024-13-45", "not valid TOML"),
    ],
)
def test_toml_that_no_reader_can_take(text: str, expected: str) -> None:
    with pytest.raises(InputDataError) as caught:
        parse_toml(text, "file.toml")
    assert str(caught.value).startswith("file.toml") and expected in str(caught.value)


def test_what_is_legal_is_read(tmp_path: Path) -> None:
    pair = {"a": "\U0001f600", "deep": eval("[" * (MAX_DEPTH - 2) + "]" * (MAX_DEPTH - 2))}
    assert parse_json("\ufeff" + json.dumps(pair), "f") == pair
    path = tmp_path / "capture.toml"
    path.write_bytes(b"\xef\xbb\xbf" + CAPTURE.replace("\n", "\r\n").encode())
    assert read_toml(path, CaptureManifest).bodies[0].name == "cube"


@pytest.mark.parametrize(
    ("line", "other"),
    [
        ("gravity_m_s2 = [0.0, 0.0, -9.81]", "gravity_m_s2 = [0.0, 0.0, -9810.0]"),
        ("mass_kg = 0.37", "mass_kg = 1e12"),
        ("mass_kg = 0.37", "mass_kg = -0.37"),
        ("com_m = [0.0, 0.0, 0.0]", "com_m = [0.0, 1e9, 0.0]"),
        ("inertia_kg_m2 = [1e-3, 1e-3, 1e-3]", "inertia_kg_m2 = [1e-3, 1e-3, 3e-3]"),
        ("inertia_kg_m2 = [1e-3, 1e-3, 1e-3]", "inertia_kg_m2 = [1e-3, 1e-3, 1e-3, 9e-4, 0.0, 0.0]"),
        ("position_std_m = 0.001", "position_std_m = 0.0"),
        ("frame_rate_hz = 30.0", "frame_rate_hz = 1e-9"),
        ("frame_rate_hz = 30.0", "frame_rate_hz = 1e12"),
        ("start_s = 0.0", "start_s = -1e300"),
        ('name = "cube"', f'name = "{"x" * 300}"'),
    ],
)
def test_absurd_quantities_of_a_capture_are_refused_with_their_line(tmp_path: Path, line: str, other: str) -> None:
    assert line in CAPTURE
    path = tmp_path / "capture.toml"
    path.write_text(CAPTURE.replace(line, other))
    number = CAPTURE.splitlines().index(line) + 1
    with pytest.raises(InputDataError) as caught:
        read_toml(path, CaptureManifest)
    message = str(caught.value)
    assert message.startswith(f"{path}, line {number}: ") and line.partition(" ")[0] in message


@pytest.mark.parametrize(
    ("model", "place", "value"),
    [
        (SynthesizeConfig, ("rollouts",), 10**9),
        (SynthesizeConfig, ("shards",), 10**12),
        (SynthesizeConfig, ("duration_s",), 1e9),
        (SynthesizeConfig, ("frame_rate_hz",), 1e9),
        (SynthesizeConfig, ("width",), 10**6),
        (SynthesizeConfig, ("plan", "reject", "attempts"), 10**9),
        (SynthesizeConfig, ("plan", "view_shift_deg"), 1e300),
        (PhysConfig, ("step_s",), 1e-9),
        (PhysConfig, ("generations",), 10**9),
        (PhysConfig, ("seed",), -1),
        (SplatConfig, ("iterations",), 10**9),
        (SplatConfig, ("adaptive_iterations",), 10**9),
        (CalibrateConfig, ("retries",), 10**9),
        (CalibrateConfig, ("seed",), 2**40),
        (DatasetManifest, ("shard_count",), 10**12),
        (DatasetManifest, ("shards",), [SHARD, SHARD]),
        (DatasetManifest, ("shards",), [SHARD, {**SHARD, "file": "b.h5"}]),
        (DatasetManifest, ("shards", 0, "index"), 1),
        (DatasetManifest, ("shards", 0, "file"), "../a.h5"),
        (DatasetManifest, ("shards", 0, "file"), "b/a.h5"),
        (DatasetManifest, ("shards", 0, "file"), "."),
        (DatasetManifest, ("index",), {"file": "/i.h5", "sha256": "a", "bytes": 9}),
        (DatasetManifest, ("model",), "../../model"),
        (DatasetManifest, ("model",), "/model"),
        (DatasetManifest, ("model",), "..\\model"),
        (CamerasFile, ("cameras", "c", "width"), 10**12),
        (CamerasFile, ("cameras", "c", "fx"), 0),
        (CamerasFile, ("cameras", "c", "cx"), 1e6),
        (CamerasFile, ("videos", "left", "T_world_cam"), []),
        (ThrowsFile, ("throws", 0, "height_m"), [0.1] * 2000),
        (ThrowsFile, ("throws", 0), {key: [1.0] * 1000 for key in ("height_m", "speed_m_s", "heading_deg")}),
    ],
)
def test_counts_and_quantities_have_bounds(model: type[FileModel], place: tuple, value: Any) -> None:
    document = next(document for known, document in DOCUMENTS if known is model)
    refused(model, json.dumps(changed(document, place, value), indent=1))


@pytest.mark.parametrize(
    ("model", "place", "value"),
    [
        (SynthesizeConfig, ("rollouts",), 1_000_000),
        (SynthesizeConfig, ("duration_s",), 600.0),
        (DatasetManifest, ("model",), "made/of this"),
        (PhysConfig, ("step_s",), 1e-5),
        (CaptureManifest, ("bodies", 0, "mass_kg"), 1e-6),
        (CaptureManifest, ("bodies", 0, "shape"), {"sphere": {"radius_m": 50.0}}),
        (CaptureManifest, ("world", "gravity_m_s2"), [0, 0, 24.8]),
        (CaptureManifest, ("video", "frame_rate_hz"), 1_000_000),
        (CaptureManifest, ("episodes", "000"), {"start_s": 1.7e9, "end_s": 1.7e9 + 600}),
        (CamerasFile, ("cameras", "c", "cx"), -900.0),
        (CamerasFile, ("images", "a.png", "T_world_cam"), [[1, 0, 0, 4.5e5], *POSE[1:]]),
    ],
)
def test_unusual_work_is_let_through(model: type[FileModel], place: tuple, value: Any) -> None:
    document = next(document for known, document in DOCUMENTS if known is model)
    parse(parse_json(json.dumps(changed(document, place, value)), "f"), model, "f")


# In the suite: a measurement of time.
@pytest.mark.evidence
def test_a_large_file_is_read_and_refused_in_seconds(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    images = {f"{number}.png": {"camera": "c", "T_world_cam": POSE} for number in range(20_000)}
    images["9999.png"] = {"camera": "c", "T_world_cam": [["x"] * 4] * 4}
    path.write_text(json.dumps(CAMERAS | {"images": images}, indent=1))
    start = time.process_time()
    with pytest.raises(InputDataError, match=r"images\.9999\.png\.T_world_cam\.0\.0: input should be a valid number"):
        read_json(path, CamerasFile)
    assert time.process_time() - start < 20


def test_settings_and_plans_are_named(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text("[synthesize]\nrollouts = 5\n")
    settings = StageSettings({"synthesize": SynthesizeConfig}, file, ["synthesize.duration_s=true"])
    with pytest.raises(InputDataError) as caught:
        settings.configure("synthesize", SynthesizeConfig)
    assert str(caught.value).startswith(f"settings ({file}, --set synthesize.duration_s=true): synthesize.duration_s: ")
    file.write_text('[synthesize]\nrollouts = "5"\n')
    with pytest.raises(
        InputDataError, match=r"run\.toml, line 2: synthesize\.rollouts: input should be a valid integer"
    ):
        StageSettings({"synthesize": SynthesizeConfig}, file, None)
    for text in ("synthesize.rollouts=" + "9" * 5000, "synthesize.rollouts=" + "[" * 5000):
        with pytest.raises(InputDataError, match=r"synthesize\.rollouts: input should be a valid integer"):
            StageSettings({"synthesize": SynthesizeConfig}, None, [text]).configure("synthesize", SynthesizeConfig)
    file.write_text("height_m = 0.5\n")
    assert read_plan(file).source == str(file) and read_plan(file).model_copy().source == str(file)


@pytest.mark.parametrize(
    ("effects", "twice"),
    [
        (("quadratic_drag", "wind", "quadratic_drag"), "quadratic_drag"),
        (("quadratic_drag@group", "quadratic_drag"), "quadratic_drag"),
        (("quadratic_drag@group", "quadratic_drag@episode"), "quadratic_drag"),
        (("a@b/lift.py:Lift", "a@b/lift.py:Lift@group"), "a@b/lift.py:Lift"),
        (("a@b/lift.py:Lift", "a@c/lift.py:Drag", "wind", "spin_drag@group"), None),
    ],
)
def test_an_effect_is_added_once(effects: tuple[str, ...], twice: str | None) -> None:
    if twice is None:
        assert PhysConfig(effects=effects).effects == effects
        return
    with pytest.raises(InputDataError, match=f"the effect '{twice}' stands twice"):
        parse({"effects": list(effects)}, PhysConfig, "settings.toml")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("{ mass = 1 }", "world.gravity_m_s2: input should be a list.\n"),
        ("[{ mass = 1 }, 0, 0]", "world.gravity_m_s2.0: input should be a valid number.\n"),
        ('"down"', 'world.gravity_m_s2: input should be a list (found "down").\n'),
    ],
)
def test_a_wrong_value_is_shown_unless_it_is_a_table(tmp_path: Path, value: str, words: str) -> None:
    (tmp_path / "capture.toml").write_text(f'format = "cgwm-capture/1"\n[world]\ngravity_m_s2 = {value}\n')
    with pytest.raises(InputDataError) as error:
        read_toml(tmp_path / "capture.toml", CaptureManifest)
    assert f"capture.toml, line 3: {words}" in str(error.value)


def test_a_plan_to_edit_explains_each_rule_and_a_short_one_nothing() -> None:
    text, short = plan_toml(SamplingPlan()), plan_toml(SamplingPlan(), comments=False)
    assert set(field_texts(RejectionRules)) == set(RejectionRules.model_fields)
    for name, told in field_texts(RejectionRules).items():
        assert f"# {' '.join(told.split())}" in text and name in text
    assert "#" not in short and tomllib.loads(short) is not None


@pytest.mark.parametrize(("wrong", "said"), [(1, "correct the field."), (3, "correct the field (2 more to correct).")])
def test_the_first_fault_is_told_and_the_others_are_counted(wrong: int, said: str) -> None:
    text = CAPTURE
    for name in ("mass_kg = 0.37", "position_std_m = 0.001", "frame_rate_hz = 30.0")[:wrong]:
        text = text.replace(name, name.partition(" = ")[0] + ' = "none"')
    with pytest.raises(InputDataError) as refused:
        parse(tomllib.loads(text), CaptureManifest, "capture.toml", text)
    assert str(refused.value).endswith(f"Next: {said}") and "mass_kg" in str(refused.value)


def test_branches_of_a_union_are_no_part_of_a_place_in_a_document() -> None:
    data = {"shape": {"size": 3, "parts": [1]}}
    for location, kept in (
        (("shape", "BoxShape", "size"), ("shape", "size")),
        (("shape", "function-after[f(), Box]"), ("shape",)),
        (("shape", "height_m"), ("shape", "height_m")),
        (("shape", "parts", 1), ("shape", "parts", 1)),
        (("shape", "parts", 1, "tagged-union[x]"), ("shape", "parts")),
    ):
        assert _in_document(location, data) == kept

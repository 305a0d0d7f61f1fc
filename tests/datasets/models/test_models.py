"""Model directories: what is written comes back, and what is no model is called by its name."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cgwm.datasets import Model, kind_of, read_model, write_model
from cgwm.datasets.io.outputs import RECORD
from cgwm.pipeline.validate import trial_run, validate
from cgwm.schemas import (
    BodyModel,
    Correlation,
    EffectModel,
    FitFile,
    FittedParameter,
    Ground,
    InputDataError,
    ModelFile,
    Provenance,
    UsageError,
)
from datasets.shapes.test_ply import splats
from helpers.small_model import small_model

INERTIA = (0.00081, 0.00081, 0.00081, 0.0, 0.0, 0.0)


def model() -> Model:
    bodies = tuple(
        BodyModel(name=name, motion="free", mass_kg=0.37, inertia_kg_m2=INERTIA, com_m=(0.0, 0.0, 0.0))
        for name in ("cube", "scene", "tip")
    )
    file = ModelFile(
        ground=Ground(),
        bodies=bodies,
        parameters=(FittedParameter(name="cube.drop_m", unit="1", estimate=0.1 + 0.2, interval_95=(0.2, 0.4)),),
        provenance=Provenance(capture="c", seed=3),
    )
    visual = {"cube": splats(30), "scene": splats(5)}
    return Model(
        root=None,
        file=file,
        body_splats=visual,
        collision={"cube": splats(8), "scene": visual["scene"]},
        scene=splats(4),
        fit=FitFile(warnings=("slow",)),
    )


def test_round_trip(tmp_path: Path) -> None:
    written = write_model(tmp_path / "m", model())
    read = read_model(tmp_path / "m")
    assert written.root == read.root == tmp_path / "m" and written.file == read.file and read.fit == model().fit
    assert read.file.parameters[0].estimate == 0.1 + 0.2
    assert {name: len(s) for name, s in read.body_splats.items()} == {"cube": 30, "scene": 5}
    assert {name: len(s) for name, s in read.collision.items()} == {"cube": 8, "scene": 5}
    assert read.scene is not None and len(read.scene) == 4
    assert read.body("cube").splats == "cube.ply" and read.body("cube").collision == "cube.collision.ply"
    assert read.body("tip").splats is None and read.body("tip").collision is None
    np.testing.assert_allclose(read.body_splats["cube"].means, model().body_splats["cube"].means, rtol=1e-6)


def test_a_body_called_scene_does_not_take_the_place_of_the_scene(tmp_path: Path) -> None:
    write_model(tmp_path / "m", model())
    read = read_model(tmp_path / "m")
    assert read.body("scene").splats == "scene-2.ply" and read.body("scene").collision is None
    assert read.collision["scene"] is read.body_splats["scene"]


def test_equal_models_are_equal_bytes_and_a_read_model_writes_itself(tmp_path: Path) -> None:
    write_model(tmp_path / "a", model())
    write_model(tmp_path / "b", read_model(tmp_path / "a"))
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == [RECORD, "cube.collision.ply", "cube.ply", "fit.json", "model.json", "scene-2.ply", "scene.ply"]
    for name in ("model.json", "fit.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_existing_output(tmp_path: Path) -> None:
    write_model(tmp_path / "m", model())
    with pytest.raises(UsageError, match="exists"):
        write_model(tmp_path / "m", model())
    write_model(tmp_path / "m", replace(model(), scene=None), overwrite=True)
    assert read_model(tmp_path / "m").scene is None


def test_a_failed_write_leaves_nothing(tmp_path: Path) -> None:
    bad = replace(model(), scene=replace(splats(), scales=np.zeros(20)))
    with pytest.raises(ValueError, match="not finite"), np.errstate(divide="ignore"):
        write_model(tmp_path / "m", bad)
    assert list(tmp_path.iterdir()) == []


def test_a_capture_is_no_model(tmp_path: Path) -> None:
    capture = tmp_path / "c"
    capture.mkdir()
    (capture / "capture.toml").write_text('format = "cgwm-capture/1"\n')
    with pytest.raises(InputDataError) as caught:
        read_model(capture)
    assert caught.value.exit_code == 2 and kind_of(capture) == "capture"
    assert str(caught.value) == (
        f"{capture} is a capture (it holds capture.toml), not a model.\n"
        "Allowed: a model, a directory with model.json.\n"
        "Next: cgwm calibrate, fit, compare and diagnose take one; pass a model here."
    )


def test_a_dataset_a_file_and_nothing_are_no_models(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "dataset.json").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for name, expected in (
        ("d", "is a dataset (it holds dataset.json), not a model."),
        ("file", "is a file; a model is a directory with model.json."),
        ("empty", "is no model: it has no model.json."),
    ):
        with pytest.raises(InputDataError) as caught:
            read_model(tmp_path / name)
        assert str(caught.value).splitlines()[0] == f"{tmp_path / name} {expected}"
    with pytest.raises(InputDataError) as caught:
        read_model(tmp_path / "absent")
    assert str(caught.value) == f"{tmp_path / 'absent'}: no such model.\nNext: check the path."


def test_missing_and_outside_files_are_refused(tmp_path: Path) -> None:
    write_model(tmp_path / "m", model())
    (tmp_path / "m" / "cube.ply").unlink()
    with pytest.raises(InputDataError, match=r"cube\.ply: no such file"):
        read_model(tmp_path / "m")
    data = json.loads((tmp_path / "m" / "model.json").read_text())
    data["bodies"][0]["splats"] = "../../secret.ply"
    (tmp_path / "m" / "model.json").write_text(json.dumps(data))
    with pytest.raises(InputDataError, match=r"'\.\./\.\./secret\.ply' lies outside the model"):
        read_model(tmp_path / "m")


def test_unknown_field_names_the_nearest(tmp_path: Path) -> None:
    write_model(tmp_path / "m", model())
    path = tmp_path / "m" / "model.json"
    data = json.loads(path.read_text())
    data["solver"]["step"] = 0.01
    path.write_text(json.dumps(data, indent=1))
    with pytest.raises(InputDataError) as caught:
        read_model(tmp_path / "m")
    assert "[solver] has an unknown field 'step'.\n" in str(caught.value)
    assert "Did you mean 'step_s'?" in str(caught.value)


def real(tmp_path: Path) -> tuple[Path, dict[str, Any]]:
    """Write a model with contact, effect and correlations; return its `model.json` and the content of that."""
    effect = EffectModel(name="linear_drag@group", parameters={"c": 0.1}, own={"a": {"c": 0.2}}, spread={"c": 0.1})
    whole = small_model(driven=True)
    file = whole.file.model_copy(
        update={
            "effects": (effect,),
            "correlations": (Correlation(parameters=("friction", "damping_ratio"), matrix=((1.0, 0.2), (0.2, 1.0))),),
            "measurement_std": {"position_m": 1e-3, "rotation_rad": 1e-2},
            "parameters": (
                *whole.file.parameters,
                FittedParameter(name="linear_drag.c", unit="1/s", estimate=0.1, interval_95=(0.0, 0.2), bounds=(0, 20)),
            ),
        }
    )
    write_model(tmp_path / "m", replace(whole, file=file))
    path = tmp_path / "m" / "model.json"
    return path, json.loads(path.read_text())


def put(document: Any, place: tuple, value: Any) -> None:
    *parents, last = place
    for key in parents:
        document = document[key]
    document[last] = value


PARAMETER = {"name": "friction", "unit": "1", "estimate": 0.4}
CONTRADICTIONS: list[tuple[tuple, Any, str]] = [
    (("measurement_std", "position_m"), -1e-3, "measurement_std.position_m"),
    (("measurement_std", "position_m"), 0.0, "measurement_std.position_m"),
    (("measurement_std", "position_mm"), 1.0, "unknown measurement 'position_mm'"),
    (("parameters", 0, "estimate"), 7.0, "parameter 'friction' is 7 1, outside its bounds 0.01 to 2"),
    (("parameters", 0, "estimate"), 0.5, "'friction' is 0.5, but contact.friction is 0.4"),
    (("parameters", 1, "estimate"), 0.5, "'damping_ratio' is 0.5, but contact.damping_ratio is 0.3"),
    (("parameters", 2, "estimate"), 0.5, "'cube.mass_kg' is 0.5, but mass_kg of body 'cube' is 0.37"),
    (("parameters", 3, "estimate"), 0.5, "'linear_drag.c' is 0.5, but c of effect 'linear_drag@group' is 0.1"),
    (("parameters", 0, "bounds"), [2.0, 0.01], "a range is [low, high]"),
    (("parameters", 3, "interval_95"), [0.2, 0.0], "a range is [low, high]"),
    (("parameters", 0, "std_error"), -0.1, "std_error"),
    (("parameters", 1), PARAMETER, "two parameters have the name 'friction'"),
    (("bodies", 1, "name"), "cube", "two bodies have the name 'cube'"),
    (("effects",), [{"name": "wind"}, {"name": "wind@group"}], "two effects have the name 'wind'"),
    (("correlations", 0, "matrix", 0, 1), 0.5, "'damping_ratio' and 'friction' is 0.2, the other way around 0.5"),
    (("correlations", 0, "matrix", 1, 1), 2.0, "of 'damping_ratio' with itself is 2, not 1"),
    (("correlations", 0, "matrix"), [[1, 1.5], [1.5, 1]], "it lies between -1 and 1"),
    (("correlations", 0, "matrix"), [[1, 0.5]], "2 rows of 2 numbers"),
    (("correlations", 0, "parameters", 1), "drag", "correlations name 'drag'"),
    (("correlations", 0, "parameters", 1), "friction", "name the parameter 'friction' twice"),
    (("bodies", 0, "com_m"), [5.0, 0.0, 0.0], "com_m of body 'cube' is 5 m from the middle of its spheres"),
    (("bodies", 0, "inertia_kg_m2"), [1e-4, 1e-4, 1e-4, 9e-5, 9e-5, -9e-5], "positive definite"),
    (("bodies", 0, "inertia_kg_m2"), [1e-4, 1e-4, 1e-4, 9e-5, 0, 0], "one moment is larger than the other two"),
    (("bodies", 0, "radius_factor"), 0.0, "radius_factor"),
    (("bodies", 0, "photo_pose"), None, "photo_pose"),
    (("contact", "friction"), 1e308, "contact.friction: input should be less than or equal to 100"),
    (("contact", "damping_ratio"), -0.1, "contact.damping_ratio"),
    (("solver", "step_s"), 1e-9, "solver.step_s"),
    (("solver", "sweeps"), 10**9, "solver.sweeps"),
    (("ground", "normal"), [0, 0, 2], "ground.normal: the ground normal has length 2"),
    (("gravity_m_s2",), [0, 0, -9810], "gravity"),
    (("provenance",), None, "provenance"),
    (("provenance", "config"), [], "provenance.config"),
]


@pytest.mark.parametrize(("place", "value", "message"), CONTRADICTIONS)
def test_a_model_that_cannot_be_is_refused_when_read(tmp_path: Path, place: tuple, value: Any, message: str) -> None:
    path, document = real(tmp_path)
    read_model(path.parent)
    put(document, place, value)
    path.write_text(json.dumps(document, indent=1))
    with pytest.raises(InputDataError) as caught:
        read_model(path.parent)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value), str(caught.value)


def test_correlations_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path, document = real(tmp_path)
    names = ["friction", "damping_ratio", "linear_drag.c"]
    document["correlations"] = [{"parameters": names, "matrix": [[1, 0.9, -0.9], [0.9, 1, 0.9], [-0.9, 0.9, 1]]}]
    path.write_text(json.dumps(document))
    with pytest.raises(InputDataError, match=r"model\.json: the correlations of .* contradict each other"):
        read_model(path.parent)


def test_a_body_that_touches_needs_spheres(tmp_path: Path) -> None:
    path, document = real(tmp_path)
    put(document, ("bodies", 1, "splats"), None)
    put(document, ("bodies", 1, "collision"), None)
    path.write_text(json.dumps(document))
    with pytest.raises(InputDataError, match=r"body 'tip' has no collision spheres, but the model has contacts"):
        read_model(path.parent)


def test_a_sphere_that_lies_beyond_every_body_is_refused(tmp_path: Path) -> None:
    whole = small_model()
    name = next(iter(whole.collision))
    far = whole.collision[name].means.copy()
    far[-1] = (0.0, 5e10, 0.0)  # what a damaged byte of a .ply file makes
    moved = replace(whole.collision[name], means=far)
    write_model(tmp_path / "m", replace(whole, collision=whole.collision | {name: moved}))
    with pytest.raises(InputDataError, match=rf"spheres of body '{name}' reach 5e\+10 m"):
        read_model(tmp_path / "m")


@pytest.mark.parametrize("value", [None, "absent"])
def test_fields_that_are_null_or_missing_never_break_the_reader(tmp_path: Path, value: str | None) -> None:
    path, document = real(tmp_path)
    names = [
        (),
        ("bodies", 0),
        ("contact",),
        ("ground",),
        ("solver",),
        ("parameters", 0),
        ("effects", 0),
        ("provenance",),
    ]
    for place in names:
        holder = document
        for key in place:
            holder = holder[key]
        for name in holder:
            changed = copy.deepcopy(document)
            inner = changed
            for key in place:
                inner = inner[key]
            if value is None:
                inner[name] = None
            else:
                del inner[name]
            path.write_text(json.dumps(changed))
            try:
                read_model(path.parent)
            except InputDataError as error:
                assert str(path) in str(error), error


@pytest.mark.parametrize(
    ("place", "value", "fault"),
    [
        (("contact", "contact_time_s"), 1e-4, "it cannot be simulated: the step of 2 ms is beyond the bound"),
        (("effects", 0, "parameters"), {"cd": 1.0}, "effect 'linear_drag@group': linear_drag has no cd"),
        (("effects", 0, "own", "a", "c"), -3.0, "linear_drag.c is -3 1/s"),
        (("effects", 0, "own", "a", "c"), 1e9, "linear_drag.c is 1e+09 1/s"),
    ],
)
def test_validate_runs_a_second_of_a_model(tmp_path: Path, place: tuple, value: Any, fault: str) -> None:
    path, document = real(tmp_path)
    assert validate(path.parent).faults == ()
    put(document, place, value)
    path.write_text(json.dumps(document))
    (found,) = validate(path.parent).faults
    assert found.startswith("model.json: ") and fault in found


def test_a_run_that_gains_energy_or_diverges_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, _ = real(tmp_path)
    honest = trial_run._simulated

    def thrown(world: Any, state: Any) -> Any:
        result = honest(world, state)
        return replace(result, velocity_m_s=result.velocity_m_s + 1e4 * result.times_s[:, None, None])

    monkeypatch.setattr(trial_run, "_simulated", thrown)
    assert "left to fall, it gains" in validate(path.parent).faults[0]
    monkeypatch.setattr(
        trial_run, "_simulated", lambda w, s: replace(honest(w, s), position_m=honest(w, s).position_m / 0)
    )
    assert "left to fall, it diverges within 0 s" in validate(path.parent).faults[0]

"""Model directories: what is written comes back, and what is no model is called by its name."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Model, kind_of, read_model, write_model
from cgwm.datasets.io.outputs import RECORD
from cgwm.schemas import BodyModel, FitFile, FittedParameter, Ground, InputDataError, ModelFile, Provenance, UsageError
from test_ply import splats

INERTIA = (0.00081, 0.00081, 0.00081, 0.0, 0.0, 0.0)


def model() -> Model:
    bodies = tuple(
        BodyModel(name=name, motion="free", mass_kg=0.37, inertia_kg_m2=INERTIA, com_m=(0.0, 0.0, 0.0))
        for name in ("cube", "scene", "tip")
    )
    file = ModelFile(
        ground=Ground(),
        bodies=bodies,
        parameters=(FittedParameter(name="friction", unit="1", estimate=0.1 + 0.2, interval_95=(0.2, 0.4)),),
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

"""What people read: the verdict first, then the numbers with their units, aligned."""

from pathlib import Path

from cgwm.cli import doctor, eval, fit, import_, synthesize, validate
from cgwm.schemas import (
    BodyModel,
    ContactParameters,
    DatasetSummary,
    DoctorReport,
    ErrorSummary,
    EvalResult,
    FittedParameter,
    ImportResult,
    Missing,
    ModelFile,
    Provenance,
    ValidationReport,
)


def test_eval() -> None:
    result = EvalResult(
        episodes=3,
        translation_error_m=ErrorSummary(mean=0.0141, median=0.0123, final=0.05),
        rotation_error_deg=ErrorSummary(mean=15.2, median=8.1),
        baselines={"frozen": {"translation_error_m": {"mean": 0.2, "median": 0.21, "final": 0.4}}},
        warnings=("episode 007 has a gap of 0.1 s",),
    )
    assert eval._summary(result).splitlines() == [
        "3 episodes, open loop: 12.3 mm and 8.1 deg (medians).",
        "                               mean  median  final",
        "  translation error [mm]       14.1    12.3   50.0",
        "  rotation error [deg]         15.2     8.1      -",
        "  (frozen: translation [mm])  200.0   210.0  400.0",
        "warning: episode 007 has a gap of 0.1 s",
    ]


def test_eval_of_centroids() -> None:
    result = EvalResult(episodes=1, translation_error_m=ErrorSummary(mean=0.0141, median=0.0123))
    assert eval._summary(result).splitlines()[0] == "1 episode, open loop: 12.3 mm (median)."


def test_fit() -> None:
    body = BodyModel(
        name="cube", motion="free", mass_kg=0.37, inertia_kg_m2=(1e-3, 1e-3, 1e-3, 0, 0, 0), com_m=(0, 0, 0)
    )
    parameters = (
        FittedParameter(name="friction", unit="1", estimate=0.1812, interval_95=(0.16, 0.2)),
        FittedParameter(name="contact_time_s", unit="s", estimate=0.0042, state="on_bound"),
    )
    model = ModelFile(
        bodies=(body,),
        contact=ContactParameters(),
        parameters=parameters,
        warnings=("the contact time is on its bound",),
        provenance=Provenance(capture="capture"),
    )
    assert fit._summary(model, Path("model")).splitlines() == [
        "Fitted model: cube (free); with physics.",
        "  parameter       estimate  95 % interval  unit  state",
        "  friction          0.1812    0.16 to 0.2  1     fitted",
        "  contact_time_s    0.0042              -  s     on bound",
        "warning: the contact time is on its bound",
    ]
    bare = ModelFile(bodies=(body,), provenance=Provenance(capture="capture"))
    assert fit._summary(bare, Path("m")) == "Fitted m: cube (free); shape and appearance only, without physics."


def test_synthesize() -> None:
    summary = DatasetSummary(
        dataset="out",
        shard="rollouts-0000-of-0001.h5",
        sha256="",
        bytes=12345678,
        rollouts=8,
        frames=480,
        contacts=1200,
        cameras=("left", "right"),
        seconds=12.3,
        frames_per_s=39.0,
    )
    assert synthesize._summary(summary).splitlines() == [
        "Wrote out/rollouts-0000-of-0001.h5; cameras: left, right.",
        "  rollouts              8",
        "  frames              480",
        "  contacts           1200",
        "  size            12.3 MB",
        "  speed     39.0 frames/s",
        "  time             12.3 s",
    ]


def test_import() -> None:
    result = ImportResult(capture="out", episodes=400, samples=41869, splits={"train": 50, "test": 100})
    assert import_._summary(result) == "Wrote out: 400 episodes (train 50, test 100) with 41869 poses."


def test_import_says_which_body_lacks_a_shape(tmp_path: Path) -> None:
    (tmp_path / "capture.toml").write_text('format = "cgwm-capture/1"\n[[bodies]]\nname = "ball"\n')
    result = ImportResult(capture=str(tmp_path), episodes=1, samples=9, splits={"train": 1})
    assert "Next: give 'ball' a shape in" in import_._summary(result)
    with (tmp_path / "capture.toml").open("a") as manifest:
        manifest.write("shape = { sphere = { radius_m = 0.02 } }\n")
    assert import_._summary(result).endswith(f"Next: cgwm fit {tmp_path} --out MODEL")


def test_validate() -> None:
    report = ValidationReport(
        path="c", kind="capture", facts={"splits": {"train": 2}, "reprojection_px": 0.61234}, faults=("a.", "b.")
    )
    assert validate._summary(report).splitlines() == [
        "capture c: 2 faults.",
        "  fault: a.",
        "  fault: b.",
        "  splits           train 2",
        "  reprojection px  0.6123",
    ]


def test_validate_gives_each_warning_a_line() -> None:
    facts = {"photos": 2, "warnings": ["One.", "Two."], "inconsistencies": []}
    assert validate._summary(ValidationReport(path="c", kind="capture", facts=facts)).splitlines() == [
        "capture c: no faults.",
        "  warning: One.",
        "  warning: Two.",
        "  photos           2",
        "  inconsistencies  none",
    ]


def test_doctor() -> None:
    report = DoctorReport(
        cgwm="0.1.0",
        python="3.11.7",
        platform="Linux x86_64",
        cpu_cores=2,
        memory_gib=23.54,
        packages=(),
        uses={"device": "cpu, 2 cores"},
        missing=(Missing(what="mujoco", why="not installed", todo="pip install 'mujoco<4,>=3.17'"),),
    )
    lines = doctor._summary(report).splitlines()
    assert lines[:2] == [
        "cgwm 0.1.0: not ready.",
        "  missing: mujoco (not installed). Next: pip install 'mujoco<4,>=3.17'",
    ]
    assert "  cores, memory for cgwm  2, 23.5 GiB" in lines
    assert lines[-2:] == ["What cgwm would use", "  device  cpu, 2 cores"]


def test_a_command_with_a_path_of_several_words_can_be_typed() -> None:
    result = ImportResult(capture="my capture", episodes=0, samples=0, splits={}, photos=12)
    assert import_._summary(result) == 'Wrote my capture: 12 photos (next: cgwm calibrate "my capture").'

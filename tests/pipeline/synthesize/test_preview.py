"""Previews: contacts are drawn where the camera sees them, and a dataset's bytes do not depend on its pictures."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.cli import main
from cgwm.datasets.capture import video
from cgwm.datasets.capture.cameras import Camera
from cgwm.datasets.capture.video import read_video
from cgwm.datasets.io.atomic import sha256
from cgwm.datasets.io.outputs import RECORD
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.pipeline.geometry.viewpoint import look_at
from cgwm.pipeline.rendering.contact_glyphs import SLIDING_RGB, STICKING_RGB, arrow_scale, contact_marks
from cgwm.pipeline.synthesize import preview as previews
from cgwm.pipeline.synthesize import synthesize
from cgwm.pipeline.synthesize.preview import FILM, SHEET, draw_contacts, telling_frames
from cgwm.schemas import SynthesizeConfig
from helpers.small_model import write_small_model

CONFIG = SynthesizeConfig(rollouts=2, duration_s=0.3, width=64, height=48, device="cpu", seed=5)
CONTACTS = {
    "pos_world": np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]]),
    "impulse_world": np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 0.0]]),
    "mode": np.array([0, 1], np.uint8),
}


@pytest.fixture(scope="module")
def model_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small_model(tmp_path_factory.mktemp("models") / "model")


@pytest.fixture(scope="module")
def dataset(model_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("datasets") / "dataset"
    summary = synthesize(model_path, out, CONFIG, preview=True)
    assert summary.preview == (SHEET, FILM) and not any("preview" in note for note in summary.notes)
    return out


def front_camera() -> Camera:
    K = np.array([[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]])
    pose = look_at(np.array([0.0, -1.0, 0.0]), np.zeros(3), np.array([0.0, 0, 1]))
    return Camera(width=160, height=120, K=K, distortion=np.zeros(0), T_world_cam=pose)


def color_at(picture: np.ndarray, x: float, y: float) -> tuple[int, ...]:
    """Return the colour of the pixel that holds a point of the image."""
    return tuple(int(value) for value in picture[int(y), int(x)])


def test_marks_are_points_and_arrows() -> None:
    marks = contact_marks(CONTACTS, arrow_scale(0.5, 0.3))
    np.testing.assert_allclose(marks.tips_m, [[0, 0, 0.3], [0.26, 0, 0]])
    assert marks.segments_m.shape == (2, 2, 3)
    np.testing.assert_array_equal(marks.colors, [STICKING_RGB, SLIDING_RGB])
    assert arrow_scale(0.0, 0.3) == 0.0


def test_contacts_are_drawn_where_the_camera_sees_them() -> None:
    camera = front_camera()
    marks = contact_marks(CONTACTS, arrow_scale(0.5, 0.3))
    picture = np.zeros((120, 160, 3), np.uint8)
    draw_contacts(picture, camera, marks)
    # By hand: at 1 m and f = 100 px, 0.1 m are 10 px; z is up in the world and y down in the image.
    assert color_at(picture, 80, 60) == STICKING_RGB
    assert color_at(picture, 80, 60 - 15) == STICKING_RGB  # half way up its arrow
    assert color_at(picture, 100, 60) == SLIDING_RGB
    assert color_at(picture, 80, 60 + 15) == (0, 0, 0)
    assert picture[:20].any() is np.False_ and picture[80:].any() is np.False_


def test_what_lies_behind_the_camera_is_not_drawn() -> None:
    behind = {**CONTACTS, "pos_world": np.array([[0.0, -2.0, 0.0], [0.0, -1.0, 0.0]])}
    picture = np.zeros((120, 160, 3), np.uint8)
    draw_contacts(picture, front_camera(), contact_marks(behind, 1.0))
    assert not picture.any()


def test_the_frames_of_a_sheet_tell_most() -> None:
    strength = np.zeros(31)
    strength[[7, 9, 30]] = 1.0, 2.0, 1.0
    frames = telling_frames(strength, 5)
    assert frames[0] == 0 and len(frames) == 5 and frames == sorted(frames)
    assert {9, 30} <= set(frames)
    assert telling_frames(np.zeros(3), 5) == [0, 1, 2]


def test_a_dataset_ends_with_pictures(dataset: Path) -> None:
    sheet = cv2.cvtColor(cv2.imdecode(np.frombuffer((dataset / SHEET).read_bytes(), np.uint8), 1), cv2.COLOR_BGR2RGB)
    assert sheet.shape == (4 * 244 - 4 + 34, 5 * 324 - 4, 3)  # two rollouts, two cameras
    reader = RolloutReader(dataset)
    assert any(reader.read(number, "contacts/offsets")[-1] for number in range(2))
    marked = (np.abs(sheet.astype(int) - STICKING_RGB).max(-1) < 30) | (
        np.abs(sheet.astype(int) - SLIDING_RGB).max(-1) < 30
    )
    assert marked[: 4 * 244 - 4].sum() > 20  # above the legend, which has both colours anyway
    film = read_video(dataset / FILM)
    assert len(film) == reader.rollouts[0].frames == 10
    assert (dataset / FILM).read_bytes()[:4] == b"\x1a\x45\xdf\xa3"  # EBML, the container of WebM
    moved = np.abs(film[0].astype(int) - film[-1]).max(-1) > 60
    assert moved.sum() > 100


def test_pictures_change_no_shard(model_path: Path, dataset: Path, tmp_path: Path) -> None:
    plain = synthesize(model_path, tmp_path / "plain", CONFIG)
    assert plain.preview == ()
    assert sorted(path.name for path in (tmp_path / "plain").iterdir()) == [
        RECORD,
        "dataset.json",
        "model",
        plain.shard,
    ]
    assert sha256(dataset / plain.shard) == plain.sha256
    assert (dataset / "dataset.json").read_bytes() == (tmp_path / "plain/dataset.json").read_bytes()


def test_the_command_names_them_or_leaves_them_out(
    model_path: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, options in (("with", []), ("without", ["--no-preview"])):
        sizes = [f"--set=synthesize.{setting}" for setting in ("width=32", "height=24", "duration_s=0.1")]
        out = tmp_path / name
        with pytest.raises(SystemExit) as ended:
            main(["synthesize", str(model_path), "--out", str(out), "--rollouts", "1", *sizes, *options])
        assert ended.value.code == 0
        told = f"To look at: {out / SHEET}, {out / FILM}" in capfd.readouterr().out.splitlines()
        assert told == (out / SHEET).is_file() == (out / FILM).is_file() == (name == "with")


def test_the_first_shard_has_the_pictures(model_path: Path, tmp_path: Path) -> None:
    for shard, expected in ((1, ()), (0, (SHEET, FILM))):
        update = {"shards": 2, "shard": shard}
        summary = synthesize(model_path, tmp_path / "out", CONFIG.model_copy(update=update), preview=True)
        assert summary.preview == expected
        assert {SHEET, FILM} & {path.name for path in (tmp_path / "out").iterdir()} == set(expected)


def test_a_model_without_splats_says_that_there_are_none(tmp_path: Path) -> None:
    path = write_small_model(tmp_path / "model", visible=False)
    summary = synthesize(path, tmp_path / "out", CONFIG.model_copy(update={"rollouts": 1}), preview=True)
    assert summary.preview == () and "no preview: the rollouts have no images" in summary.notes
    assert not (tmp_path / "out" / SHEET).exists()


def test_pictures_that_cannot_be_made_are_a_note(
    model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = CONFIG.model_copy(update={"rollouts": 1, "duration_s": 0.1})

    class NoWriter:
        def __init__(self, *arguments: object) -> None: ...

        def isOpened(self) -> bool:
            return False

    with monkeypatch.context() as patch:
        patch.setattr(video.cv2, "VideoWriter", NoWriter)
        NoWriter.fourcc = cv2.VideoWriter_fourcc  # pyright: ignore[reportAttributeAccessIssue]
        summary = synthesize(model_path, tmp_path / "codec", one, preview=True)
    assert "no preview: this OpenCV" in summary.notes[-1] and "writes no .webm video" in summary.notes[-1]

    def full(*arguments: object, **options: object) -> object:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(previews, "replaced_file", full)
    summary = synthesize(model_path, tmp_path / "disk", one, preview=True)
    assert summary.notes[-1] == "no preview: No space left on device"
    assert sha256(tmp_path / "disk" / summary.shard) == summary.sha256

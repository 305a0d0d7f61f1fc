"""A rollout as a recording of Rerun, read again by Rerun's own reader."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from cgwm.datasets.rollouts.loader import RolloutReader
from cgwm.pipeline.export import export
from cgwm.pipeline.export.stage import ExportOptions
from cgwm.pipeline.synthesize import synthesize
from cgwm.schemas import OutputExistsError, SynthesizeConfig, UsageError
from helpers.small_model import write_small_model


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rerun")
    config = SynthesizeConfig(rollouts=2, duration_s=0.5, width=32, height=24, device="cpu", seed=5)
    synthesize(write_small_model(folder / "model"), folder / "dataset", config)
    return folder / "dataset"


def _columns(path: Path, entity: str, component: str) -> dict[int, np.ndarray]:
    """Return a component of an entity by frame, as Rerun's reader has it."""
    from rerun.chunk import RrdReader  # pyright: ignore[reportMissingImports]

    found: dict[int, np.ndarray] = {}
    for chunk in RrdReader(path).store().stream().to_chunks():
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and component in batch.schema.names:
            rows = batch.column(component).to_pylist()
            found |= dict(zip(batch.column("frame").to_pylist(), map(np.array, rows), strict=True))
    return found


def test_poses_pictures_depth_and_contacts_are_those_of_the_dataset(dataset: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'cgwm[rerun]'")
    out = tmp_path / "one.rrd"
    result = export(dataset, "rerun", out, ExportOptions(rollout=1, every=2))
    reader = RolloutReader(dataset)
    frames = range(0, reader.rollouts[1].frames, 2)
    assert result.facts["frames"] == len(frames)
    positions, turns = (_columns(out, "/world/cube", f"Transform3D:{name}") for name in ("translation", "quaternion"))
    assert list(positions) == list(frames)
    for frame in frames:
        assert positions[frame][0] == pytest.approx(reader.read(1, "bodies/pos")[frame, 0], abs=1e-6)
        assert turns[frame][0][[3, 0, 1, 2]] == pytest.approx(reader.read(1, "bodies/quat_wxyz")[frame, 0], abs=1e-6)
    lens = _columns(out, "/world/cameras/view0", "Pinhole:image_from_camera")[0]
    assert lens[0].reshape(3, 3).T == pytest.approx(reader.camera(1, "view0").K, rel=1e-6)
    blob = np.asarray(_columns(out, "/world/cameras/view0/depth", "EncodedDepthImage:blob")[4][0], np.uint8)
    depth = cv2.imdecode(blob, cv2.IMREAD_UNCHANGED)
    assert depth is not None
    assert 1e-3 * depth == pytest.approx(reader.read(1, "obs/view0_depth", 4, 5)[0], abs=0.51e-3)
    image = np.asarray(_columns(out, "/world/cameras/view0/image", "EncodedImage:blob")[4][0], np.uint8)
    picture = cv2.imdecode(image, cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (24, 32, 3)
    contacts = _columns(out, "/world/contacts", "Arrows3D:vectors")
    assert [len(contacts[frame]) for frame in frames] == [len(reader.contacts(1, frame)["mode"]) for frame in frames]
    longest = max(float(np.linalg.norm(rows, axis=1).max()) for rows in contacts.values() if len(rows))
    assert longest == pytest.approx(0.2, rel=1e-5)


def test_it_replaces_its_own_files_only(dataset: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'cgwm[rerun]'")
    out = tmp_path / "one.rrd"
    export(dataset, "rerun", out, ExportOptions(every=10))
    with pytest.raises(OutputExistsError):
        export(dataset, "rerun", out, ExportOptions(every=10))
    export(dataset, "rerun", out, ExportOptions(every=10), overwrite=True)
    (tmp_path / "other.rrd").write_bytes(b"RRF2 of another tool")
    with pytest.raises(UsageError, match=r"is no Rerun recording of cgwm"):
        export(dataset, "rerun", tmp_path / "other.rrd", ExportOptions(every=10), overwrite=True)


def test_without_rerun_the_package_is_named(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=r"(?s)needs rerun-sdk, which is not installed.*pip install 'cgwm\[rerun\]'"):
        export(dataset, "rerun", tmp_path / "one.rrd", ExportOptions())
    with pytest.raises(UsageError, match=r"(?s)--to rerun writes one file.*a name that ends in .rrd"):
        export(dataset, "rerun", tmp_path / "one", ExportOptions())
    assert list(tmp_path.iterdir()) == []

"""Imports of recorded poses: CSV, TUM, HDF5, ROS bags, and the throws and drops of others."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from cgwm.cli.app import app
from cgwm.datasets import (
    Capture,
    Units,
    check_capture,
    import_balldrops,
    import_contactnets,
    import_csv,
    import_hdf5,
    import_jugglebot,
    import_rosbag,
    import_tum,
)
from cgwm.datasets.importers.jugglebot import flight
from cgwm.schemas import InputDataError, UsageError
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

SHARED = Path(os.environ.get("CGWM_SHARED_DATA", Path(__file__).parents[4] / "shared" / "data"))
TIMES = np.arange(5) / 100
POSITIONS = np.random.default_rng(0).normal(size=(5, 3)).round(4)
OTHER_NAMES = {"time": "clock", "px": "a", "py": "b", "pz": "c", "qw": "d", "qx": "e", "qy": "f", "qz": "g"}
QUATS = np.array([[np.cos(a), 0.0, 0.0, np.sin(a)] for a in (0.0, 0.1, 0.2, 0.3, 0.4)])


def shared(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"no {folder}: set CGWM_SHARED_DATA to the measured data")
    return folder


def fault(tmp_path: Path, call, *arguments: object, **named: object) -> str:
    """Return the message of a refused import, which leaves nothing behind."""
    with pytest.raises(InputDataError) as caught:
        call(*arguments, tmp_path / "refused", **named)
    assert not (tmp_path / "refused").exists()
    return str(caught.value).replace(str(tmp_path), "T")


def track_of(path: Path, episode: str, body: str = "body"):
    capture = Capture.open(path)
    check_capture(capture)
    return capture.tracks(episode)[body]


def spinning(path: Path, quats: bool, spins: np.ndarray, names: str = "wx_rad_s,wy_rad_s,wz_rad_s") -> Path:
    """Write a CSV file with measured spins."""
    columns = [TIMES[:, None], POSITIONS, *([QUATS] if quats else []), spins]
    header = "time,px,py,pz," + ("qw,qx,qy,qz," if quats else "") + names
    rows = [",".join(map(repr, row)) for row in np.concatenate(columns, axis=1).tolist()]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_measured_spins_are_read_along_named_axes(tmp_path: Path) -> None:
    spins = np.tile([1.0, 2.0, 3.0], (5, 1))
    import_csv(spinning(tmp_path / "ball.csv", False, spins), tmp_path / "ball")
    np.testing.assert_array_equal(track_of(tmp_path / "ball", "ball").omega_body_rad_s, spins)
    turning = spinning(tmp_path / "box.csv", True, spins)
    unsaid = import_csv(turning, tmp_path / "unsaid")
    assert track_of(tmp_path / "unsaid", "box").omega_body_rad_s is None
    assert "'wx_rad_s', 'wy_rad_s', 'wz_rad_s'" in unsaid.warnings[0] and "--spin-frame" in unsaid.warnings[0]
    import_csv(turning, tmp_path / "own", spin_frame="body")
    np.testing.assert_array_equal(track_of(tmp_path / "own", "box").omega_body_rad_s, spins)
    import_csv(turning, tmp_path / "fixed", spin_frame="world")
    angle = np.arange(5) * 0.2  # QUATS turn about z
    expected = [[np.cos(a) + 2 * np.sin(a), 2 * np.cos(a) - np.sin(a), 3.0] for a in angle]
    np.testing.assert_allclose(track_of(tmp_path / "fixed", "box").omega_body_rad_s, expected, atol=1e-12)


def test_spins_that_are_not_whole_are_refused(tmp_path: Path) -> None:
    spins = np.tile([1.0, 2.0, 3.0], (5, 1))
    holed = spins.copy()
    holed[2, 1] = np.nan
    text = fault(tmp_path, import_csv, spinning(tmp_path / "a.csv", False, holed))
    assert "1 of 5 samples have no finite angular velocity" in text
    text = fault(tmp_path, import_csv, spinning(tmp_path / "b.csv", False, spins[:, :2], "wx,wy"))
    assert "no column for 'wz'" in text and "all of wx, wy, wz or none" in text
    text = fault(tmp_path, import_csv, spinning(tmp_path / "c.csv", False, 1e4 * spins))
    assert "angular velocities up to 3e+04 rad/s" in text


def same(track, scale: float = 1.0, quats: bool = True) -> None:
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-12)
    np.testing.assert_allclose(track.position_m, scale * POSITIONS, rtol=1e-12)
    if quats:
        np.testing.assert_allclose(track.quat_wxyz, QUATS, atol=1e-9)
    else:
        assert track.quat_wxyz is None


def write_csv(path: Path, header: str, *columns: np.ndarray, separator: str = ",") -> None:
    path.parent.mkdir(exist_ok=True)
    rows = [separator.join(repr(float(value)) for value in row) for row in np.c_[columns]]
    path.write_text("\n".join([header.replace(",", separator), *rows]) + "\n")


@pytest.mark.parametrize(
    ("header", "scale", "change"),
    [
        ("time,px,py,pz,qw,qx,qy,qz", 1.0, {}),
        ("t,x,y,z,quat_w,quat_x,quat_y,quat_z", 1.0, {}),
        ("Time (s),X (mm),Y (mm),Z (mm),qw,qx,qy,qz", 0.001, {}),
        ("timestamp,tx,ty,tz,qw,qx,qy,qz", 0.01, {"units": Units("cm")}),
        ("clock,a,b,c,d,e,f,g", 1.0, {"columns": OTHER_NAMES}),
    ],
)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_columns_by_their_names(tmp_path: Path, header: str, scale: float, change: dict, separator: str) -> None:
    write_csv(tmp_path / "in" / "throw 1.csv", header, 1.7e9 + TIMES, POSITIONS, QUATS, separator=separator)
    import_csv(tmp_path / "in", tmp_path / "out", **change)
    track = track_of(tmp_path / "out", "throw-1")
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-6)  # a clock since 1970 holds no more digits
    np.testing.assert_allclose(track.position_m, scale * POSITIONS, rtol=1e-12)
    np.testing.assert_allclose(track.quat_wxyz, QUATS, atol=1e-9)


def test_columns_that_are_not_read_are_named(tmp_path: Path) -> None:
    for k in range(3):
        extra = np.full((len(TIMES), 1 + (k == 1)), 7.0)
        write_csv(tmp_path / "in" / f"{k}.csv", "t,x,y,z,vx" + ",mood" * (k == 1), TIMES, POSITIONS, extra)
    result = import_csv(tmp_path / "in", tmp_path / "out")
    assert [text.partition(". ")[0] for text in result.warnings] == [
        "columns that were not read: 'vx', 'mood' (in 1 of 3 files)"
    ]
    write_csv(tmp_path / "all" / "0.csv", "t,x,y,z", TIMES, POSITIONS)
    assert import_csv(tmp_path / "all", tmp_path / "whole").warnings == ()


def test_csv_gaps_bodies_and_splits(tmp_path: Path) -> None:
    for k in range(10):
        write_csv(tmp_path / "in" / f"{k}.csv", "t,x,y,z", 1000 * TIMES, POSITIONS)
    text = "t,body,x,y,z\n0,a,1,2,3\n0,b,1,2,3\n10,a,,,\n20,a,1,2,4\n30,b,1,2,nan\n40,b,1,1,1\n"
    (tmp_path / "in" / "two.csv").write_text(text)
    result = import_csv(tmp_path / "in", tmp_path / "out", units=Units(time="ms"), body="cup", up="y")
    assert (result.episodes, result.splits) == (11, {"train": 7, "test": 4})
    same(track_of(tmp_path / "out", "3", "cup"), quats=False)
    np.testing.assert_array_equal(track_of(tmp_path / "out", "two", "a").time_s, [0.0, 0.02])
    np.testing.assert_array_equal(track_of(tmp_path / "out", "two", "b").time_s, [0.0, 0.04])
    manifest = Capture.open(tmp_path / "out").manifest
    assert [body.name for body in manifest.bodies] == ["cup", "a", "b"]
    assert manifest.world.gravity_m_s2 == (0.0, -9.81, 0.0) and manifest.world.ground is None
    splits = manifest.splits
    assert len({*splits["train"], *splits["test"]}) == 11
    import_csv(tmp_path / "in", tmp_path / "again", units=Units(time="ms"), body="cup")
    assert Capture.open(tmp_path / "again").manifest.splits == splits
    import_csv(tmp_path / "in", tmp_path / "other", units=Units(time="ms"), n_train=3, n_test=2, seed=1)
    other = Capture.open(tmp_path / "other").manifest.splits
    assert (len(other["train"]), len(other["test"])) == (3, 2) and other["train"] != splits["train"][:3]


def test_samples_without_a_pose_are_said_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Gaps stand in the result of the import; what is cut off at the ends, where no gap is left, is noted."""
    said: list[str] = []
    monkeypatch.setattr("cgwm.datasets.importers.recordings.note", said.append)
    lost = {1, 7, 8, 18, 19}
    rows = [f"{0.01 * k},{'nan' if k in lost else k},2,3" for k in range(20)]
    for name, some in (("whole", rows[2:18]), ("ends", rows[:7] + rows[9:])):
        (tmp_path / f"{name}.csv").write_text("\n".join(["t,x,y,z", *some]) + "\n", encoding="utf-8")
    result = import_csv(tmp_path / "whole.csv", tmp_path / "a")
    assert said == [] and len(result.warnings) == 1 and "lacks 2 of 16 samples" in result.warnings[0]
    import_csv(tmp_path / "ends.csv", tmp_path / "b")
    assert len(said) == 1 and "2 samples before the first pose or after the last one" in said[0]


@pytest.mark.parametrize("number", ["1_000", "0x10", "1e400", "inf", "١٢", "1.5\0", "9" * 400])
def test_what_is_no_plain_number_is_refused_with_its_line(number: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"t,x,y,z\n0,1,2,3\n0.1,{number},2,3\n", encoding="utf-8")
    said = fault(tmp_path, import_csv, tmp_path / "a.csv")
    assert said.startswith("T/a.csv, line 3: px: '") and said.splitlines()[0].isprintable() and len(said) < 300
    (tmp_path / "a.txt").write_text(f"0 1 2 3 0 0 0 1\n0.1 {number} 2 3 0 0 0 1\n", encoding="utf-8")
    assert fault(tmp_path, import_tum, tmp_path / "a.txt").startswith("T/a.txt, line 2: '")


def test_blanks_in_names_of_bodies_are_replaced_and_said(tmp_path: Path) -> None:
    rows = [f"{t},{name},{t},2,3" for t in (0.0, 0.1) for name in ("Rigid Body 1", "Rigid Body 2", "floor")]
    (tmp_path / "a.csv").write_text("\n".join(["t,body,x,y,z", *rows]))
    result = import_csv(tmp_path / "a.csv", tmp_path / "out")
    assert set(Capture.open(tmp_path / "out").tracks("a")) == {"Rigid-Body-1", "Rigid-Body-2", "floor"}
    assert "'Rigid Body 1' is 'Rigid-Body-1', 'Rigid Body 2' is 'Rigid-Body-2'." in result.warnings[-1]
    (tmp_path / "a.csv").write_text("\n".join(["t,body,x,y,z", *rows, "0,Rigid Body-1,0,2,3"]))
    text = fault(tmp_path, import_csv, tmp_path / "a.csv")
    assert "line 8: 'Rigid Body-1' and 'Rigid Body 1' would both be called 'Rigid-Body-1'" in text


@pytest.mark.parametrize("header", ["frame,x,y,z", "time,x,y,z", "x,y,z", "Frame,Time (s),x,y,z"])
def test_frames_are_counted_at_a_rate(tmp_path: Path, header: str) -> None:
    columns = [np.arange(5.0)[:, None], POSITIONS]
    if "Time (s)" in header:
        columns.insert(1, np.full((5, 1), 7.0))
    table = np.hstack(columns if header != "x,y,z" else columns[1:])
    (tmp_path / "a.csv").write_text("\n".join([header, *(",".join(map(str, row)) for row in table.tolist())]))
    result = import_csv(tmp_path / "a.csv", tmp_path / "out", frame_rate_hz=250.0)
    np.testing.assert_allclose(track_of(tmp_path / "out", "a").time_s, np.arange(5) / 250, atol=1e-12)
    assert ("'Time (s)'" in "".join(result.warnings)) == ("Time (s)" in header)


def test_a_frame_rate_beside_a_unit_of_time_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Time (ms),x,y,z\n0,1,2,3\n1,1,2,3\n")
    assert "'Time (ms)' names a unit of time" in fault(tmp_path, import_csv, tmp_path / "a.csv", frame_rate_hz=100.0)
    for rate, units, part in (
        (100.0, Units(time="ms"), "--time-unit"),
        (0.0, Units(), "--frame-rate 0"),
        (np.nan, Units(), "nan"),
    ):
        with pytest.raises(UsageError, match=part):
            import_csv(tmp_path / "a.csv", tmp_path / "out", units=units, frame_rate_hz=rate)
    assert not (tmp_path / "out").exists()


def test_angles_are_read_in_their_order(tmp_path: Path) -> None:
    roll, pitch, yaw = 0.3, -0.4, 1.1
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    (tmp_path / "a.csv").write_text(
        f"t,x,y,z,roll,pitch,yaw\n0,1,2,3,{roll},{pitch},{yaw}\n0.1,1,2,3,{roll},{pitch},{yaw}\n"
    )
    degrees = [np.rad2deg(a) for a in (roll, pitch, yaw)]
    row = ",".join(map(str, degrees))
    (tmp_path / "b.csv").write_text(
        f"t,x,y,z,Roll (deg),Pitch (deg),Yaw (deg)\n0,1,2,3,{row}\n0.1,1,2,3,{row}\n0.2,1,2,3,,,\n"
    )
    for order, expected in (("xyz", about_z @ about_y @ about_x), ("XYZ", about_x @ about_y @ about_z)):
        import_csv(tmp_path / "a.csv", tmp_path / f"a-{order}", euler=order, angle_unit="rad")
        import_csv(tmp_path / "b.csv", tmp_path / f"b-{order}", euler=order)
        for name in "ab":
            quat = track_of(tmp_path / f"{name}-{order}", name).quat_wxyz
            found = Rotation.from_quat(quat, scalar_first=True).as_matrix()
            np.testing.assert_allclose(found, np.stack([expected] * 2), atol=1e-6)
    unread = import_csv(tmp_path / "a.csv", tmp_path / "unread")
    assert "--euler xyz" in unread.warnings[0] and track_of(tmp_path / "unread", "a").quat_wxyz is None


def test_angles_without_order_unit_or_columns_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x,y,z,roll,pitch,yaw_deg\n0,1,2,3,0,0,0\n0.1,1,2,3,0,0,0\n")
    text = fault(tmp_path, import_csv, tmp_path / "a.csv", euler="xyz", angle_unit="rad")
    assert "units of angles that differ: deg, rad" in text
    (tmp_path / "b.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,0\n0.1,1,2,3,0,0,0\n")
    assert "nothing says in which unit 'roll', 'pitch', 'yaw' are" in fault(
        tmp_path, import_csv, tmp_path / "b.csv", euler="xyz"
    )
    (tmp_path / "c.csv").write_text("t,x,y,z\n0,1,2,3\n0.1,1,2,3\n")
    assert "no column for 'roll'" in fault(tmp_path, import_csv, tmp_path / "c.csv", euler="zyx", angle_unit="deg")
    for words, part in (({"euler": "xyx"}, "--euler 'xyx'"), ({"angle_unit": "deg"}, "without --euler")):
        with pytest.raises(UsageError, match=part):
            import_csv(tmp_path / "b.csv", tmp_path / "out", **words)


@pytest.mark.parametrize("name", ["a\tb", "../a", "a\x1b[31m", "", "x" * 10 + "/"])
def test_names_that_no_manifest_takes_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"t,body,x,y,z\n0,cube,1,2,3\n0.1,{name},1,2,3\n", encoding="utf-8")
    assert "T/a.csv, line 3: '" in fault(tmp_path, import_csv, tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("t,x,y,z\n0,1,2,3\n0.1,1,2,3\n")
    assert "--body: '" in fault(tmp_path, import_csv, tmp_path / "b.csv", body=name)
    (tmp_path / "ball_drops.csv").write_text(f"ball,Drop #,Time (s),Height (m)\nBall,1,0,1\n../{name},1,0,1\n")
    assert "ball_drops.csv, line 3: '" in fault(tmp_path, import_balldrops, tmp_path)


def test_times_and_lengths_beyond_every_unit_are_refused(tmp_path: Path) -> None:
    for row, unit in (("1e300,1,2,3", "up to 1e+300 s"), ("0.1,1e300,2,3", "up to 1e+300 m"), ("1e-12,1,2,3", "apart")):
        (tmp_path / "a.csv").write_text(f"t,x,y,z\n0,1,2,3\n{row}\n")
        assert unit in fault(tmp_path, import_csv, tmp_path / "a.csv", units=Units("m", "s"))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("gone"), os.mkdir])
@pytest.mark.parametrize(
    ("name", "load"),
    [
        *(("b.csv", import_csv), ("b.tum", import_tum), ("b.h5", import_hdf5), ("b.bag", import_rosbag)),
        *(("b.json", import_jugglebot), ("b.npz", import_contactnets), ("0.pt", import_contactnets)),
    ],
)
def test_what_is_no_file_is_not_passed_over(name: str, load, make, tmp_path: Path) -> None:
    if load is import_rosbag and make is os.mkdir:
        return  # a bag may be a directory
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.csv").write_text("t,x,y,z\n0,1,2,3\n0.1,1,2,3\n")
    make(tmp_path / "in" / name)
    assert f"T/in/{name}: " in fault(tmp_path, load, tmp_path / "in")


def test_csv_faults(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"

    def said(text: str, **change: object) -> str:
        path.write_text(text)
        return fault(tmp_path, import_csv, path, **change)

    assert fault(tmp_path, import_csv, tmp_path / "absent").startswith("T/absent: no such file or directory.")
    assert said("").startswith("T/a.csv: empty, without a first line that names the columns.")
    assert said("t,x,y\n0,1,2\n").startswith("T/a.csv: no column for 'pz' among t, x, y.")
    assert said("0,1,2,3\n0.1,1,2,3\n").startswith(
        "T/a.csv: the first line holds numbers, so that nothing says what the 4"
    )
    assert said("t,x,y,z,qw\n").startswith("T/a.csv: no column for 'qx'")
    assert said("t,x,y,z\n").startswith("T/a.csv: no samples.")
    assert said("t,x,y,z\n0,1,2,3\n0.1,1,2\n").startswith("T/a.csv, line 3: 3 values under 4 columns.")
    assert said("t,x,y,z\n0,1,2,3\n,1,2,3\n").startswith("T/a.csv, line 3: time: the time is missing.")
    assert said("t,x,y,z\n0,1,2,3\n0.1,1,2,far\n").startswith("T/a.csv, line 3: pz: 'far' is no number.")
    assert said("t,x,y,z\n0,1,2,3\n").startswith("T/a.csv: body: 1 samples with a pose.")
    assert said("t,time,x,y,z\n0,0,1,2,3\n").startswith("T/a.csv: 't' and 'time' may both be 'time'.")
    assert said("t,x_mm,y_cm,z_mm\n").startswith("T/a.csv: units of length that differ: cm, mm.")
    assert said("t,x_mm,y,z\n").startswith("T/a.csv: 'x_mm' names its unit, and 'y' and 'z' none.")
    assert "no column 'X'" in said("t,x,y,z\n", columns={"px": "X"})
    assert "'p' is nothing that a column can be" in said("t,x,y,z\n", columns={"p": "x"})
    assert "time 0 comes after 0.1" in said("t,x,y,z\n0.1,1,2,3\n0,1,2,3\n")
    assert "remove the samples that are there twice" in said("t,x,y,z\n0,1,2,3\n0,1,2,3\n0.1,1,2,3\n")
    assert "numbers of frames: divide them by the frame rate" in said("t,x,y,z\n0,1,2,3\n1,1,2,3\n2,1,2,3\n")
    assert "'1,000,000' is no number" in said("t;x;y;z\n0;1,000,000;2;3\n")
    assert "another norm than 1, the first 2.0000" in said("t,x,y,z,qw,qx,qy,qz\n0,1,2,3,2,0,0,0\n0.1,1,2,3,1,0,0,0\n")
    assert "2 training and 0 test episodes of 1 recordings" in said("t,x,y,z\n0,1,2,3\n0.1,1,2,3\n", n_train=2)


@pytest.mark.parametrize(
    "text",
    [
        "# tracker v3\n\n#\nt;x;y;z\n0;1,5;2;3\n0,1;1,25;2;-3e-1\n",
        "# t,x,y,z\n0,1.5,2,3\n0.1,1.25,2,-0.3\n",
        "# tracker\n# t\tx\ty\tz\n0\t1,5\t2\t3\n0,1\t1,25\t2\t-0,3\n",
    ],
    ids=["comments", "savetxt", "tabs"],
)
def test_comments_and_decimal_commas_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    import_csv(tmp_path / "a.csv", tmp_path / "out")
    track = track_of(tmp_path / "out", "a")
    np.testing.assert_allclose(track.time_s, [0, 0.1])
    np.testing.assert_allclose(track.position_m, [[1.5, 2, 3], [1.25, 2, -0.3]])


def test_milliseconds_and_millimetres_are_not_taken_for_seconds_and_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,z\n0,1,2,3\n10,1,2,4\n20,1,2,5\n")
    said = fault(tmp_path, import_csv, path)
    assert said.startswith("T/a.csv: body: from sample to sample the time grows by 10: hardly seconds.")
    assert "--time-unit ms" in said
    path.write_text("t,x,y,z\n0,1,2,3\n0.01,1,2,400\n")
    assert "positions spread over 397: hardly metres." in fault(tmp_path, import_csv, path)
    import_csv(path, tmp_path / "out", units=Units("m", "s"))  # who says so is believed
    assert track_of(tmp_path / "out", "a").position_m[1, 2] == 400


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("mm", 0.001), ("in", 0.0254)])
def test_the_unit_in_which_a_body_falls_is_named(unit: str, metres: float, tmp_path: Path) -> None:
    t = np.arange(0, 1, 0.02)
    place = np.stack((4 * t, 0 * t, 5 * t - 4.905 * t**2 + 1), 1) / metres
    write_csv(tmp_path / "a.csv", "t,x,y,z", t, *place.T)
    assert f"add --length-unit {unit} (or," in fault(tmp_path, import_csv, tmp_path / "a.csv")


def test_takes_in_one_file_are_episodes(tmp_path: Path) -> None:
    lines = [f"{take},{t},{t + take},0,{1 - t}" for take in (3, 1, 10) for t in (0.0, 0.1, 0.2, 0.3)]
    path = tmp_path / "all.csv"
    path.write_text("\n".join(["Trial,t,x,y,z", *lines]))
    result = import_csv(path, tmp_path / "out")
    assert result.episodes == 3 and not result.warnings
    assert Capture.open(tmp_path / "out").episodes() == ["all-1", "all-10", "all-3"]
    assert track_of(tmp_path / "out", "all-10").position_m[0, 0] == 10
    path.write_text("\n".join(["n,t,x,y,z", *lines]))
    text = fault(tmp_path, import_csv, path)
    assert "the times begin anew 2 times, as of 3 takes in one file" in text and "--columns take=NAME" in text
    import_csv(path, tmp_path / "named", columns={"take": "n"})
    assert len(Capture.open(tmp_path / "named").episodes()) == 3


@pytest.mark.parametrize(("names", "unit"), [("wx_rpm,wy_rpm,wz_rpm", np.pi / 30), ("wx (deg/s),wy (deg/s),wz (deg/s)",
    np.pi / 180), ("wx,wy,wz", 1.0)])  # fmt: skip
def test_spins_are_in_the_unit_of_their_names(names: str, unit: float, tmp_path: Path) -> None:
    spins = np.random.default_rng(1).normal(size=(5, 3)).round(3)
    import_csv(spinning(tmp_path / "a.csv", False, spins, names), tmp_path / "out")
    np.testing.assert_allclose(track_of(tmp_path / "out", "a").omega_body_rad_s, unit * spins, atol=1e-5)
    mixed = spinning(tmp_path / "b.csv", False, spins, "wx_rpm,wy_rpm,wz_rad_s")
    assert "units of angular velocity that differ: rad, rpm" in fault(tmp_path, import_csv, mixed)


def test_poses_that_are_repeated_while_the_body_moves_are_left_out(tmp_path: Path) -> None:
    t = np.arange(40) / 100
    place = np.stack((2 * t, 1.2345 * t, 1 - 4.905 * t**2), 1).round(4)
    late = place.copy()
    late[[7, 20, 21]] = late[[6, 19, 19]]
    for name, times, rows, kept in (
        ("late", t, late, 37), ("doubled", np.arange(80) / 200, np.repeat(place, 2, 0), 40),
        ("rests", t, np.zeros((40, 3)), 40), ("rounded", t, (0.1 * place).round(2), 40), ("plain", t, place, 40),
    ):  # fmt: skip
        write_csv(tmp_path / f"{name}.csv", "t,x,y,z", times, *rows.T)
        import_csv(tmp_path / f"{name}.csv", tmp_path / name)
        assert len(track_of(tmp_path / name, name)) == kept, name


def test_tum(tmp_path: Path) -> None:
    rows = np.c_[1305031102.1 + TIMES, POSITIONS, QUATS[:, [1, 2, 3, 0]].round(5)]
    text = "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(" ".join(f"{v:.6f}" for v in row) for row in rows)
    (tmp_path / "a.txt").write_text(text + "\n")
    import_tum(tmp_path / "a.txt", tmp_path / "out")
    track = track_of(tmp_path / "out", "a")
    np.testing.assert_allclose(track.time_s, TIMES, atol=1e-6)
    np.testing.assert_allclose(track.quat_wxyz, QUATS, atol=1e-5)
    assert np.abs(np.linalg.norm(track.quat_wxyz, axis=1) - 1).max() < 1e-12
    assert Capture.open(tmp_path / "out").manifest.splits == {"train": ("a",)}
    (tmp_path / "a.txt").write_text("0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0\n")
    assert fault(tmp_path, import_tum, tmp_path / "a.txt").startswith("T/a.txt, line 2: '0.1 1 2 3 0 0 0'.")
    (tmp_path / "a.txt").write_text("0 1 2 3 1 0 0 0\n33 1 2 3 1 0 0 0\n")
    assert "--time-unit ms" in fault(tmp_path, import_tum, tmp_path / "a.txt")


def test_hdf5(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("data/demo_0", "data/demo_1"):
            group = file.create_group(name)
            group["time"], group["position"], group["quat_xyzw"] = TIMES, POSITIONS, QUATS[:, [1, 2, 3, 0]]
        file["data/other/position"] = POSITIONS
    import_hdf5(tmp_path / "a.h5", tmp_path / "out", n_train=1)
    same(track_of(tmp_path / "out", "data-demo_1"))
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["when"], file["obs/where"], file["turn"] = 1000 * TIMES, 1000 * POSITIONS, QUATS
    named = {"time": "when", "position": "obs/where", "quat_wxyz": "turn"}
    import_hdf5(tmp_path / "b.h5", tmp_path / "named", columns=named, units=Units("mm", "ms"))
    same(track_of(tmp_path / "named", "b"))
    said = fault(tmp_path, import_hdf5, tmp_path / "b.h5")
    assert "no group with times and positions; there are obs/where, turn, when." in said
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["time"], file["position"], file["quat"] = TIMES, POSITIONS, QUATS
    assert "'quat' does not say whether w comes first" in fault(tmp_path, import_hdf5, tmp_path / "c.h5")
    with h5py.File(tmp_path / "d.h5", "w") as file:
        file["time"], file["position"] = TIMES, POSITIONS[:, :2]
    assert "/position has the shape (5, 2)" in fault(tmp_path, import_hdf5, tmp_path / "d.h5")
    (tmp_path / "e.h5").write_text("no HDF5")
    assert "not a readable HDF5 file" in fault(tmp_path, import_hdf5, tmp_path / "e.h5")


def write_bag(path: Path, topics: dict[str, str]) -> None:
    """Write the poses as a ROS 2 bag, on each topic in messages of its type."""
    pytest.importorskip("rosbags", reason="rosbags is not installed: pip install 'cgwm[ros]'")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types

    def message(kind: str, k: int):
        time = kinds["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=round(1e9 * TIMES[k]))
        header = kinds["std_msgs/msg/Header"](stamp=time, frame_id="world")
        x, y, z = POSITIONS[k]
        turn = kinds["geometry_msgs/msg/Quaternion"](**dict(zip("wxyz", QUATS[k], strict=True)))
        if kind == "tf2_msgs/msg/TFMessage":
            moved = kinds["geometry_msgs/msg/Transform"](kinds["geometry_msgs/msg/Vector3"](x, y, z), turn)
            still = kinds["geometry_msgs/msg/Transform"](kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0), turn)
            stamped = kinds["geometry_msgs/msg/TransformStamped"]
            return kinds[kind]([stamped(header, "cup", moved), stamped(header, "table", still)])
        pose = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](x, y, z), turn)
        if kind == "geometry_msgs/msg/PoseStamped":
            return kinds[kind](header, pose)
        with_covariance = kinds["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36))
        return kinds[kind](header, with_covariance)

    with Writer(path, version=9) as writer:
        for topic, kind in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in [0, *range(len(TIMES))]:  # the first one twice
                writer.write(connection, 1_700_000_000_000_000_000 + k, store.serialize_cdr(message(kind, k), kind))


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"])
def test_rosbag_with_one_topic(tmp_path: Path, kind: str) -> None:
    write_bag(tmp_path / "bag", {"/pose": kind})
    import_rosbag(tmp_path / "bag", tmp_path / "out")
    track = track_of(tmp_path / "out", "bag")
    np.testing.assert_allclose(track.time_s, TIMES, atol=3e-7)
    np.testing.assert_allclose(track.position_m, POSITIONS)
    np.testing.assert_allclose(track.quat_wxyz, QUATS, atol=1e-9)


def test_rosbag_with_several_topics(tmp_path: Path) -> None:
    pose = "geometry_msgs/msg/PoseStamped"
    write_bag(tmp_path / "bag", {"/a": pose, "/b": pose, "/tf": "tf2_msgs/msg/TFMessage"})
    said = fault(tmp_path, import_rosbag, tmp_path / "bag")
    assert said.splitlines()[:2] == ["T/bag: 2 topics of poses.", "Allowed: /a, /b, /tf:CHILD_FRAME."]
    assert "Did you mean '/a'?" in fault(tmp_path, import_rosbag, tmp_path / "bag", topic="/aa")
    assert "no poses of 'mug' on /tf" in fault(tmp_path, import_rosbag, tmp_path / "bag", topic="/tf:mug")
    import_rosbag(tmp_path, tmp_path / "out", topic="/tf:cup", body="cup")
    np.testing.assert_allclose(track_of(tmp_path / "out", "bag", "cup").position_m, POSITIONS)
    assert fault(tmp_path, import_rosbag, tmp_path / "absent").startswith("T/absent: no such file or directory.")


def test_rosbag_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", SimpleNamespace(__path__=[]))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(UsageError, match=r"pip install 'cgwm\[ros\]'"):
        import_rosbag(tmp_path, tmp_path / "out")


def thrown(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a ball that is held, accelerated, thrown (0.5 to 1.4 s), and bounces; 300 Hz, noise of 0.4 mm."""
    time = np.arange(600) / 300
    held, free, after = time < 0.5, (time >= 0.5) & (time < 1.4), time >= 1.4
    position = np.zeros((600, 3))
    velocity = np.array([1.0, 0.3, 3.0])
    position[held] = -0.5 * (0.5 - time[held, None]) * velocity * (time[held, None] > 0.3) + [0, 0, 2.0]
    flown = time[free, None] - 0.5
    position[free] = [0, 0, 2.0] + flown * velocity - 0.5 * flown**2 * np.array([0, 0, 9.81])
    end = position[free][-1]
    position[after] = end + (time[after, None] - 1.4) * np.array([0.8, 0.2, 2.0])
    return time, position + 4e-4 * np.random.default_rng(seed).standard_normal((600, 3))


@pytest.mark.parametrize("every", [1, 2, 3, 5])
def test_the_flight_of_a_throw_is_found_at_any_rate(every: int) -> None:
    time, position = (values[::every] for values in thrown())
    first, last = flight(time, position)
    assert 0.5 <= time[first] < 0.55 and 1.33 < time[last] < 1.4
    if every > 1:
        return
    with pytest.raises(ValueError, match="nothing flies"):
        flight(time[:120], position[:120])


def test_jugglebot_from_both_files(tmp_path: Path) -> None:
    throws = [thrown(seed) for seed in (0, 1, 2)]
    rows = np.concatenate([np.c_[time + 1 / 300, position] for time, position in throws])
    (tmp_path / "in").mkdir()
    np.savez(tmp_path / "in" / "a.npz", offsets=600 * np.arange(4), txyz=rows)
    markers = [
        {"Parts": [
            {"Range": {"Start": 1}, "Values": [[*row, 0.5] for row in (1000 * position[:300]).tolist()]},
            {"Range": {"Start": 311}, "Values": [[*row, 0.5] for row in (1000 * position[310:]).tolist()]},
        ]}
        for _, position in throws
    ]  # fmt: skip
    (tmp_path / "in" / "b.json").write_text(json.dumps({"Timebase": {"Frequency": 300.0}, "Markers": markers}))
    result = import_jugglebot(tmp_path / "in", tmp_path / "out")
    assert (result.episodes, result.splits) == (6, {"train": 4, "test": 2})
    assert len(result.warnings) == 1 and "b-00 lacks 10 of" in result.warnings[0]
    capture = Capture.open(tmp_path / "out")
    check_capture(capture)
    assert {entry.group for entry in capture.manifest.episodes.values()} == {"a", "b"}
    assert capture.manifest.world.ground is None and capture.manifest.bodies[0].mass_kg is None
    one, other = capture.tracks("a-00")["ball"], capture.tracks("b-00")["ball"]
    assert one.time_s[0] == 0.0 and 0.8 < one.time_s[-1] < 0.9 and one.quat_wxyz is None
    np.testing.assert_allclose(one.position_m[:50], other.position_m[:50], atol=1e-9)
    assert len(other) == len(one) - 10  # the gap
    import_jugglebot(tmp_path / "in", tmp_path / "b", only="b", n_train=1, n_test=1)
    assert Capture.open(tmp_path / "b").episodes() == ["b-00", "b-01", "b-02"]
    assert "no session 'c'" in fault(tmp_path, lambda out: import_jugglebot(tmp_path / "in", out, only="c"))
    np.savez(tmp_path / "in" / "a.npz", offsets=[0, 100], txyz=rows[:100])
    said = fault(tmp_path, import_jugglebot, tmp_path / "in" / "a.npz")
    assert said.startswith("T/in/a.npz: throw 0: nothing flies at the highest point.")
    (tmp_path / "in" / "b.json").write_text("{}")
    assert "not an export of Qualisys' tracks" in fault(tmp_path, import_jugglebot, tmp_path / "in" / "b.json")


def test_jugglebot_as_published(tmp_path: Path) -> None:
    result = import_jugglebot(shared("jugglebot"), tmp_path / "out")
    assert (result.episodes, result.splits) == (40, {"train": 24, "test": 16})
    capture = Capture.open(tmp_path / "out")
    check_capture(capture)
    for name in capture.episodes():
        track = capture.tracks(name)["ball"]
        assert 0.8 < track.time_s[-1] < 1.05
        basis = np.vander(track.time_s, 5)
        off = track.position_m - basis @ np.linalg.lstsq(basis, track.position_m)[0]
        assert np.abs(off).max() < 0.004 and off.std() < 0.0008  # nothing of the machine or of the floor is in it
    groups = [entry.group for entry in capture.manifest.episodes.values()]
    assert groups.count("session7") == groups.count("session3_timing") == 20


def write_drops(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    lines = ["ball,Drop #,Time (s),Height (m),Velocity (m/s)"]
    for ball in ("Golf Ball", "Big Whiffle Ball"):
        lines += [f"{ball},{drop},{k / 15},{48 - 0.5 * 9.81 * (k / 15) ** 2},0" for drop in (1, 2) for k in range(9)]
    (folder / "ball_drops.csv").write_text("\n".join(lines) + "\n")
    (folder / "balls.txt").write_text("ball weight(oz) circumference(cm)\ngolfball 2 13.5\nbigWiffle ?? 29\n")


def test_balldrops(tmp_path: Path) -> None:
    write_drops(tmp_path / "in")
    result = import_balldrops(tmp_path / "in", tmp_path / "out")
    assert result.splits == {"train": 2, "test": 2}
    capture = Capture.open(tmp_path / "out")
    check_capture(capture)
    assert capture.manifest.splits["train"] == ("golf-ball-1", "big-whiffle-ball-1")
    assert capture.manifest.episodes["golf-ball-2"].group == "golf-ball"
    (body,) = capture.manifest.bodies
    assert body.mass_kg is None and body.shape.sphere.radius_m == pytest.approx(0.2125 / (2 * np.pi))
    track = capture.tracks("golf-ball-1")["ball"]
    assert track.quat_wxyz is None and not track.position_m[:, :2].any() and track.position_m[0, 2] == 48
    import_balldrops(tmp_path / "in", tmp_path / "one", only="golf-ball")
    capture = Capture.open(tmp_path / "one")
    (body,) = capture.manifest.bodies
    assert capture.episodes() == ["golf-ball-1", "golf-ball-2"]
    assert body.mass_kg == pytest.approx(0.0567, rel=1e-3)
    assert body.shape.sphere.radius_m == pytest.approx(0.135 / (2 * np.pi))
    import_balldrops(tmp_path / "in", tmp_path / "light", only="big-whiffle-ball")
    assert Capture.open(tmp_path / "light").manifest.bodies[0].mass_kg is None
    assert "no ball 'golf'" in fault(tmp_path, lambda out: import_balldrops(tmp_path / "in", out, only="golf"))
    (tmp_path / "in" / "ball_drops.csv").write_text("ball,Time (s)\n")
    assert "no column 'Drop #'" in fault(tmp_path, import_balldrops, tmp_path / "in")
    assert "no such file" in fault(tmp_path, import_balldrops, tmp_path / "absent")


def test_balldrops_as_published(tmp_path: Path) -> None:
    result = import_balldrops(shared("balldrops"), tmp_path / "out")
    assert (result.episodes, result.splits) == (14, {"train": 7, "test": 7})
    check_capture(Capture.open(tmp_path / "out"))
    import_balldrops(shared("balldrops"), tmp_path / "one", only="bowling-ball")
    assert Capture.open(tmp_path / "one").manifest.bodies[0].mass_kg == pytest.approx(2.296, rel=1e-3)


def test_all_cube_tosses_as_published(tmp_path: Path) -> None:
    result = import_contactnets(shared("cube_tosses"), tmp_path / "out", 250, 150)
    assert (result.episodes, result.splits) == (400, {"train": 250, "test": 150})


def test_the_command(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", "zeit,x,y,z", 1000 * TIMES, POSITIONS)
    run = ["import", "csv", str(tmp_path / "a.csv"), "--out", str(tmp_path / "out"), "--json"]
    done = CliRunner().invoke(app, [*run, "--columns", "time=zeit", "--time-unit", "ms", "--body", "cup"])
    assert done.exit_code == 0
    assert json.loads(done.stdout)["episodes"] == 1
    same(track_of(tmp_path / "out", "a", "cup"), quats=False)
    for words, said in (
        (["--columns", "time", "--overwrite"], "--columns: 'time' is not KEY=NAME."),
        (["--topic", "/pose"], "--topic does not apply to csv."),
        (["--columns", "time=zeit", "--overwrite"], "hardly seconds"),
    ):
        failed = CliRunner().invoke(app, [*run, *words])
        assert failed.exit_code == 2
        assert said in failed.stderr
    write_drops(tmp_path / "in")
    run = ["import", "balldrops", str(tmp_path / "in"), "--out", str(tmp_path / "balls"), "--json"]
    assert CliRunner().invoke(app, [*run, "--only", "golf-ball"]).exit_code == 0
    failed = CliRunner().invoke(app, [*run, "--seed", "1", "--overwrite"])
    assert failed.exit_code == 2 and "--seed does not apply to balldrops" in failed.stderr

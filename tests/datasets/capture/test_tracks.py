"""Track files: what is written comes back, and each fault is named with its line and column."""

import math
from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Track, read_tracks, write_tracks
from cgwm.schemas import InputDataError

HEADER = "time_s,body,px_m,py_m,pz_m,qw,qx,qy,qz"
ALL_COLUMNS = "time_s, body, px_m, py_m, pz_m, qw, qx, qy, qz, vx_m_s, vy_m_s, vz_m_s, wx_rad_s, wy_rad_s, wz_rad_s"
ALL_COLUMNS += ", force_x_n, force_y_n, force_z_n, torque_x_n_m, torque_y_n_m, torque_z_n_m"


def random_track(seed: int, count: int = 5, full: bool = True) -> Track:
    rng = np.random.default_rng(seed)
    quat_wxyz = rng.normal(size=(count, 4))
    quat_wxyz /= np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
    time_s, position_m = np.cumsum(rng.uniform(0.001, 0.1, count)), rng.normal(size=(count, 3))
    if not full:
        return Track(time_s, position_m)
    return Track(
        time_s=time_s,
        position_m=position_m,
        quat_wxyz=quat_wxyz,
        velocity_m_s=rng.normal(size=(count, 3)),
        omega_body_rad_s=rng.normal(size=(count, 3)),
        force_n=rng.normal(size=(count, 3)),
        torque_n_m=rng.normal(size=(count, 3)),
    )


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def message(path: Path, bodies: tuple[str, ...] = ("cube", "tip")) -> str:
    with pytest.raises(InputDataError) as caught:
        read_tracks(path, bodies)
    assert caught.value.exit_code == 2
    return str(caught.value).replace(f"{path}", "T")


def test_round_trip_is_exact(tmp_path: Path) -> None:
    tracks = {"cube": random_track(0), "tip": random_track(1, 7, full=False)}
    write_tracks(tmp_path / "a.csv", tracks)
    read, normalised = read_tracks(tmp_path / "a.csv", ["tip", "cube"])
    assert normalised == 0 and set(read) == {"cube", "tip"}
    for name, track in tracks.items():
        for column in Track.__dataclass_fields__:
            expected, found = getattr(track, column), getattr(read[name], column)
            assert (expected is None and found is None) or np.array_equal(expected, found)
    rows = (tmp_path / "a.csv").read_text().splitlines()[1:]
    times = [float(row.split(",")[0]) for row in rows]
    assert times == sorted(times) and len(times) == 12


def test_columns_that_no_body_has_are_left_out(tmp_path: Path) -> None:
    write_tracks(tmp_path / "a.csv", {"tip": random_track(1, full=False)})
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "time_s,body,px_m,py_m,pz_m"
    assert read_tracks(tmp_path / "a.csv", ["tip"])[0]["tip"].quat_wxyz is None


def test_window_keeps_its_ends() -> None:
    track = Track(np.array([0.0, 0.1, 0.2, 0.3]), np.arange(12.0).reshape(4, 3))
    assert track.window(0.1, 0.2).time_s.tolist() == [0.1, 0.2]
    assert track.window(None, 0.1).position_m.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert len(track.window()) == 4 and track.window(0.1).quat_wxyz is None


def test_empty_lines_spaces_and_a_byte_order_mark_are_no_faults(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xef\xbb\xbftime_s, body ,px_m,py_m,pz_m\r\n0, cube ,1,2,3\r\n\r\n0.5,cube,1,2,3\r\n")
    assert len(read_tracks(path, ["cube"])[0]["cube"]) == 2


def test_quaternions_within_the_tolerance_are_normalised_and_counted(tmp_path: Path) -> None:
    path = write(
        tmp_path / "a.csv", HEADER, "0,cube,0,0,0,1.0009,0,0,0", "1,cube,0,0,0,1,0,0,0", "2,cube,0,0,0,0.9991,0,0,0"
    )
    tracks, normalised = read_tracks(path, ["cube"])
    assert normalised == 2
    assert np.array_equal(tracks["cube"].quat_wxyz, np.tile([1.0, 0, 0, 0], (3, 1)))


def test_quaternion_of_norm_0_9_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", HEADER, "0,cube,0,0,0,1,0,0,0", "1,cube,0,0,0,0.9,0,0,0")
    assert message(path) == (
        "T, line 3: body 'cube': the quaternion has norm 0.9000 (1 of 2 rows are off).\n"
        "Allowed: norm 1 within 0.001, order qw, qx, qy, qz.\n"
        "Next: normalise the quaternions where they are made."
    )


def test_unit_in_a_header_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "time_s,body,px_mm,py_mm,pz_mm", "0,cube,1,2,3")
    assert message(path) == (
        f"T, line 1: unknown column 'px_mm'.\nAllowed: {ALL_COLUMNS}. Did you mean 'px_m'?\n"
        "Next: correct the header; values are in SI units (m, s, rad, N)."
    )


@pytest.mark.parametrize("value", ["nan", "NaN", "inf", "-inf"])
def test_value_that_is_not_finite(tmp_path: Path, value: str) -> None:
    path = write(tmp_path / "a.csv", HEADER, "0,cube,0,0,0,1,0,0,0", f"0.1,cube,0,{value},0,1,0,0,0")
    assert message(path) == (
        f"T, line 3: body 'cube', column 'py_m' is {value}.\nAllowed: finite numbers; gaps are allowed.\n"
        "Next: leave out the whole line where nothing was measured."
    )


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            ["0.1,cube,0,0,0", "0.3,cube,0,0,0", "0.2,cube,0,0,0"],
            "T, line 4: body 'cube': time 0.2 s comes after 0.3 s (line 3).",
        ),
        (["0.1,cube,0,0,0", "0.1,cube,0,0,0"], "T, line 3: body 'cube': time 0.1 s stands twice."),
        (["0,cube,0,0,0", "1,cub,0,0,0"], "T, line 3: unknown body 'cub'."),
        (["0,cube,0,0,0", "1,tip,0,0,0", "2,tip,0,0,0"], "T, line 2: body 'cube' has 1 sample."),
        (["0,cube,0,0,x", "1,cube,0,0,0"], "T, line 2: body 'cube', column 'pz_m': 'x' is no number."),
        (["0,cube,0,0,", "1,cube,0,0,0"], "T, line 2: body 'cube', column 'pz_m': the value is missing."),
        (["0,cube,0,0"], "T, line 2: 4 values under 5 columns."),
        ([], "T: no samples."),
    ],
)
def test_faults_in_rows(tmp_path: Path, rows: list[str], expected: str) -> None:
    path = write(tmp_path / "a.csv", "time_s,body,px_m,py_m,pz_m", *rows)
    assert message(path).splitlines()[0] == expected


def test_two_bodies_may_share_a_time(tmp_path: Path) -> None:
    rows = [f"{t},{body},0,0,0" for t in (0, 1) for body in ("cube", "tip")]
    path = write(tmp_path / "a.csv", "time_s,body,px_m,py_m,pz_m", *rows)
    assert {name: len(track) for name, track in read_tracks(path, ["cube", "tip"])[0].items()} == {"cube": 2, "tip": 2}


def test_unknown_body_names_the_nearest(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "time_s,body,px_m,py_m,pz_m", "0,kube,0,0,0")
    assert message(path).splitlines()[1] == "Allowed: cube, tip. Did you mean 'cube'?"
    assert message(path, ()).splitlines()[1] == "Allowed: no body: [[bodies]] is empty."


def test_orientation_must_be_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "time_s,body,px_m,py_m,pz_m,qw,qx,qy", "0,cube,0,0,0,1,0,0")
    assert message(path).splitlines()[0] == "T, line 1: no column 'qz'."
    path = write(tmp_path / "a.csv", HEADER, "0,cube,0,0,0,1,0,0,0", "1,cube,0,0,0,,,,")
    assert message(path).splitlines()[0] == "T, line 3: body 'cube', column 'qw': the value is missing."


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("time_s,body,px_m,px_m,pz_m", "T, line 1: the column 'px_m' stands twice."),
        ("time_s,px_m,py_m,pz_m", "T, line 1: no column 'body'."),
        ("time_s,body,px_m,py_m,pz_m,vx_m_s", "T, line 1: no column 'vy_m_s'."),
    ],
)
def test_faults_in_the_header(tmp_path: Path, header: str, expected: str) -> None:
    assert message(write(tmp_path / "a.csv", header)).splitlines()[0] == expected


def test_files_that_are_no_tracks(tmp_path: Path) -> None:
    assert message(tmp_path / "absent.csv").startswith("T: no such file.")
    (tmp_path / "empty.csv").touch()
    assert message(tmp_path / "empty.csv").startswith("T: the file is empty.\nAllowed: a header line of time_s, ")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x01")
    assert message(tmp_path / "bytes.csv") == (
        "T: not a text file in UTF-8.\nNext: save it as UTF-8, or get the file again."
    )


# In the suite: a measurement of time.
@pytest.mark.evidence
def test_fifty_thousand_rows_are_read_in_seconds(tmp_path: Path) -> None:
    import time

    count = 50_000
    track = Track(np.arange(count) / 300, np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))
    write_tracks(tmp_path / "a.csv", {"cube": track})
    start = time.perf_counter()
    read, _ = read_tracks(tmp_path / "a.csv", ["cube"])
    assert time.perf_counter() - start < 5 and math.isclose(read["cube"].time_s[-1], (count - 1) / 300)

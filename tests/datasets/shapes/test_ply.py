"""Spheres in .ply files: the layout that viewers expect, and what is refused."""

from pathlib import Path

import numpy as np
import pytest
from cgwm.datasets import Splats, read_splats, write_splats
from cgwm.datasets.shapes.ply import SH_C0
from cgwm.schemas import InputDataError, UsageError


def splats(count: int = 20) -> Splats:
    rng = np.random.default_rng(0)
    means, colors = rng.normal(size=(count, 3)), rng.random((count, 3))
    return Splats(means, rng.uniform(0.001, 0.1, count), rng.uniform(0.01, 0.99, count), colors)


def test_round_trip_in_single_precision(tmp_path: Path) -> None:
    write_splats(tmp_path / "a.ply", splats())
    read = read_splats(tmp_path / "a.ply")
    for name in ("means", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(read, name), getattr(splats(), name), rtol=2e-6, atol=1e-7)
    write_splats(tmp_path / "b.ply", splats())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_layout_is_that_of_inria(tmp_path: Path) -> None:
    write_splats(tmp_path / "a.ply", splats(3), "world")
    header, _, data = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    assert header.decode().splitlines() == [
        "ply",
        "format binary_little_endian 1.0",
        "comment unit metre",
        "comment frame world",
        "element vertex 3",
        *(f"property float {name}" for name in names),
    ]
    rows = np.frombuffer(data, "<f4").reshape(3, 17)
    expected = splats(3)
    np.testing.assert_allclose(rows[:, :3], expected.means, rtol=1e-6)
    assert np.array_equal(rows[:, 3:6], np.zeros((3, 3)))
    np.testing.assert_allclose(0.5 + SH_C0 * rows[:, 6:9], expected.colors, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows[:, 9])), expected.opacities, atol=1e-6)
    np.testing.assert_allclose(np.exp(rows[:, 10:13]), np.tile(expected.scales[:, None], 3), rtol=1e-5)
    assert np.array_equal(rows[:, 13:], np.tile([1.0, 0, 0, 0], (3, 1)))


def test_padding_to_degree_three(tmp_path: Path) -> None:
    """The 62 properties of INRIA's files, in their order (scene/gaussian_model.py, construct_list_of_attributes)."""
    write_splats(tmp_path / "a.ply", splats(), sh_degree=3)
    text = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode()
    expected = [*"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split(), *(f"f_rest_{k}" for k in range(45)), "opacity"]
    expected += "scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    assert [line.split()[1:] for line in text.splitlines() if line.startswith("property")] == [
        ["float", name] for name in expected
    ]
    np.testing.assert_allclose(read_splats(tmp_path / "a.ply").means, splats().means, rtol=1e-6)


def test_anisotropic_gaussians_of_others_are_refused_with_their_number(tmp_path: Path) -> None:
    """A file as 3DGS itself writes it: no comments, 62 properties, three different scales and any rotation."""
    rng = np.random.default_rng(0)
    names = [*"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split(), *(f"f_rest_{k}" for k in range(45)), "opacity"]
    names += "scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    rows = rng.normal(size=(30, len(names))).astype("<f4")
    rows[:4, 55:58] = -3.0
    header = ["ply", "format binary_little_endian 1.0", "element vertex 30", *(f"property float {n}" for n in names)]
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes())
    with pytest.raises(InputDataError) as caught:
        read_splats(path)
    assert str(caught.value) == (
        f"{path}: 26 of 30 splats are no spheres.\nAllowed: three scales that are equal within 1 %.\n"
        "Next: leave the shape out, so that cgwm fit makes spheres from the photos."
    )
    rows[:, 55:58] = rows[:, 55:56]
    path.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + rows.tobytes())
    read = read_splats(path, harmonics=True)
    np.testing.assert_allclose(read.scales, np.exp(rows[:, 55].astype(float)), rtol=1e-6)
    assert read.harmonics is not None
    np.testing.assert_allclose(read.harmonics[:, 2, 1], rows[:, 9 + 15 + 2], rtol=1e-6)


def test_full_and_empty_opacity_stay_finite(tmp_path: Path) -> None:
    edge = Splats(np.zeros((2, 3)), np.ones(2), np.array([0.0, 1.0]), np.zeros((2, 3)))
    write_splats(tmp_path / "a.ply", edge)
    np.testing.assert_allclose(read_splats(tmp_path / "a.ply").opacities, [0, 1], atol=2e-6)


def test_text_and_big_endian_are_read(tmp_path: Path) -> None:
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2".split()
    properties = "".join(f"property double {name}\n" for name in names)
    row = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, -1.0, -1.0, -1.0]
    head = "ply\nformat {}\nelement vertex 1\n" + properties + "end_header\n"
    (tmp_path / "text.ply").write_text(head.format("ascii 1.0") + " ".join(map(str, row)) + "\n")
    (tmp_path / "big.ply").write_bytes(head.format("binary_big_endian 1.0").encode() + np.array(row, ">f8").tobytes())
    for name in ("text.ply", "big.ply"):
        read = read_splats(tmp_path / name)
        assert read.means.tolist() == [[1, 2, 3]] and read.colors.tolist() == [[0.5, 0.5, 0.5]]
        assert read.opacities.tolist() == [0.5] and read.scales[0] == pytest.approx(np.exp(-1))


def edit(path: Path, old: bytes, new: bytes) -> None:
    path.write_bytes(path.read_bytes().replace(old, new, 1))


def test_faults(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"

    def fault(old: bytes, new: bytes) -> str:
        path.unlink(missing_ok=True)
        write_splats(path, splats())
        edit(path, old, new)
        with pytest.raises(InputDataError) as caught:
            read_splats(path)
        return str(caught.value).replace(str(path), "P").splitlines()[0]

    assert fault(b"unit metre", b"unit millimetre") == "P: its header says 'comment unit millimetre'."
    assert fault(b"float opacity", b"float opacitx") == (
        "P: no property 'opacity'; it is no 3D Gaussian splatting file."
    )
    assert fault(b"vertex 20", b"vertex 21") == "P: cut off: it holds fewer than the 21 splats of its header."
    assert fault(b"ply\n", b"plx\n") == "P: no .ply file."
    assert fault(b"property float x", b"property list uchar int x").startswith("P: the .ply header cannot be read")
    assert fault(b"element vertex", b"element face") == (
        "P: the .ply header cannot be read: its first element is 'face', not 'vertex'."
    )


def test_gaussians_that_are_no_spheres_or_not_finite_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    for column, value, expected in (
        (11, 0.5, f"{path}: 1 of 20 splats are no spheres."),
        (0, np.nan, f"{path}: 'x' is not finite in 1 of 20 splats."),
    ):
        path.unlink(missing_ok=True)
        write_splats(path, splats())
        header, end, data = path.read_bytes().partition(b"end_header\n")
        rows = np.frombuffer(data, "<f4").reshape(20, 17).copy()
        rows[3, column] = value
        path.write_bytes(header + end + rows.tobytes())
        with pytest.raises(InputDataError) as caught:
            read_splats(path)
        assert str(caught.value).splitlines()[0] == expected


def test_absent_and_existing_files(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="no such file"):
        read_splats(tmp_path / "a.ply")
    write_splats(tmp_path / "a.ply", splats())
    write_splats(tmp_path / "a.ply", splats())  # the same again
    other = splats()
    other.means[0] += 1.0
    with pytest.raises(UsageError, match="exists"):
        write_splats(tmp_path / "a.ply", other)

"""Report of this machine's software and hardware, and of what cgwm uses of it; heavy packages load only on demand."""

from __future__ import annotations

import ctypes
import ctypes.util
import io
import os
import platform
import re
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

from ...datasets.io.processors import processor_limits, processors
from ...schemas.doctor import DoctorReport, ExtraState, Missing, PackageState
from .kernel_build import compiler, host_unavailable, unavailable

_IMPORT_NAMES = {"opencv-python-headless": "cv2"}
EXTRAS = {
    "view": "cgwm view",
    "heif": "cgwm import photos of .heic files",
    "ros": "cgwm import rosbag",
    "usd": "cgwm export --to usd",
    "lerobot": "cgwm export --to lerobot",
    "rerun": "cgwm export --to rerun",
    "ray": "cgwm synthesize --ray",
}
"""Extras that a user may want, and what each is for; the others are for work on cgwm itself."""
_CPU_TORCH = "pip install torch --index-url https://download.pytorch.org/whl/cpu"
_GIB = 2**30


def doctor() -> DoctorReport:
    """Report versions, devices and memory of this machine, and whether the requirements of cgwm work."""
    packages = _packages()
    torch, pycolmap, cv2 = (_load(name) for name in ("torch", "pycolmap", "cv2"))
    cuda = _cuda_devices(torch)
    zstd_fault = _zstd_fault()
    missing = [_missing_package(package) for package in packages if not package.satisfied]
    missing += _broken(packages)
    if zstd_fault and all(package.satisfied for package in packages if package.name in ("h5py", "hdf5plugin")):
        todo = "pip install --force-reinstall h5py hdf5plugin"
        missing.append(Missing(what="HDF5's zstd filter", why=zstd_fault, todo=todo))
    colmap_cuda = bool(getattr(pycolmap, "has_cuda", False))
    return DoctorReport(
        cgwm=_version("cgwm") or "not installed",
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        cpu_cores=processors(),
        memory_gib=round(memory_bytes() / _GIB, 2),
        packages=tuple(packages),
        cuda_devices=cuda,
        cuda_core=_version("cuda-core"),
        egl=_has_egl(),
        colmap=_colmap_version(pycolmap),
        colmap_cuda=colmap_cuda,
        aruco=hasattr(getattr(cv2, "aruco", None), "ArucoDetector"),
        hdf5_zstd=not zstd_fault,
        uses=_uses(cuda, not zstd_fault),
        missing=tuple(missing),
        extras=tuple(_extra(name, purpose) for name, purpose in EXTRAS.items()),
    )


def memory_bytes() -> int:
    """Return the memory that this process may use [bytes]: that of the machine, or a smaller limit of its container."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            text = Path(name).read_text().strip()
        except OSError:
            continue
        if text.isdecimal():
            total = min(total, int(text))
    return total


def satisfies(version: str, requirement: str) -> bool:
    """Return whether a version satisfies bounds such as `>=3.17,<4`; only release numbers are compared.

    >>> satisfies("3.17.0", "mujoco<4,>=3.17"), satisfies("4.0.1", "mujoco<4,>=3.17"), satisfies("2.13.0+cpu", ">=2.11")
    (True, False, True)
    """
    found = _release(version)
    for operator, bound in re.findall(r"(>=|<=|==|!=|<|>)\s*([0-9][0-9.]*)", requirement):
        limit = _release(bound)
        width = max(len(found), len(limit))
        left, right = (numbers + (0,) * (width - len(numbers)) for numbers in (found, limit))
        fulfilled = {
            ">=": left >= right,
            "<=": left <= right,
            "==": left == right,
            "!=": left != right,
            "<": left < right,
            ">": left > right,
        }
        if not fulfilled[operator]:
            return False
    return True


def _release(version: str) -> tuple[int, ...]:
    match = re.match(r"\d+(\.\d+)*", version)
    return tuple(int(part) for part in match.group().split(".")) if match else ()


def _packages() -> list[PackageState]:
    """List the requirements in the metadata of cgwm, with the installed versions."""
    try:
        requirements = metadata.requires("cgwm") or []
    except metadata.PackageNotFoundError:
        requirements = []
    states = []
    for requirement in requirements:
        if ";" in requirement:  # an extra, or another platform
            continue
        name = re.split(r"[<>=!~\[ ]", requirement, maxsplit=1)[0]
        version = _version(name)
        satisfied = version is not None and satisfies(version, requirement)
        states.append(PackageState(name=name, requirement=requirement, version=version, satisfied=satisfied))
    return states


def _extra(name: str, purpose: str) -> ExtraState:
    """Return which requirements of an extra are not fulfilled."""
    try:
        lines = [line.partition(";") for line in metadata.requires("cgwm") or []]
    except metadata.PackageNotFoundError:
        lines = []
    wanted = [line.strip() for line, _, marker in lines if re.search(rf"extra == ['\"]{name}['\"]", marker)]
    versions = {one: _version(re.split(r"[<>=!~\[ ]", one, maxsplit=1)[0]) for one in wanted}
    missing = tuple(one for one, version in versions.items() if version is None or not satisfies(version, one))
    return ExtraState(name=name, purpose=purpose, missing=missing)


def _missing_package(package: PackageState) -> Missing:
    why = f"found {package.version}, needed {package.requirement}" if package.version else "not installed"
    todo = _CPU_TORCH if package.name == "torch" and not _has_nvidia() else f"pip install '{package.requirement}'"
    return Missing(what=package.name, why=why, todo=todo)


def _broken(packages: list[PackageState]) -> list[Missing]:
    """List packages that are installed but fail to import, usually for want of a system library."""
    faults = []
    for package in packages:
        module = _IMPORT_NAMES.get(package.name, package.name)
        if not package.satisfied:
            continue
        try:
            import_module(module)
        except Exception as error:  # a broken binary may raise anything
            todo = f"pip install --force-reinstall '{package.requirement}'"
            faults.append(Missing(what=package.name, why=f"does not import: {error}", todo=todo))
    return faults


def _load(module: str) -> Any:
    """Import a package; return None where that fails, as `_broken` reports the reason."""
    try:
        return import_module(module)
    except Exception:  # as above
        return None


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _cuda_devices(torch: Any) -> tuple[str, ...]:
    if torch is None or not torch.cuda.is_available():
        return ()
    return tuple(torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count()))


def _has_nvidia() -> bool:
    return Path("/proc/driver/nvidia").exists()


def _has_egl() -> bool:
    name = ctypes.util.find_library("EGL") or "libEGL.so.1"
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _colmap_version(pycolmap: Any) -> str | None:
    if pycolmap is None:
        return None
    return str(getattr(pycolmap, "COLMAP_version", pycolmap.__version__)).removeprefix("COLMAP ")


def _zstd_fault() -> str:
    """Write and read a small compressed dataset in memory; return the fault, empty for none."""
    try:
        import h5py
        import hdf5plugin
        import numpy as np

        values, memory = np.arange(64, dtype=np.int32), io.BytesIO()
        with h5py.File(memory, "w") as file:
            file.create_dataset("values", data=values, chunks=(16,), **hdf5plugin.Zstd(clevel=1))
        with h5py.File(memory, "r") as file:
            read_back = np.asarray(file["values"])
    except Exception as error:  # h5py raises many kinds
        return f"{type(error).__name__}: {error}"
    return "" if np.array_equal(values, read_back) else "the values read back differ"


def _renderer(cuda: bool) -> str:
    if not cuda:
        reason = host_unavailable()
        return "one program, compiled at run time" if reason is None else f"torch, in tiles: {reason}"
    reason = unavailable()
    return "CUDA kernels, compiled at run time" if reason is None else f"torch, in tiles: {reason}"


def _rollouts() -> str:
    if compiler() is None:
        return "torch; a C++ compiler (g++ or clang++) would make those on the CPU about ten times as fast"
    reason = host_unavailable()
    return "one kernel, compiled at run time" if reason is None else f"torch on the CPU: {reason}"


def _threads() -> str:
    limits = processor_limits()
    least = processors()
    why = next(name for name, count in limits.items() if count == least)
    others = ", ".join(f"{name} {count}" for name, count in limits.items() if name != why)
    return f"{least}, by {why}" + (f" ({others})" if others else "") + "; threads wait without spinning"


def _uses(cuda: tuple[str, ...], zstd: bool) -> dict[str, str]:
    return {
        "device": f"cuda ({cuda[0]})" if cuda else f"cpu, {processors()} core" + "s" * (processors() > 1),
        "renderer": _renderer(bool(cuda)),
        "rollouts": _rollouts(),
        "threads": _threads(),
        "photo_features": "COLMAP on the CPU, all cores (two runs agree bit for bit)",
        "demo_renderer": "ray casting, no OpenGL",
        "compression": "zstd" if zstd else "none: --set synthesize.compression=gzip works without the filter",
    }

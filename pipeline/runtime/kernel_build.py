"""Compilation, cache and launch of kernels at run time: CUDA by NVRTC, which torch's CUDA wheels contain, and C++."""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ...schemas import UsageError

# torch is imported in the functions that need it, because `doctor` asks for the compiler where torch may be missing
if TYPE_CHECKING:
    import torch
    from torch import Tensor

HOST_FLAGS = ("-std=c++14", "-O3", "-shared", "-fPIC", "-pthread", "-w", "-ffp-contract=off", "-fno-math-errno")
HOST_FLAGS += ("-fno-trapping-math",)
"""Options of the C++ compiler: no reordering of sums, and no instructions of this processor only, as others read the
cache too. The headers of C++14 are read in a third of the time of those of C++17.
"""
HOST_BUILD_S = 120.0
"""Time limit of the C++ compiler [s]."""
NO_COMPILER = "there is no C++ compiler (g++, clang++ or c++)"


@cache
def _core() -> Any:
    try:
        core = importlib.import_module("cuda.core")
    except ImportError:
        return None
    return core if hasattr(core, "Program") else None  # before 1.0 it was experimental by name


@cache
def unavailable() -> str | None:
    """Return why CUDA kernels cannot run on this machine; None where they can. A small kernel is built and loaded."""
    import torch

    if not torch.cuda.is_available():
        return "no CUDA device was found"
    if _core() is None:
        return "cuda-core 1.0 or later, which compiles them, is not installed (pip install 'cuda-core>=1.0,<2')"
    try:
        compiled('extern "C" __global__ void nothing() {}', "nothing", torch.cuda.current_device())
    except Exception as error:  # cuda.core, NVRTC and the driver raise their own
        return f"cuda-core cannot build one for this device: {type(error).__name__}: {error}"
    return None


@cache
def available() -> bool:
    """Return whether CUDA kernels run here; where a device is there and they cannot, the log says once why."""
    import torch

    reason = unavailable()
    if reason is not None and torch.cuda.is_available():
        name = torch.cuda.get_device_name()
        text = "the CUDA kernels cannot run on %s: %s. PyTorch renders and simulates instead, many times slower."
        logging.getLogger("cgwm").warning(text, name, reason)
    return reason is None


@cache
def source_file(module: str, path: str) -> str:
    """Return the text of a CUDA or C++ file of the package in which a module is.

    Args:
        module: Name of the module, its `__name__`.
        path: The file, relative to the folder of the package.
    """
    return files(module.rpartition(".")[0]).joinpath(path).read_text(encoding="utf-8")


def compiled(source: str, name: str, device: int) -> Any:
    """Return a kernel of a source for a device, built now or by an earlier process; the caller keeps it."""
    import torch

    core = _core()
    core.Device(device).set_current()
    major, minor = torch.cuda.get_device_capability(device)
    options = {"std": "c++17", "arch": f"sm_{major}{minor}"}

    def build(work: Path) -> Path:
        found = core.Program(source, "c++", core.ProgramOptions(**options)).compile("cubin")
        (work / "kernel.cubin").write_bytes(bytes(found.code))
        return work / "kernel.cubin"

    recipe = "\n".join((f"cuda.core {core.__version__}, CUDA {torch.version.cuda}", *options.values(), source))
    program = built(recipe, ".cubin", build, lambda file: core.ObjectCode.from_cubin(file.read_bytes()))
    return program.get_kernel(name)


@cache
def most_shared_bytes(device: int) -> int:
    """Return the shared memory that a block of threads of a device may have if a kernel asks for it [bytes]."""
    return int(_core().Device(device).properties.max_shared_memory_per_block_optin)


def allow_shared_bytes(kernel: Any, size: int, device: int) -> None:
    """Let a kernel have blocks with more shared memory than any device gives without being asked.

    Raises:
        RuntimeError: If the driver refuses.
    """
    driver = importlib.import_module("cuda.bindings.driver")
    attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
    (error,) = driver.cuKernelSetAttribute(attribute, size, kernel.handle, driver.CUdevice(device))
    if int(error) != 0:
        raise RuntimeError(f"the driver gives no block {size} bytes of shared memory: {error.name}")


def launch(
    kernel: Any,
    device: torch.device,
    blocks: int,
    threads: int,
    tensors: tuple[Tensor | None, ...],
    *words: Any,
    shared_bytes: int = 0,
) -> None:
    """Launch a kernel on torch's current stream; pointers come first, null where a tensor is None.

    `shared_bytes` is the shared memory of a block beside that which the kernel declares.
    """
    import torch

    pointers = [0 if tensor is None else tensor.data_ptr() for tensor in tensors]
    stream = _stream(torch.cuda.current_stream(device).cuda_stream)
    _core().launch(stream, _config(blocks, threads, shared_bytes), kernel, *pointers, *words)


@cache
def _config(blocks: int, threads: int, shared_bytes: int) -> Any:
    return _core().LaunchConfig(grid=blocks, block=threads, shmem_size=shared_bytes)


@cache
def _stream(handle: int) -> Any:
    return _core().Stream.from_handle(handle)


@cache
def compiler() -> str | None:
    """Return the path of a C++ compiler; None where there is none, or outside of POSIX systems."""
    if os.name != "posix":
        return None
    return next((found for name in ("g++", "clang++", "c++") if (found := shutil.which(name)) is not None), None)


@cache
def compiler_version() -> str | None:
    """Return name and version of the C++ compiler, on which rounding depends; None where there is none."""
    command = compiler()
    if command is None:
        return None
    version = subprocess.run([command, "-dumpversion"], capture_output=True, text=True, check=False).stdout.strip()
    return f"{Path(command).name} {version}".strip()


@cache
def host_unavailable() -> str | None:
    """Return why C++ programs cannot be built and loaded here; None where they can."""
    return host_failure(lambda: host_library('extern "C" int answer() { return 42; }'))


def host_failure(load: Callable[[], ctypes.CDLL]) -> str | None:
    """Return why a C++ program, which `load` takes from `host_library`, does not build or load; None where it does."""
    if compiler() is None:
        return NO_COMPILER
    try:
        load()
    except (OSError, subprocess.SubprocessError) as error:
        message = error.stderr if isinstance(error, subprocess.CalledProcessError) else ""
        return f"the C++ compiler {compiler()} failed: {(message or str(error)).strip().splitlines()[-1]}"
    return None


@cache
def vector_flags() -> tuple[str, ...]:
    """Return the option of the C++ compiler for the widest vectors of this processor; none where Linux names none.

    Libraries that are built with it are cached under names of their own, so that other processors do not load them.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ()
    known = next((set(line.split()) for line in lines if line.startswith("flags")), set())
    return next(((f"-m{kind}",) for kind in ("avx512f", "avx2") if kind in known), ())


def host_library(source: str, flags: tuple[str, ...] = HOST_FLAGS) -> ctypes.CDLL:
    """Return the library of a C++ source, built now or by an earlier process.

    Args:
        source: The source.
        flags: Options of the compiler.

    Raises:
        UsageError: If there is no compiler.
    """
    command = compiler()
    if command is None:
        raise UsageError(f"{NO_COMPILER}.", todo="install one, or call the function that needs none.")

    def build(work: Path) -> Path:
        program, library = work / "program.cpp", work / "program.so"
        program.write_text(source, encoding="utf-8")
        steps = [command, *flags, str(program), "-o", str(library)]
        environment = os.environ | {"TMPDIR": str(work)}
        subprocess.run(steps, check=True, capture_output=True, text=True, timeout=HOST_BUILD_S, env=environment)
        return library

    recipe = "\n".join((command, platform.machine(), str(Path(command).stat().st_mtime_ns), *flags, source))
    return built(recipe, ".so", build, lambda library: ctypes.CDLL(str(library)))


T = TypeVar("T")


def built(recipe: str, suffix: str, build: Callable[[Path], Path], load: Callable[[Path], T]) -> T:
    """Load a product from the cache, where an earlier process may have built it by the same recipe, else build it.

    Args:
        recipe: Everything that the product depends on: source, compiler, options, machine.
        suffix: Suffix of the cached file.
        build: Function that makes the product in an empty folder, and returns its path.
        load: Function that reads the product.
    """
    name = hashlib.sha256(recipe.encode()).hexdigest()[:32] + suffix
    kept = folder()
    if kept is not None and (kept / name).exists():
        return load(kept / name)
    # an interrupted compiler leaves temporary files: they are in this folder, too
    with tempfile.TemporaryDirectory(dir=kept, prefix="build-", ignore_cleanup_errors=True) as work:
        product = build(Path(work))
        if kept is None:
            return load(product)
        # atomic: other processes see the complete file or none
        product.replace(kept / name)
    return load(kept / name)


def folder() -> Path | None:
    """Return the cache of built kernels; None where it is not writable, or is writable by other users."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    found = Path(base) / "cgwm" / "kernels"
    try:
        found.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = found.stat()
    except OSError:
        return None
    safe = status.st_uid == os.getuid() and not status.st_mode & 0o022
    return found if safe and os.access(found, os.W_OK) else None

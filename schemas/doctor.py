"""What `cgwm doctor` reports."""

from __future__ import annotations

from .base import FileModel


class PackageState(FileModel):
    """A package that cgwm depends on."""

    name: str
    requirement: str
    """What cgwm asks for, for example `mujoco<4,>=3.17`."""
    version: str | None = None
    """The installed version; none where it is missing."""
    satisfied: bool


class Missing(FileModel):
    """Something that has to be mended."""

    what: str
    why: str
    todo: str
    """What to type."""


class ExtraState(FileModel):
    """An extra of cgwm: packages for one purpose, never required."""

    name: str
    purpose: str
    missing: tuple[str, ...] = ()
    """Requirements that are not fulfilled; none where the extra is ready."""


class DoctorReport(FileModel):
    """What a machine has, and what cgwm would use of it."""

    cgwm: str
    python: str
    platform: str
    cpu_cores: int
    """Cores that this process may use."""
    memory_gib: float
    """Memory that this process may use [GiB]: the machine's, or its container's limit."""
    packages: tuple[PackageState, ...]
    cuda_devices: tuple[str, ...] = ()
    """Names of the CUDA devices that torch sees."""
    cuda_core: str | None = None
    """Version of cuda-core, which compiles the CUDA kernels; a dependency on Linux x86-64 only."""
    egl: bool = False
    """Whether libEGL loads; never required."""
    colmap: str | None = None
    """COLMAP's version, through pycolmap."""
    colmap_cuda: bool = False
    """Whether COLMAP extracts features on a CUDA device."""
    aruco: bool = False
    """Whether OpenCV has its marker detector."""
    hdf5_zstd: bool = False
    """Whether a zstd-compressed HDF5 dataset can be written and read back."""
    uses: dict[str, str]
    """What cgwm would use, by purpose."""
    missing: tuple[Missing, ...] = ()
    extras: tuple[ExtraState, ...] = ()

    @property
    def ready(self) -> bool:
        """Whether nothing that cgwm needs is missing."""
        return not self.missing

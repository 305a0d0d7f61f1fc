"""The verb `cgwm doctor`: report what this machine has."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from .execution import Emit
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import DoctorReport


@verb
def doctor(emit: Emit) -> None:
    """Report what this machine has, what is missing, and what cgwm would use."""
    from ..pipeline.runtime.doctor import doctor as work

    report = work()
    emit(report, _summary)
    if not report.ready:
        raise typer.Exit(1)


def _summary(report: DoctorReport) -> str:
    from .output import table

    verdict = "ready" if report.ready else "not ready"
    lines = [f"cgwm {report.cgwm}: {verdict}."]
    lines += [f"  missing: {item.what} ({item.why}). Next: {item.todo}" for item in report.missing]
    packages = [[package.name, package.version or "missing", package.requirement] for package in report.packages]
    extras = [
        [one.name, f"missing: {', '.join(one.missing)}" if one.missing else "ready", one.purpose]
        for one in report.extras
    ]
    uses = [[name.replace("_", " "), text] for name, text in report.uses.items()]
    blocks = [("This machine", _machine(report)), ("Packages", packages)]
    blocks += [("Extras, pip install 'cgwm[NAME]'", extras), ("What cgwm would use", uses)]
    return "\n".join([*lines, *(f"{title}\n{table(rows)}" for title, rows in blocks)])


def _machine(report: DoctorReport) -> list[list[str]]:
    return [
        ["python", f"{report.python} on {report.platform}"],
        ["cores, memory for cgwm", f"{report.cpu_cores}, {report.memory_gib:.1f} GiB"],
        ["CUDA", ", ".join(report.cuda_devices) or "no device"],
        ["cuda-core", report.cuda_core or "not installed (optional)"],
        ["EGL", "loads" if report.egl else "not found (optional)"],
        ["COLMAP", f"{report.colmap or 'missing'}, {'CUDA' if report.colmap_cuda else 'CPU'} SIFT"],
        ["HDF5 zstd", "works" if report.hdf5_zstd else "does not work"],
    ]

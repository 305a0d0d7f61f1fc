"""The verb `cgwm export`: convert a dataset or a model to the format of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from .execution import Emit
from .options import Overwrite, TrustEffects, trust
from .usage import refuse_foreign
from .verb import verb

if TYPE_CHECKING:
    from ..schemas import ExportResult


@verb
def export(
    emit: Emit,
    thing: Annotated[Path, typer.Argument(metavar="THING", help="A dataset or a model.", show_default=False)],
    to: Annotated[
        Literal["lerobot", "bop", "nerfstudio", "rerun", "mjcf", "urdf", "sdf", "usd", "ply", "colmap", "glb", "mesh"],
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="For a dataset: lerobot (v3), bop (scenewise), nerfstudio (transforms.json of one rollout), "
            "rerun (.rrd of one rollout). "
            "For a model: mjcf, urdf, sdf (Gazebo, Drake), usd (with physics), ply (3D Gaussian splatting), colmap, "
            "glb (KHR_gaussian_splatting), mesh (triangles with colours, .glb).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="PATH",
            help="The directory to write; for mjcf an .xml, for usd a .usda, for glb and mesh a .glb, for rerun "
            "an .rrd, for ply a directory or a single .ply.",
            show_default=False,
        ),
    ],
    split: Annotated[
        str | None, typer.Option("--split", help="lerobot, bop: only these rollouts (all).", show_default=False)
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras",
            metavar="NAME,...",
            help="lerobot, bop, nerfstudio, rerun: only these (all).",
            show_default=False,
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(
            "--every", min=1, help="lerobot, bop, nerfstudio, rerun: every n-th frame (1).", show_default=False
        ),
    ] = None,
    task: Annotated[
        str | None, typer.Option("--task", help="lerobot: description of the task.", show_default=False)
    ] = None,
    rollout: Annotated[
        int | None,
        typer.Option("--rollout", min=0, help="nerfstudio, rerun: index of the rollout (0).", show_default=False),
    ] = None,
    mask: Annotated[
        Literal["none", "scene", "bodies"] | None,
        typer.Option(
            "--mask",
            help="nerfstudio: pixels that count; scene excludes the moving bodies (none: all count).",
            show_default=False,
        ),
    ] = None,
    sh_degree: Annotated[
        int | None,
        typer.Option(
            "--sh-degree", min=0, max=3, help="ply: pad with zeros; INRIA's viewer needs 3 (0).", show_default=False
        ),
    ] = None,
    capture: Annotated[
        Path | None,
        typer.Option(
            "--capture", metavar="CAPTURE", help="colmap: the capture with photos and cameras.", show_default=False
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="mjcf, urdf, sdf, usd: seed of what is compared (0).", show_default=False),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option("--duration", min=0.02, help="mjcf: length of that motion [s] (1).", show_default=False),
    ] = None,
    overwrite: Overwrite = False,
    trust_effects: TrustEffects = "",
) -> None:
    """Convert a dataset or a model to the format of another tool."""
    given = {"split": split, "cameras": cameras, "every": every, "task": task, "rollout": rollout, "mask": mask}
    given |= {"sh_degree": sh_degree, "capture": capture, "seed": seed, "duration_s": duration}
    trust(trust_effects)
    from ..pipeline.export import export as work
    from ..pipeline.export.stage import OPTIONS, ExportOptions

    words = {name: value for name, value in given.items() if value is not None}
    refuse_foreign(words, OPTIONS[to], f"--to {to}")
    if cameras is not None:
        words["cameras"] = tuple(name.strip() for name in cameras.split(","))
    emit(work(thing, to, out, ExportOptions(**words), overwrite), _summary)


def _summary(result: ExportResult) -> str:
    from .output import table, warnings

    rows = [[name.replace("_", " "), _text(value)] for name, value in result.facts.items()]
    return "\n".join([f"Wrote {result.out} ({result.format}).", table(rows), *warnings(result.notes)])


def _text(value: float | str) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)

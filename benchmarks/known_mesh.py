"""Bodies whose surface is known: held-out pictures, and how far the colliding spheres are from the true surface.

    python benchmarks/known_mesh.py [--objects built-in,mug,power_drill] [--views 48] [--size 400] [--spheres 16000]
        [--two-step RATE] [--collision-spheres N] [--depth-noise-mm 1]

Clean photos from all around of a mesh that floats before one colour (mesh_photos.py), with its masks and cameras; every
eighth is held out. Distances are between the true surface, all of it (the inside of a mug too), and the surface of the
union of the colliding spheres, both ways, over area, in per cent of the diagonal of the mesh's bounding box. From the
spheres to the mesh they are to the nearest of a million points on it, which overstates them by at most 0.15 mm.
`built-in` is the L-block of the built-in scenes' seed 2; the others are YCB scans, mug and drill the test, the rest
(banana, mustard_bottle, rubiks_cube) those with which settings were chosen. The bar of the PSNR is for `built-in`.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from cgwm.datasets.models.model import read_model
from cgwm.datasets.shapes.meshes import Mesh
from cgwm.pipeline.fit import fit
from cgwm.pipeline.geometry.surface_distance import Gap, Union
from cgwm.schemas import SplatConfig
from mesh_photos import Painted, built_in, scanned, write_capture
from numpy.typing import NDArray
from scipy.spatial import KDTree
from store import Store, shared_data

PSNR_DB, MOST_SPHERES = 30.0, 500
SURFACE_PER_CENT = {"built-in": 1.5}
SURFACE_PER_CENT_SCANNED = 2.0
BUILT_IN_SEED = 2
_POINTS, _QUERIES = 1_000_000, 40_000

Array = NDArray[np.float64]


def measure(
    painted: Painted, views: int, size: int, config: SplatConfig, depth_noise_m: float | None
) -> dict[str, Any]:
    """Photograph, fit and compare one object."""
    with tempfile.TemporaryDirectory() as folder:
        capture, out = Path(folder) / "capture", Path(folder) / "model"
        write_capture(capture, painted, views, size, depth_noise_m)
        started, cpu = time.perf_counter(), time.process_time()
        fit(capture, out, "sg-gs", splat_config=config)
        seconds, cpu = time.perf_counter() - started, time.process_time() - cpu
        model = read_model(out)
    body, record = model.file.bodies[0], model.fit.stages["sg-gs"]
    held_out, spheres = record["held_out"], model.collision[body.name]
    centers = np.asarray(spheres.means, float) + np.array(body.photo_pose.position_m)
    union = Union.of(centers, body.radius_factor * np.asarray(spheres.scales, float))
    points = surface_points(painted.mesh, _POINTS)
    visual = model.body_splats[body.name]
    seen_centers = np.asarray(visual.means, float) + np.array(body.photo_pose.position_m)
    seen = Union.of(seen_centers, body.radius_factor * np.asarray(visual.scales, float))
    seen_error = 0.5 * (seen.distance(points[:_QUERIES]).mean() + KDTree(points).query(seen.surface)[0].mean())
    to_spheres, to_mesh = Gap.of(union.distance(points[:_QUERIES])), Gap.of(KDTree(points).query(union.surface)[0])
    extent = np.ptp(painted.mesh.vertices, axis=0)
    mean = 0.5 * (to_spheres.mean_m + to_mesh.mean_m)
    return {
        "fit_wall_s": round(seconds, 1),
        "fit_cpu_s": round(cpu, 1),
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
        "psnr_object_db": held_out["psnr_object_db"],
        "psnr_db": held_out["psnr_db"],
        "ssim": held_out["ssim"],
        "mask_iou": held_out["mask_iou"],
        "visual_spheres": len(model.body_splats[body.name]),
        "collision_spheres": len(spheres),
        "mesh_to_spheres_mm": _millimetres(to_spheres),
        "spheres_to_mesh_mm": _millimetres(to_mesh),
        "visual_surface_error_per_cent": round(100 * seen_error / float(np.linalg.norm(extent)), 3),
        "surface_error_per_cent": round(100 * mean / float(np.linalg.norm(extent)), 3),
        "surface_error_per_cent_of_longest_side": round(100 * mean / float(extent.max()), 3),
    }


def surface_points(mesh: Mesh, count: int) -> Array:
    """Return points spread evenly, by chance, over a mesh [m], shape (count, 3)."""
    rng = np.random.default_rng(0)
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    root, along = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - root) * a[face] + root * (1 - along) * b[face] + root * along * c[face]


def _millimetres(gap: Gap) -> dict[str, float]:
    figures = {"mean": gap.mean_m, "95 %": gap.percentile_95_m, "max": gap.max_m}
    return {name: round(1e3 * value, 2) for name, value in figures.items()}


def verdict(name: str, row: dict[str, Any]) -> list[bool]:
    """Print a line for each bar; return which are met."""
    surface = SURFACE_PER_CENT.get(name, SURFACE_PER_CENT_SCANNED)
    bars = [
        ("surface error", row["surface_error_per_cent"], f"< {surface} %", row["surface_error_per_cent"] < surface),
        ("spheres", row["collision_spheres"], f"<= {MOST_SPHERES}", row["collision_spheres"] <= MOST_SPHERES),
    ]
    if name == "built-in":
        bars += [("PSNR in the mask", row["psnr_object_db"], f">= {PSNR_DB} dB", row["psnr_object_db"] >= PSNR_DB)]
    for what, value, bar, met in bars:
        print(f"{name}: {what} {value} ({bar}): {'met' if met else 'MISSED'}")
    return [met for *_, met in bars]


def main() -> int:
    """Print one JSON line an object and the verdicts; return 1 if a bar is missed, 2 where the scans are not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", default="built-in,mug,power_drill")
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spheres", type=int, default=16000, help="visual spheres of the body")
    parser.add_argument(
        "--collision-spheres", type=int, help="most colliding spheres; the default of sg-gs if left out"
    )
    parser.add_argument(
        "--two-step", type=float, metavar="RATE", help="geometry first; its rate while colours are fitted"
    )
    parser.add_argument("--depth-noise-mm", type=float, help="give depth maps with so much noise")
    words = parser.parse_args()
    noise_m = None if words.depth_noise_mm is None else 1e-3 * words.depth_noise_mm
    config = SplatConfig(image_size=words.size, max_body_spheres=words.spheres, max_scene_spheres=500)
    config = config.model_copy(update={"turntable": False})
    if words.two_step is not None:
        config = config.model_copy(update={"joint": False, "geometry_rate": words.two_step})
    if words.collision_spheres is not None:
        config = config.model_copy(update={"max_collision_spheres": words.collision_spheres})
    data, store, met = shared_data(), Store("known_mesh"), []
    with tempfile.TemporaryDirectory() as folder:
        for name in words.objects.split(","):
            if name == "built-in":
                painted = built_in(BUILT_IN_SEED)
            elif data is None:
                print("no scans: set CGWM_SHARED_DATA", file=sys.stderr)
                return 2
            else:
                with tarfile.open(data / "ycb.tar.xz") as archive:
                    archive.extractall(folder, filter="data")
                painted = scanned(Path(folder) / "ycb" / "ycb" / name)
            key = f"{name}, {words.views} views, {words.size} px, {config.max_body_spheres} visual spheres, "
            key += f"at most {config.max_collision_spheres} colliding"
            key += "" if words.two_step is None else f", geometry first, then at {words.two_step:g} of its rate"
            key += "" if noise_m is None else f", depth maps with {words.depth_noise_mm:g} mm of noise"
            row = store.result(key, lambda painted=painted: measure(painted, words.views, words.size, config, noise_m))
            met += verdict(name, row)
    print(f"{sum(met)} of {len(met)} bars met")
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Captures, models and rollouts on disk: readers, writers and importers. No torch at import.

The names below are imported on first use, so that importing this package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .capture.cameras import Camera, camera_of, read_cameras, to_intrinsics
    from .capture.capture import Capture
    from .capture.check import CaptureFacts, check_capture
    from .capture.images import read_label, read_rgb, write_image
    from .capture.manifest import manifest_toml, write_manifest
    from .capture.tracks import Track, read_tracks, write_tracks
    from .capture.video import read_video
    from .importers.arkit import import_arkit
    from .importers.balldrops import import_balldrops
    from .importers.contactnets import import_contactnets
    from .importers.csv_tracks import import_csv
    from .importers.elbow import import_elbow
    from .importers.hdf5_tracks import import_hdf5
    from .importers.jugglebot import import_jugglebot
    from .importers.phone_scans import import_polycam, import_record3d
    from .importers.photo_folder import import_photos
    from .importers.pinwm import import_pinwm
    from .importers.posed_photos import import_colmap, import_nerfstudio
    from .importers.pushes import import_pushes
    from .importers.realsense import import_realsense
    from .importers.recordings import Units
    from .importers.rosbag import import_rosbag
    from .importers.tum import import_tum
    from .importers.walk_video import import_video
    from .io.atomic import new_directory, new_file, sha256
    from .io.kinds import kind_of
    from .io.progress import progress
    from .models.mjcf import write_mjcf
    from .models.model import Model, read_model, write_model
    from .rollouts.dataset import read_manifest
    from .rollouts.loader import RolloutDataset, RolloutReader
    from .shapes.meshes import Mesh, SolidProperties, mass_properties, read_mesh
    from .shapes.ply import Splats, read_splats, write_splats

_HOMES = {
    "io.atomic": ("new_directory", "new_file", "sha256"),
    "importers.arkit": ("import_arkit",),
    "importers.realsense": ("import_realsense",),
    "importers.balldrops": ("import_balldrops",),
    "capture.cameras": ("Camera", "camera_of", "read_cameras", "to_intrinsics"),
    "capture.capture": ("Capture",),
    "capture.check": ("CaptureFacts", "check_capture"),
    "importers.contactnets": ("import_contactnets",),
    "importers.csv_tracks": ("import_csv",),
    "importers.elbow": ("import_elbow",),
    "rollouts.dataset": ("read_manifest",),
    "importers.hdf5_tracks": ("import_hdf5",),
    "capture.images": ("read_label", "read_rgb", "write_image"),
    "importers.jugglebot": ("import_jugglebot",),
    "importers.pushes": ("import_pushes",),
    "io.kinds": ("kind_of",),
    "rollouts.loader": ("RolloutDataset", "RolloutReader"),
    "capture.manifest": ("manifest_toml", "write_manifest"),
    "shapes.meshes": ("Mesh", "SolidProperties", "mass_properties", "read_mesh"),
    "models.mjcf": ("write_mjcf",),
    "models.model": ("Model", "read_model", "write_model"),
    "importers.pinwm": ("import_pinwm",),
    "shapes.ply": ("Splats", "read_splats", "write_splats"),
    "io.progress": ("progress",),
    "importers.recordings": ("Units",),
    "importers.rosbag": ("import_rosbag",),
    "capture.tracks": ("Track", "read_tracks", "write_tracks"),
    "importers.photo_folder": ("import_photos",),
    "importers.walk_video": ("import_video",),
    "importers.posed_photos": (
        "import_colmap",
        "import_nerfstudio",
    ),
    "importers.phone_scans": (
        "import_polycam",
        "import_record3d",
    ),
    "importers.tum": ("import_tum",),
    "capture.video": ("read_video",),
}
_PUBLIC = {name: f".{module}" for module, names in _HOMES.items() for name in names}

__all__ = [
    "Camera",
    "Capture",
    "CaptureFacts",
    "Mesh",
    "Model",
    "RolloutDataset",
    "RolloutReader",
    "SolidProperties",
    "Splats",
    "Track",
    "Units",
    "camera_of",
    "check_capture",
    "import_arkit",
    "import_balldrops",
    "import_colmap",
    "import_contactnets",
    "import_csv",
    "import_elbow",
    "import_hdf5",
    "import_jugglebot",
    "import_nerfstudio",
    "import_photos",
    "import_pinwm",
    "import_polycam",
    "import_pushes",
    "import_realsense",
    "import_record3d",
    "import_rosbag",
    "import_tum",
    "import_video",
    "kind_of",
    "manifest_toml",
    "mass_properties",
    "new_directory",
    "new_file",
    "progress",
    "read_cameras",
    "read_label",
    "read_manifest",
    "read_mesh",
    "read_model",
    "read_rgb",
    "read_splats",
    "read_tracks",
    "read_video",
    "sha256",
    "to_intrinsics",
    "write_image",
    "write_manifest",
    "write_mjcf",
    "write_model",
    "write_splats",
    "write_tracks",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _PUBLIC:
        value = getattr(import_module(_PUBLIC[name], __name__), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

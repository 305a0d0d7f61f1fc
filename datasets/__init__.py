"""Captures, models and rollouts on disk: readers, writers and importers. No torch at import.

The names below are imported on first use, so that importing this package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .atomic import new_directory, new_file, sha256
    from .balldrops import import_balldrops
    from .cameras import Camera, camera_of, read_cameras, to_intrinsics
    from .capture import Capture
    from .check import CaptureFacts, check_capture
    from .contactnets import import_contactnets
    from .csv_tracks import import_csv
    from .dataset import read_manifest
    from .hdf5_tracks import import_hdf5
    from .images import read_label, read_rgb, write_image
    from .jugglebot import import_jugglebot
    from .kinds import kind_of
    from .loader import RolloutDataset, RolloutReader
    from .manifest import manifest_toml, write_manifest
    from .meshes import Mesh, SolidProperties, mass_properties, read_mesh
    from .mjcf import write_mjcf
    from .models import Model, read_model, write_model
    from .pinwm import import_pinwm
    from .ply import Splats, read_splats, write_splats
    from .progress import progress
    from .recordings import Units
    from .rosbag import import_rosbag
    from .tracks import Track, read_tracks, write_tracks
    from .tum import import_tum
    from .video import read_video

_HOMES = {
    "atomic": ("new_directory", "new_file", "sha256"),
    "balldrops": ("import_balldrops",),
    "cameras": ("Camera", "camera_of", "read_cameras", "to_intrinsics"),
    "capture": ("Capture",),
    "check": ("CaptureFacts", "check_capture"),
    "contactnets": ("import_contactnets",),
    "csv_tracks": ("import_csv",),
    "dataset": ("read_manifest",),
    "hdf5_tracks": ("import_hdf5",),
    "images": ("read_label", "read_rgb", "write_image"),
    "jugglebot": ("import_jugglebot",),
    "kinds": ("kind_of",),
    "loader": ("RolloutDataset", "RolloutReader"),
    "manifest": ("manifest_toml", "write_manifest"),
    "meshes": ("Mesh", "SolidProperties", "mass_properties", "read_mesh"),
    "mjcf": ("write_mjcf",),
    "models": ("Model", "read_model", "write_model"),
    "pinwm": ("import_pinwm",),
    "ply": ("Splats", "read_splats", "write_splats"),
    "progress": ("progress",),
    "recordings": ("Units",),
    "rosbag": ("import_rosbag",),
    "tracks": ("Track", "read_tracks", "write_tracks"),
    "tum": ("import_tum",),
    "video": ("read_video",),
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
    "import_balldrops",
    "import_contactnets",
    "import_csv",
    "import_hdf5",
    "import_jugglebot",
    "import_pinwm",
    "import_rosbag",
    "import_tum",
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

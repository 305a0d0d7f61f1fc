"""cgwm: fitted, physics-grounded world models from photos and one short contact-rich motion.

The command line (``cgwm --help``) and this package offer the same stages. Heavy packages are imported when a
stage is first used, so that importing :mod:`cgwm` costs milliseconds.
"""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as in typing: the command imports nothing that takes time before it handles signals

_PUBLIC = {
    "CalibrateConfig": ".schemas",
    "Capture": ".datasets.capture",
    "CgwmError": ".schemas",
    "CheckFailedError": ".schemas",
    "ClosedLoop": ".pipeline.control",
    "ControlPlan": ".pipeline.control",
    "ControlState": ".pipeline.control",
    "Controller": ".pipeline.control",
    "DamagedShardError": ".schemas",
    "HandController": ".pipeline.control",
    "InputDataError": ".schemas",
    "Model": ".datasets.models",
    "NotConvergedError": ".schemas",
    "NotEnoughMemoryError": ".schemas",
    "NotEnoughSpaceError": ".schemas",
    "PhysConfig": ".schemas",
    "Reach": ".pipeline.control",
    "SplatConfig": ".schemas",
    "SynthesizeConfig": ".schemas",
    "Targets": ".pipeline.control",
    "UsageError": ".schemas",
    "Velocity": ".pipeline.control",
    "__version__": ".version",
    "calibrate": ".pipeline.calibrate",
    "compare": ".pipeline.compare",
    "control": ".pipeline.control",
    "diagnose": ".pipeline.diagnose",
    "doctor": ".pipeline.runtime.doctor",
    "evaluate": ".pipeline.evaluate",
    "export": ".pipeline.export",
    "fit": ".pipeline.fit",
    "import_arkit": ".datasets.importers.arkit",
    "import_balldrops": ".datasets.importers.balldrops",
    "import_colmap": ".datasets.importers.posed_photos",
    "import_contactnets": ".datasets.importers.contactnets",
    "import_csv": ".datasets.importers.csv_tracks",
    "import_elbow": ".datasets.importers.elbow",
    "import_hdf5": ".datasets.importers.hdf5_tracks",
    "import_jugglebot": ".datasets.importers.jugglebot",
    "import_nerfstudio": ".datasets.importers.posed_photos",
    "import_photos": ".datasets.importers.photo_folder",
    "import_pinwm": ".datasets.importers.pinwm",
    "import_polycam": ".datasets.importers.phone_scans",
    "import_pushes": ".datasets.importers.pushes",
    "import_realsense": ".datasets.importers.realsense",
    "import_record3d": ".datasets.importers.phone_scans",
    "import_rosbag": ".datasets.importers.rosbag",
    "import_tum": ".datasets.importers.tum",
    "import_video": ".datasets.importers.walk_video",
    "improve": ".pipeline.improve",
    "mask": ".pipeline.mask",
    "merge": ".pipeline.synthesize",
    "open_view": ".pipeline.view",
    "read_model": ".datasets.models",
    "run_control_demo": ".pipeline.demo",
    "run_demo": ".pipeline.demo",
    "run_mystery": ".pipeline.demo",
    "run_world": ".pipeline.demo",
    "synthesize": ".pipeline.synthesize",
    "validate": ".pipeline.validate",
}

# Installed, all rooms lie in this package; in the source tree they lie next to it.
# pyright: reportMissingImports=false
if TYPE_CHECKING:
    from typing import Any

    from .datasets.capture import Capture
    from .datasets.importers.arkit import import_arkit
    from .datasets.importers.balldrops import import_balldrops
    from .datasets.importers.contactnets import import_contactnets
    from .datasets.importers.csv_tracks import import_csv
    from .datasets.importers.elbow import import_elbow
    from .datasets.importers.hdf5_tracks import import_hdf5
    from .datasets.importers.jugglebot import import_jugglebot
    from .datasets.importers.phone_scans import import_polycam, import_record3d
    from .datasets.importers.photo_folder import import_photos
    from .datasets.importers.pinwm import import_pinwm
    from .datasets.importers.posed_photos import import_colmap, import_nerfstudio
    from .datasets.importers.pushes import import_pushes
    from .datasets.importers.realsense import import_realsense
    from .datasets.importers.rosbag import import_rosbag
    from .datasets.importers.tum import import_tum
    from .datasets.importers.walk_video import import_video
    from .datasets.models import Model, read_model
    from .pipeline.calibrate import calibrate
    from .pipeline.compare import compare
    from .pipeline.control import (
        ClosedLoop,
        Controller,
        ControlPlan,
        ControlState,
        HandController,
        Reach,
        Targets,
        Velocity,
        control,
    )
    from .pipeline.demo import (
        run_control_demo,
        run_demo,
        run_mystery,
        run_world,
    )
    from .pipeline.diagnose import diagnose
    from .pipeline.evaluate import evaluate
    from .pipeline.export import export
    from .pipeline.fit import fit
    from .pipeline.improve import improve
    from .pipeline.mask import mask
    from .pipeline.runtime.doctor import doctor
    from .pipeline.synthesize import (
        merge,
        synthesize,
    )
    from .pipeline.validate import validate
    from .pipeline.view import open_view
    from .schemas import (
        CalibrateConfig,
        CgwmError,
        CheckFailedError,
        DamagedShardError,
        InputDataError,
        NotConvergedError,
        NotEnoughMemoryError,
        NotEnoughSpaceError,
        PhysConfig,
        SplatConfig,
        SynthesizeConfig,
        UsageError,
    )

    __version__: str

__all__ = [
    "CalibrateConfig",
    "Capture",
    "CgwmError",
    "CheckFailedError",
    "ClosedLoop",
    "ControlPlan",
    "ControlState",
    "Controller",
    "DamagedShardError",
    "HandController",
    "InputDataError",
    "Model",
    "NotConvergedError",
    "NotEnoughMemoryError",
    "NotEnoughSpaceError",
    "PhysConfig",
    "Reach",
    "SplatConfig",
    "SynthesizeConfig",
    "Targets",
    "UsageError",
    "Velocity",
    "__version__",
    "calibrate",
    "compare",
    "control",
    "diagnose",
    "doctor",
    "evaluate",
    "export",
    "fit",
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
    "improve",
    "mask",
    "merge",
    "open_view",
    "read_model",
    "run_control_demo",
    "run_demo",
    "run_mystery",
    "run_world",
    "synthesize",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name], __name__), name)
    raise AttributeError(f"module 'cgwm' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

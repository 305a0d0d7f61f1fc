"""cgwm: fitted, physics-grounded world models from photos and one short contact-rich motion.

The command line (``cgwm --help``) and this package offer the same stages. Heavy packages are imported when a
stage is first used, so that importing :mod:`cgwm` costs milliseconds.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

try:
    __version__ = version("cgwm")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"

_PUBLIC = {
    "CalibrateConfig": ".schemas",
    "Capture": ".datasets.capture",
    "CgwmError": ".schemas",
    "CheckFailedError": ".schemas",
    "DamagedShardError": ".schemas",
    "InputDataError": ".schemas",
    "Model": ".datasets.models",
    "NotConvergedError": ".schemas",
    "NotEnoughMemoryError": ".schemas",
    "NotEnoughSpaceError": ".schemas",
    "PhysConfig": ".schemas",
    "SplatConfig": ".schemas",
    "SynthesizeConfig": ".schemas",
    "UsageError": ".schemas",
    "calibrate": ".pipeline.calibrate",
    "compare": ".pipeline.compare",
    "diagnose": ".pipeline.diagnose",
    "doctor": ".pipeline.doctor",
    "evaluate": ".pipeline.eval",
    "export": ".pipeline.export",
    "fit": ".pipeline.fit",
    "import_balldrops": ".datasets.balldrops",
    "import_contactnets": ".datasets.contactnets",
    "import_csv": ".datasets.csv_tracks",
    "import_hdf5": ".datasets.hdf5_tracks",
    "import_jugglebot": ".datasets.jugglebot",
    "import_pinwm": ".datasets.pinwm",
    "import_rosbag": ".datasets.rosbag",
    "import_tum": ".datasets.tum",
    "merge": ".pipeline.merge",
    "open_view": ".pipeline.view",
    "read_model": ".datasets.models",
    "run_demo": ".pipeline.demo",
    "run_mystery": ".pipeline.mystery",
    "synthesize": ".pipeline.synthesize",
    "validate": ".pipeline.validate",
}

if TYPE_CHECKING:  # installed, all rooms lie in this package; in the source tree they lie beside it
    from .datasets.balldrops import import_balldrops  # pyright: ignore[reportMissingImports]
    from .datasets.capture import Capture  # pyright: ignore[reportMissingImports]
    from .datasets.contactnets import import_contactnets  # pyright: ignore[reportMissingImports]
    from .datasets.csv_tracks import import_csv  # pyright: ignore[reportMissingImports]
    from .datasets.hdf5_tracks import import_hdf5  # pyright: ignore[reportMissingImports]
    from .datasets.jugglebot import import_jugglebot  # pyright: ignore[reportMissingImports]
    from .datasets.models import Model, read_model  # pyright: ignore[reportMissingImports]
    from .datasets.pinwm import import_pinwm  # pyright: ignore[reportMissingImports]
    from .datasets.rosbag import import_rosbag  # pyright: ignore[reportMissingImports]
    from .datasets.tum import import_tum  # pyright: ignore[reportMissingImports]
    from .pipeline.calibrate import calibrate  # pyright: ignore[reportMissingImports]
    from .pipeline.compare import compare  # pyright: ignore[reportMissingImports]
    from .pipeline.demo import run_demo  # pyright: ignore[reportMissingImports]
    from .pipeline.diagnose import diagnose  # pyright: ignore[reportMissingImports]
    from .pipeline.doctor import doctor  # pyright: ignore[reportMissingImports]
    from .pipeline.eval import evaluate  # pyright: ignore[reportMissingImports]
    from .pipeline.export import export  # pyright: ignore[reportMissingImports]
    from .pipeline.fit import fit  # pyright: ignore[reportMissingImports]
    from .pipeline.merge import merge  # pyright: ignore[reportMissingImports]
    from .pipeline.mystery import run_mystery  # pyright: ignore[reportMissingImports]
    from .pipeline.synthesize import synthesize  # pyright: ignore[reportMissingImports]
    from .pipeline.validate import validate  # pyright: ignore[reportMissingImports]
    from .pipeline.view import open_view  # pyright: ignore[reportMissingImports]
    from .schemas import (  # pyright: ignore[reportMissingImports]
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

__all__ = [
    "CalibrateConfig",
    "Capture",
    "CgwmError",
    "CheckFailedError",
    "DamagedShardError",
    "InputDataError",
    "Model",
    "NotConvergedError",
    "NotEnoughMemoryError",
    "NotEnoughSpaceError",
    "PhysConfig",
    "SplatConfig",
    "SynthesizeConfig",
    "UsageError",
    "__version__",
    "calibrate",
    "compare",
    "diagnose",
    "doctor",
    "evaluate",
    "export",
    "fit",
    "import_balldrops",
    "import_contactnets",
    "import_csv",
    "import_hdf5",
    "import_jugglebot",
    "import_pinwm",
    "import_rosbag",
    "import_tum",
    "merge",
    "open_view",
    "read_model",
    "run_demo",
    "run_mystery",
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

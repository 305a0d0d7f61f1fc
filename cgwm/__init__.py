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
    "CgwmError": ".schemas",
    "Capture": ".datasets",
}

if TYPE_CHECKING:
    from .datasets import Capture
    from .schemas import CgwmError

__all__ = ["Capture", "CgwmError", "__version__"]


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name], __name__), name)
    raise AttributeError(f"module 'cgwm' has no attribute {name!r}")

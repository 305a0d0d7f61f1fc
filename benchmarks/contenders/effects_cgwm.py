"""`cgwm fit` and `cgwm diagnose` with nothing set: what a user gets."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.fit import fit
from cgwm.schemas import CgwmError

from .effects_base import Named


class Cgwm:
    """cgwm itself; with `refit` the named effects are added, and the errors on the test split are compared.

    `refit` opens the test split after the verdict, which it does not change.
    """

    name: str = "cgwm"

    def __init__(self, refit: bool = False) -> None:
        self._refit = refit

    def missing(self) -> str | None:
        """Return None: cgwm is installed."""
        return None

    def names(self, capture: Path) -> Named:
        """Fit and diagnose the training split."""
        from diagnose import added, base_settings, brief

        physics = base_settings("tracks")
        with tempfile.TemporaryDirectory() as folder:
            base, began = Path(folder) / "m0", time.process_time()
            try:
                fit(capture, base, stage="phys-geo", phys_config=physics)
                found = diagnose(base, capture).model_dump(mode="json")
            except CgwmError as error:
                return Named(details={"refused": error.found})
            details = {"found": brief(found), "diagnose_cpu_s": round(time.process_time() - began, 1)}
            if self._refit and found["selected"]:
                details |= added(capture, base, Path(folder) / "m1", found["selected"], physics)
        strange = found["verdict"] == "unexplained" or bool(found["remaining_unexplained"])
        aliases = tuple(tuple(group) for group in found["aliases"])
        return Named(named=tuple(found["selected"]), aliases=aliases, unexplained=strange, details=details)

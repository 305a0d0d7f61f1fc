"""`cgwm fit` and `cgwm diagnose` with nothing set: what a user gets."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from cgwm.pipeline.diagnose import diagnose
from cgwm.pipeline.fit import fit
from cgwm.schemas import CgwmError, ModelFile, PhysConfig

from .effects_base import Named

TAKEN = {"centre_of_mass": "com_offset", "second_moments": "inertia_shape", "length_scale": "length_scale"}
"""What the default fit may take into the model by itself, and the effect that each part is where it was hidden."""


class Cgwm:
    """cgwm itself; with `refit` the named effects are added, and the errors on the test split are compared.

    `refit` opens the test split after the verdict, which it does not change. With `plain` the fit takes nothing into
    the model by itself, which is no setting of a user: it shows what that choice gives and costs.
    """

    def __init__(self, refit: bool = False, plain: bool = False) -> None:
        self.name: str = "cgwm_plain" if plain else "cgwm"
        self._refit, self._plain = refit, plain

    def missing(self) -> str | None:
        """Return None: cgwm is installed."""
        return None

    def names(self, capture: Path) -> Named:
        """Fit and diagnose the training split."""
        from diagnose import added, base_settings, brief

        physics = base_settings("tracks") if self._plain else PhysConfig()
        with tempfile.TemporaryDirectory() as folder:
            base, began = Path(folder) / "m0", time.process_time()
            try:
                model = fit(capture, base, phys_config=physics)
                found = diagnose(base, capture).model_dump(mode="json")
            except CgwmError as error:
                return Named(details={"refused": error.found})
            took = taken(model)
            details = {"found": brief(found), "taken": took, "diagnose_cpu_s": round(time.process_time() - began, 1)}
            if self._refit and found["selected"]:
                details |= added(capture, base, Path(folder) / "m1", found["selected"], physics)
        strange = found["verdict"] == "unexplained" or bool(found["remaining_unexplained"])
        aliases = tuple(tuple(group) for group in found["aliases"])
        # what stands in the model is no candidate, so that nothing is named twice but by episode or group
        named = (*found["selected"], *(name for name in took if name not in found["selected"]))
        return Named(named=named, aliases=aliases, unexplained=strange, details=details)


def taken(model: ModelFile) -> list[str]:
    """Return what a fit took into the model by itself, as effects: a user reads it before any diagnosis."""
    return [] if model.choice is None else [TAKEN[part] for part in model.choice.chosen]

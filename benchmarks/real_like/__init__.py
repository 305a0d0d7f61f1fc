"""Real-like captures: one, two or no hidden effects, or one in no library, seen as real tracking systems see.

From `benchmarks/`:

    python -m real_like list --stage development --each 3 --nulls 2
    python -m real_like make OUT --stage development --each 3 --nulls 2      # OUT/<name>, OUT.truth/<name>.json

Motions are those of MuJoCo (three settings of contact), Drake, DART and Rapier (`engines`); what their tracks carry is
in `errors`, how large the effects are in `sizes`, which cases there are in `plan`. Nothing here imports
`cgwm.pipeline`. Engines other than MuJoCo are optional: `pip install -r benchmarks/requirements.txt`.
"""

from .engines import GROUPS, missing
from .plan import EACH, NULLS, ROWS, STAGES, RealCase, Stage, real_cases
from .record import make_real_capture

__all__ = [
    "EACH",
    "GROUPS",
    "NULLS",
    "ROWS",
    "STAGES",
    "RealCase",
    "Stage",
    "make_real_capture",
    "missing",
    "real_cases",
]

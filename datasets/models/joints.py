"""What of cgwm does not take models and captures with jointed bodies yet, said in one message."""

from __future__ import annotations

from collections.abc import Sequence

from ...schemas import Articulation, ArticulationModel, InputDataError

TAKEN_BY = (
    "'cgwm import elbow', 'validate', 'fit' (to tracks), 'eval', 'compare', 'diagnose', 'improve', 'synthesize', "
    "'view', 'export' and ClosedLoop take jointed bodies"
)
"""What does."""


def refuse_joints(
    articulations: Sequence[Articulation | ArticulationModel], where: str, what: str, instead: str = ""
) -> None:
    """Refuse jointed bodies.

    Args:
        articulations: Those of the model or capture.
        where: The model or capture, for the message.
        what: What does not take them.
        instead: What to do instead, as a sentence without a capital; nothing in particular by default.

    Raises:
        InputDataError: If there is one.
    """
    if articulations:
        names = ", ".join(f"'{one.name}'" for one in articulations)
        raise InputDataError(
            f"{where}: it has jointed bodies ({names}), which {what} does not take yet.",
            "models and captures without [[articulations]].",
            f"{instead or TAKEN_BY + '; the Python API simulates them (docs/python-api.md)'}.",
        )

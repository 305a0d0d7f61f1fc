"""What of cgwm takes models with its own law of contact alone."""

from __future__ import annotations

from ...schemas import InputDataError, ModelFile


def refuse_paper_law(file: ModelFile, place: str, what: str) -> None:
    """Refuse a model with the contact law of the ContactGaussian-WM paper.

    Args:
        file: The model's file.
        place: Where it lies, for the message.
        what: What does not take it.

    Raises:
        InputDataError: If it has that law.
    """
    if file.solver.contact_model == "paper":
        raise InputDataError(
            f"{place}: it has the contact law 'paper', which {what} does not take.",
            "models with the contact law 'closed_form'.",
            "fit again without --set phys-geo.contact_law=paper; 'eval', 'compare', 'synthesize' and 'view' take both.",
        )

"""Texts under the fields of models."""

from cgwm.schemas.base import FileModel
from cgwm.schemas.field_texts import field_texts
from pydantic import ConfigDict, PrivateAttr


class Told(FileModel):
    """A model that pydantic reads the texts of, too."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    first: float = 1.0
    """Of one line [m]."""
    bare: int = 3
    second: tuple[float, ...] = ()
    """Of two
    lines."""

    _own: str = PrivateAttr("")


class More(Told):
    """A model with a base."""

    first: float = 2.0
    """Another text [m]."""
    third: bool = False
    """Of one line."""


def test_the_texts_under_fields_are_those_that_pydantic_reads() -> None:
    assert field_texts(Told) == {"first": "Of one line [m].", "second": "Of two\nlines."}
    for model in (Told, More):
        fields = model.model_fields.items()
        assert field_texts(model) == {name: field.description for name, field in fields if field.description}

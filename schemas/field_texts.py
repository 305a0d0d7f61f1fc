"""The texts under the fields of a model, which files to edit have as comments."""

from __future__ import annotations

import ast
import inspect
import itertools
import textwrap

from pydantic import BaseModel


def field_texts(model: type[BaseModel]) -> dict[str, str]:
    """Return the text under each field of a model that has one, by the name of the field.

    The source is parsed when they are asked for: as descriptions of pydantic (`use_attribute_docstrings`) all texts
    would be parsed at the start of every command, for 35 ms.
    """
    texts: dict[str, str] = {}
    for kind in reversed(model.__mro__[: model.__mro__.index(BaseModel)]):
        source = ast.parse(textwrap.dedent(inspect.getsource(kind)))
        statements = next(one.body for one in source.body if isinstance(one, ast.ClassDef))
        for field, text in itertools.pairwise(statements):
            match field, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                    texts[name] = inspect.cleandoc(words)
    return texts

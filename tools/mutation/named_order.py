"""Plugin of pytest (`-p named_order`): tests run in the order in which the command names them."""

from __future__ import annotations

import pytest


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Undo the order of the suite, which begins with the files that take longest."""
    place = {name: k for k, name in enumerate(config.invocation_params.args)}
    items.sort(key=lambda item: place.get(item.nodeid, len(place)))

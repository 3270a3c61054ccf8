from __future__ import annotations

import pytest

from dcvrt.grid import Grid


@pytest.fixture(scope="session")
def grid() -> Grid:
    """IEEE-118, with its engine compiled once."""
    return Grid.from_case("ieee118")

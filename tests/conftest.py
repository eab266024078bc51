"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recordings: `$HYBRIDMAP_DATA`, else `shared/data` beside the checkout. Skip if there is none."""
    for candidate in (os.environ.get("HYBRIDMAP_DATA"), REPOSITORY.parent / "shared" / "data"):
        if candidate and Path(candidate).is_dir():
            return Path(candidate)
    pytest.skip("recordings are not here: set HYBRIDMAP_DATA to their folder")

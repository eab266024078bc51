import pytest

from hybridmap.verification import verify_cells
from tests.verification.cells_for_tests import TINY


@pytest.fixture(scope="session")
def result():
    """Verify the cells at a small scale with seed 3."""
    return verify_cells(3, TINY, {})

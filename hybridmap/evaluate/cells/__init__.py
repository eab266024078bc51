"""The spatial cells against physiology and against exact integration: what `hybridmap verify` runs."""

from hybridmap.evaluate.cells.rows import rows_of
from hybridmap.evaluate.cells.verification import Scale, Verification, verify_cells

__all__ = ["Scale", "Verification", "rows_of", "verify_cells"]

"""The spatial cells against physiology and against exact integration: what `hybridmap verify` runs."""

from hybridmap.verification.rows import rows_of
from hybridmap.verification.verification import CellVerification, Scale, verify_cells

__all__ = ["CellVerification", "Scale", "rows_of", "verify_cells"]

"""The spatial cells against physiology and against exact integration: what `hybridmap verify` runs."""

from hybridmap.verification.rows import rows_of
from hybridmap.verification.verification import Scale, Verification, verify_cells

__all__ = ["Scale", "Verification", "rows_of", "verify_cells"]

"""Verification of the head-direction, band, grid and place cells against physiology and exact path integration
(`hybridmap verify`).
"""

from hybridmap.verification.rows import rows_of
from hybridmap.verification.verification import CellVerification, Scale, verify_cells

__all__ = ["CellVerification", "Scale", "rows_of", "verify_cells"]

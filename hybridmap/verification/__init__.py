"""Verification of the head-direction, band, grid and place cells against physiology and exact path integration
(`hybridmap verify`).
"""

from hybridmap.verification.recorded import read_path
from hybridmap.verification.rows import path_rows, rows_of
from hybridmap.verification.single_cells import verify_along
from hybridmap.verification.verification import CellVerification, Scale, verify_cells

__all__ = ["CellVerification", "Scale", "path_rows", "read_path", "rows_of", "verify_along", "verify_cells"]

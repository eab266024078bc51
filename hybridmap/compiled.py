"""Loops that numpy cannot take at once, as machine code: without fast mathematics and without threads, the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[Kernel], Kernel]:
    """Compile a function for one numba signature, kept beside its file or in the user's cache if there is room for it."""

    def compile_one(kernel: Kernel) -> Kernel:
        try:
            kept: Kernel = njit(signature, cache=True)(kernel)
        except Exception:  # noqa: BLE001  no folder to write to, a full disk, a torn file: numba raises what it meets
            kept = njit(signature)(kernel)
        return kept

    return compile_one

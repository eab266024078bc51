"""Machine code for loops that numpy cannot vectorise, without fast mathematics and threads: results are reproducible."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

Kernel = TypeVar("Kernel", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[Kernel], Kernel]:
    """Make a decorator that compiles a function for one numba signature.

    The compiled code is kept next to the function's file or in the user's cache, if either can be written.
    """

    def compile_one(kernel: Kernel) -> Kernel:
        try:
            kept: Kernel = njit(signature, cache=True)(kernel)
        except Exception:  # noqa: BLE001  no folder to write to, a full disk, a torn file: numba raises what it meets
            kept = njit(signature)(kernel)
        return kept

    return compile_one

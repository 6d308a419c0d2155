"""One thread for numpy's linear algebra: the matrices here are small, and a second thread waits longer for its part than it computes.

On a loaded machine with two cores a diagnosis of 158 s of driving takes 51 s of CPU in place of 65 s, and writes the same bytes. Sums also
no longer depend on the number of cores.
"""

from __future__ import annotations

import os

ONE_BLAS_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Variables of the environment by which BLAS libraries learn their number of threads when they are loaded."""


def use_one_blas_thread() -> None:
    """Ask for it, unless the user's environment asks for another number. Without effect once numpy is imported."""
    for name, value in ONE_BLAS_THREAD.items():
        os.environ.setdefault(name, value)

"""Limit BLAS and OpenMP to one thread, which is faster for small matrices. Import this module before NumPy."""

import os

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

#!/bin/bash
# SciPy's cholesky, cho_solve and solve_triangular keep Python's lock while LAPACK computes: no other thread of the
# process runs meanwhile, a progress bar's included. NumPy's cholesky and solve, of the same matrix, free it.
#
# Source: scipy 1.17.1, the generated wrappers of LAPACK, of which few are declared `threadsafe` (scipy issue 12436,
# closed). Pools of threads, as Dask's, joblib's or concurrent.futures', take as long as one thread.
# The guess most would make: dense algebra frees the lock, as numpy.linalg and products of matrices do.
# Who is hurt: whoever factorises many small covariances or reduced models by threads (Gaussian processes, Kalman
# filters, reduced bases), and wonders why more processors do not help.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check "scipy==1.17.1" "numpy==2.4.6"
cd "$work"
OPENBLAS_NUM_THREADS=1 "$work/venv/bin/python" - <<'PYTHON'
import sys
import threading
import time

import numpy as np
import scipy
from scipy import linalg

n, beats, ends = 2500, [0], threading.Event()


def beat():
    """Counts milliseconds for as long as it is let."""
    while not ends.wait(0.001):
        beats[0] += 1


root = np.random.default_rng(0).standard_normal((n, n))
matrix = np.asfortranarray(root @ root.T + n * np.eye(n))
lower, many = np.asfortranarray(np.linalg.cholesky(matrix)), np.asfortranarray(root)
calls = {
    "scipy.linalg.cholesky": lambda: linalg.cholesky(matrix, lower=True, check_finite=False),
    "scipy.linalg.cho_solve": lambda: linalg.cho_solve((lower, True), many, check_finite=False),
    "scipy.linalg.solve_triangular": lambda: linalg.solve_triangular(lower, many, lower=True, check_finite=False),
    "numpy.linalg.cholesky": lambda: np.linalg.cholesky(matrix),
    "numpy.linalg.solve": lambda: np.linalg.solve(matrix, many),
}
threading.Thread(target=beat, daemon=True).start()
share = {}
for name, call in calls.items():
    call()  # the first one also loads libraries
    began, before = time.perf_counter(), beats[0]
    call()
    spent = time.perf_counter() - began
    share[name] = (beats[0] - before) / (1000.0 * spent)
    print(f"{name}: {spent:.2f} s, in which another thread ran {beats[0] - before} times")
ends.set()
print(f"scipy {scipy.__version__}, numpy {np.__version__}, Python {sys.version.split()[0]}")
of_scipy, of_numpy = ([share[name] for name in calls if name.startswith(of)] for of in ("scipy", "numpy"))
raise SystemExit(max(of_scipy) > 0.3 * min(of_numpy))
PYTHON

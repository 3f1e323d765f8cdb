"""How far two results may lie apart: one rule, one table, in units of rounding.

A comparison allows `ulps` · eps(dtype) · scale, where the scale of a leaf is its largest magnitude (or each
entry's own magnitude, if a kernel promises relative accuracy entry by entry). So a tolerance is a statement
about the number of roundings and the conditioning of a kernel, and one number serves both dtypes unless the
two sides differ in method there.
"""

import numpy as np

# Two float64 results of the same formula by different routes: a few thousand roundings, 4096 eps = 9.1e-13.
TIGHT = 4096.0

# A float32 result against the correctly rounded one: tens of roundings of terms as large as the result.
ROUNDING = 64.0

# Values whose scale is set by terms that cancel, or sums over hundreds of terms in float32.
LONG_SUM = 512.0


def allowed(expected: np.ndarray, *, ulps: float, dtype: np.dtype, entrywise: bool = False) -> np.ndarray:
    """The largest difference that passes, entry by entry."""
    magnitude = np.abs(expected)
    scale = magnitude if entrywise else np.full(expected.shape, magnitude.max(initial=0.0))
    return ulps * np.finfo(dtype).eps * scale + np.finfo(dtype).tiny

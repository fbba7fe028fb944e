"""The arithmetic of the joint optimisation, compiled by numba: samples of the layers, and the terms
of the loss with their gradients.

A pixel has four channels, the last of which is 0, so that it fills a vector register. A kernel
works on the items `begin` to `end` and holds no lock, so that threads share the items. The rows of
a frame are cut into parts, and each part adds its gradients to a canvas of its own: no two threads
write the same value, and the sums do not depend on the number of threads.

Shapes: C candidates, L layers, K frames of (h, w) pixels, canvases of (H, W) pixels, splines of (r,
c) knots. Where a row of pixels is one array (4 w,), `4 * x + c` is channel c of pixel x.
"""

from typing import Final

import numpy as np

MARGIN: Final = 0.15
"""The canvases extend beyond each edge of the reference frame by this share of its size."""
OFFSET: Final = np.float32(0.003)
"""Added to linear light below the square root, so that noise in the shadows counts less."""
CLIPPED: Final = np.float32(0.98)
"""Above this value, a pixel of a frame is clipped, and a brighter sum of the layers is no error."""
CHARBONNIER: Final = np.float32(0.01)
"""Errors below are squared, larger ones are absolute."""
MIN_DENOMINATOR: Final = np.float32(0.1)
"""Of a projection: points at infinity would be outside of every canvas."""

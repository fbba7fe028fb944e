"""Runs fast-reflection-removal on .npy files. Reads their paths from standard input, and overwrites
the files.

bench/quality.py starts it in a separate environment, because the package needs numpy below 2.
"""

import sys

import numpy as np
from frr import FastReflectionRemoval

algorithm = FastReflectionRemoval(h=0.11)
for line in sys.stdin:
    path = line.strip()
    transmission = algorithm.remove_reflection(np.load(path) / 255)
    np.save(path, np.rint(np.clip(transmission, 0, 1) * 255).astype(np.uint8))
    print("done", flush=True)

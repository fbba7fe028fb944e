"""Runs fast-reflection-removal over the arrays named on standard input; its environment needs numpy below 2."""

import sys

import numpy as np
from frr import FastReflectionRemoval

algorithm = FastReflectionRemoval(h=0.11)
for line in sys.stdin:
    path = line.strip()
    transmission = algorithm.remove_reflection(np.load(path) / 255)
    np.save(path, np.rint(np.clip(transmission, 0, 1) * 255).astype(np.uint8))
    print("done", flush=True)

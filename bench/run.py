"""Runs all benchmarks. This is the script of `make bench`.

The benchmarks measure the quality on the development pairs, compared with the unprocessed input and
another method; the change of photos without reflection; the time and memory for a 12-megapixel
photo, a burst and installed published networks; the speed of metrics, compared with other packages;
a large evaluation; the renderer, compared with Mitsuba; and both servers under load.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/run.py
"""

import os
import sys
from pathlib import Path

import burst
import evaluate
import metrics
import networks
import quality
import reflection_free
import render
import serve
import speed
import study

if __name__ == "__main__":
    if not os.environ.get("BREWSTER_DATA"):
        sys.exit(
            "BREWSTER_DATA is not set; expected the folder of test pairs and photos, which "
            "brewster does not include;"
            " set the variable to this folder"
        )
    data = Path(os.environ["BREWSTER_DATA"])
    quality.main(data)
    reflection_free.main(data)
    speed.main(data)
    burst.speed()
    networks.main(data)
    metrics.main(data)
    evaluate.main(data)
    render.main(data)
    serve.main(data)
    study.main()

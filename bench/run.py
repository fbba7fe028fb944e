"""What `make bench` plays: quality on the development pairs beside the unprocessed input and beside a peer, what happens
to photographs without any reflection, the cost of a 12-megapixel photograph, metrics beside their peers, a large
evaluation, the renderer beside Mitsuba, and both servers under load.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/run.py
"""

import os
import sys
from pathlib import Path

import evaluate
import metrics
import plain
import quality
import render
import serve
import speed
import study

if __name__ == "__main__":
    if not os.environ.get("BREWSTER_DATA"):
        sys.exit("BREWSTER_DATA is unset: the pairs and photographs to measure on are not part of brewster")
    data = Path(os.environ["BREWSTER_DATA"])
    quality.main(data)
    plain.main(data)
    speed.main(data)
    metrics.main(data)
    evaluate.main(data)
    render.main(data)
    serve.main(data)
    study.main()

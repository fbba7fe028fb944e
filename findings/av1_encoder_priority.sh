#!/bin/bash
# Whoever encodes a film with SVT-AV1 as root becomes a real-time thread for good.
#
# The encoder (libsvtav1 of FFmpeg, here in the wheels of PyAV; SVT-AV1 4.1.0) sets not only its own threads
# but the thread that opens it to SCHED_FIFO with priority 99, without an option for it, and does not set it
# back when it is closed. Threads and processes inherit this, so that a service, a test worker or a notebook
# in a container that runs as root has real-time priority from its first AV1 film on, and so has a browser or
# a database that it starts later. On two cores, two busy ones leave 5 % of the time to all other processes
# (in steps of a second: the kernel's share for ordinary threads), while all of them count as load. Timers of
# a test run that ends what hangs are among what waits. Without the right to do so, the encoder only prints
# "Failed to set thread priority" (seen in public bug reports, where it is taken for harmless).
#
# The cure: encode in a thread or a process of its own.
#
# Source: measured here; pull request 73 of OpenVisualCloud/SVT-HEVC, from which SVT-AV1 comes, set the same
# priority for the same thread.
#
# This script encodes three frames of 64 x 64 pixels with SVT-AV1 and with MPEG-4, prints the policy and
# priority before, after, and of a child, and fails if SVT-AV1 leaves them as they were. It needs root.
set -euo pipefail
if [ "$(id -u)" != 0 ]; then echo "not root: the priority cannot change"; exit 0; fi
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q av==18.1.0 numpy==2.2.6
cat > "$folder/encode.py" <<'PYTHON'
import io
import os
import subprocess
import sys

import av
import numpy as np


def priority():
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


def encode(codec):
    with av.open(io.BytesIO(), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for light in (0, 100, 200):
            picture = np.full((64, 64, 3), light, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


before = priority()
encode(sys.argv[1])
after = priority()
asked = "import os; print(os.sched_getscheduler(0), os.sched_getparam(0).sched_priority)"
child = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
print(sys.argv[1], "before", *before, "after", *after, "a child", child.stdout.strip())
PYTHON
"$folder/venv/bin/python" -c 'import av; print("PyAV", av.__version__)'
for codec in mpeg4 libsvtav1; do "$folder/venv/bin/python" "$folder/encode.py" $codec 2> /dev/null; done > "$folder/log"
cat "$folder/log"
grep -qx "mpeg4 before 0 0 after 0 0 a child 0 0" "$folder/log"
grep -qx "libsvtav1 before 0 0 after 1 99 a child 1 99" "$folder/log"

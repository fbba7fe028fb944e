#!/bin/bash
# ffmpeg converts a film of 30 frames to a film of one frame.
#
# The film in a motion photo of a Pixel has two video tracks: the film, and a second track with a
# single frame of more pixels (2048x1536 next to 1440x1080). Both are marked as default. Without
# -map, ffmpeg chooses the video stream with the most pixels (ffmpeg documentation, "Automatic stream
# selection"), so the obvious `ffmpeg -i film.mp4 out.mp4` writes one frame, without a warning.
# PyAV's `streams.best("video")` compares bit rates, too: it is the single frame in the file made here,
# and the film in those of two phones.
#
# The cure: -map 0:v:0 and `streams.video[0]`, or choose the track with the most frames.
#
# This script makes such a file, and fails if ffmpeg or PyAV choose another track than described.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q imageio-ffmpeg==0.6.0 av==18.1.0
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import imageio_ffmpeg

folder = Path(sys.argv[1])
film = folder / "film.mp4"
with av.open(str(film), "w") as container:
    tracks = []
    for width, height, frames in ((320, 240, 30), (640, 480, 1)):
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.disposition = av.stream.Disposition.default
        tracks.append((stream, frames))
    for stream, frames in tracks:
        for number in range(frames):
            frame = av.VideoFrame(stream.width, stream.height, "yuv420p")
            frame.pts, frame.time_base = number, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())

program = imageio_ffmpeg.get_ffmpeg_exe()


def frames_of_ffmpeg(*options):
    command = [program, "-i", str(film), *options, "-f", "null", "-"]
    log = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    return int(re.findall(r"frame=\s*(\d+)", log)[-1])


with av.open(str(film)) as container:
    counts = [stream.frames for stream in container.streams.video]
    best = container.streams.best("video").index
print("ffmpeg", imageio_ffmpeg.get_ffmpeg_version(), "PyAV", av.__version__)
print("frames of the tracks:", counts)
print("frames that ffmpeg converts:", frames_of_ffmpeg())
print("with -map 0:v:0:", frames_of_ffmpeg("-map", "0:v:0"))
print("PyAV's best track:", best)
assert counts == [30, 1]
assert frames_of_ffmpeg() == 1
assert frames_of_ffmpeg("-map", "0:v:0") == 30
assert best == 1
PYTHON

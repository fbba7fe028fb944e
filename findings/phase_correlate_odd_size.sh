#!/usr/bin/env bash
# OpenCV: cv2.phaseCorrelate returns half a pixel too much along a side whose padded size is odd.
#
# The function pads its inputs to getOptimalDFTSize and measures the place of the peak from the
# centre of the padded picture, taken as half of its side. For an odd side the middle of the shifted
# spectrum is the pixel (side - 1) / 2 instead, so two equal pictures of 240 x 135 pixels are
# "moved" by (0, 0.5). 135 is 240 * 9 / 16: the usual thumbnail of a film. The response says nothing:
# it is as high as for an even size.
#
# What helps: pad both pictures with zeros, after the window, to sizes of which the optimal size is
# even: 2 * getOptimalDFTSize((side + 1) // 2).
#
# Fails if this behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.0 opencv-python-headless==5.0.0.93
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

print("OpenCV", cv2.__version__, "NumPy", np.__version__)
texture = np.random.default_rng(0).normal(128, 40, (600, 600)).astype(np.float32)


def views(width, height, x, y):
    return (
        np.ascontiguousarray(texture[50:50 + height, 50:50 + width]),
        np.ascontiguousarray(texture[50 - y:50 - y + height, 50 - x:50 - x + width]),
    )


def padded(picture, window):
    bottom, right = (2 * cv2.getOptimalDFTSize((n + 1) // 2) - n for n in picture.shape)
    return cv2.copyMakeBorder(picture * window, 0, bottom, 0, right, cv2.BORDER_CONSTANT)


failures = 0
for width, height in ((240, 180), (240, 135), (240, 130), (135, 240), (135, 75), (240, 134)):
    sizes = [cv2.getOptimalDFTSize(n) for n in (width, height)]
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    for motion in ((0, 0), (3, -2)):
        pictures = views(width, height, *motion)
        (x, y), response = cv2.phaseCorrelate(*(p.copy() for p in pictures), window)
        (even_x, even_y), _ = cv2.phaseCorrelate(*(padded(p, window) for p in pictures))
        error = x - motion[0], y - motion[1]
        expected = [0.5 if size % 2 else 0.0 for size in sizes]
        print(
            f"{width} x {height}, padded {sizes[0]} x {sizes[1]}, moved by {motion}: error "
            f"({error[0]:+.2f}, {error[1]:+.2f}), response {response:.2f}; padded to even sizes: "
            f"({even_x - motion[0]:+.2f}, {even_y - motion[1]:+.2f})"
        )
        failures += not np.allclose(error, expected, atol=0.1)
        failures += not np.allclose((even_x, even_y), motion, atol=0.1)
raise SystemExit(f"{failures} values have changed" if failures else 0)
PYTHON

"""Writes the example of the page: a film of a restaurant's window that reflects the street.

The film is made of two photographs that are part of brewster (CC0). Both layers move as for a
camera that is moved in a circle in front of a window, and their light is added.

    .venv/bin/python runs/example_film.py    # src/brewster/web/page/example.mp4
"""

import argparse
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from brewster.photo import Photo
from brewster.photo.srgb import to_encoded, to_linear

PACKAGE = Path(__file__).parents[1] / "src" / "brewster"
PHOTOS = PACKAGE / "render" / "environments" / "photos"
SIZE = 640, 480
FRAMES = 45
FRAMES_PER_SECOND = 30
RADIUS_PX = {"transmission": 9.0, "reflection": 34.0}
"""Radius of the circle of each layer. The camera follows the plate, so the street moves more."""
REFLECTION_STRENGTH = 0.4
TRANSMITTANCE = 0.9
QUALITY = "23"  # CRF of H.264


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=PACKAGE / "web" / "page" / "example.mp4")
    write(parser.parse_args().out, frames())


def frames() -> list[NDArray[np.uint8]]:
    """Returns the frames, 8-bit sRGB (h, w, 3)."""
    transmission = read_linear(PHOTOS / "fried_chicken.jpg")
    reflection = read_linear(PHOTOS / "street.jpg")[:, ::-1]
    made = []
    for angle in np.linspace(0, 2 * np.pi, FRAMES):
        behind = shifted(transmission, RADIUS_PX["transmission"], angle)
        mirrored = shifted(reflection, RADIUS_PX["reflection"], angle)
        light = TRANSMITTANCE * behind + REFLECTION_STRENGTH * mirrored
        made.append((255 * to_encoded(np.clip(light, 0, 1))).round().astype(np.uint8))
    return made


def read_linear(path: Path) -> NDArray[np.float32]:
    return to_linear(Photo.open(path).pixels.astype(np.float32) / 255)


def shifted(image: NDArray[np.float32], radius_px: float, angle: float) -> NDArray[np.float32]:
    """Returns the middle of an image, moved to a point of a circle, (h, w, 3)."""
    width, height = SIZE
    left = (image.shape[1] - width) / 2 + radius_px * np.cos(angle)
    top = (image.shape[0] - height) / 2 + radius_px * np.sin(angle)
    motion = np.array([[1, 0, left], [0, 1, top]], np.float32)
    return cv2.warpAffine(image, motion, SIZE, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def write(path: Path, frames: list[NDArray[np.uint8]]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            "libx264", rate=FRAMES_PER_SECOND, options={"crf": QUALITY, "preset": "slow"}
        )
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = number
            picture.time_base = Fraction(1, FRAMES_PER_SECOND)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


if __name__ == "__main__":
    main()

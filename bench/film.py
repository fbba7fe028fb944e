"""Makes a film of a window with ground truth from two photos, and scores the frames of its
transmission.

    # width and seconds; writes film.mp4, truth.mp4 and motion.npy
    .venv/bin/python bench/film.py make out/film 1920 10
    time .venv/bin/brewster burst out/film/film.mp4 --all-frames -o out/film/clear.mp4
    .venv/bin/python bench/film.py score out/film

The camera moves along a circle with a tremble, at 30 frames per second. T moves by up to 5 % of the
width, with parallax, and R by 8 %; the exposure changes by up to 20 %, and each frame has noise.
The scores are the PSNR in dB of the film and of T, after one gain for each channel of the whole
film, and the flicker: the mean absolute difference, in levels of 255, of consecutive frames that
are aligned by the true motion of T.
"""

import os
import sys
from pathlib import Path

import av
import cv2
import numpy as np

from brewster import Photo
from brewster.photo.srgb import to_encoded, to_linear

PHOTOS = "kodak24__21.jpg", "kodak24__15.jpg"
RATE = 30
MARGIN = 0.15


def read_layer(name, width, rng):
    """A linear photo, MARGIN larger than the frames on each side, with fine structure that enlarged
    photos lack.
    """
    photo = Photo.open(Path(os.environ["BREWSTER_DATA"], "photos/permissive", name))
    scale = (1 + 2 * MARGIN) * width / photo.size[0]
    size = round(photo.size[0] * scale), round(photo.size[1] * scale)
    layer = cv2.resize(
        to_linear(photo.pixels / np.float32(255)), size, interpolation=cv2.INTER_CUBIC
    )
    texture = cv2.GaussianBlur(rng.normal(size=layer.shape[:2]).astype(np.float32), (0, 0), 1)
    return np.clip(layer * (1 + 0.1 * texture[..., None]), 0, 1).astype(np.float32)


def camera_path(count, rng):
    """(count, 2): a circle with a diameter of 1, and a tremble."""
    angle = np.linspace(-0.5, 6.5, count)
    tremble = cv2.GaussianBlur(rng.normal(size=(count, 2)), (1, 0), sigmaX=0.1, sigmaY=4)
    return np.stack([np.cos(angle), np.sin(angle)], 1) / 2 + 0.03 * tremble


def positions(size, shift, parallax, depth, turn):
    width, height = size
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = x - width / 2, y - height / 2
    moved = shift[:, None, None] + parallax[:, None, None] * depth
    return (
        (np.cos(turn) * x - np.sin(turn) * y + moved[0]).astype(np.float32),
        (np.sin(turn) * x + np.cos(turn) * y + moved[1]).astype(np.float32),
    )


def view(layer, places):
    x, y = (place + side / 2 for place, side in zip(places, layer.shape[1::-1], strict=True))
    return cv2.remap(layer, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def motion_of_t(size, places, turns, depth, k):
    width = size[0]
    return positions(size, 0.05 * width * places[k], 0.006 * width * places[k], depth, turns[k])


def scene(width, seconds):
    rng = np.random.default_rng(5)
    size = (width, width * 9 // 16 // 2 * 2)
    count = round(RATE * seconds)
    layers = [read_layer(name, width, rng) for name in PHOTOS]
    depth = cv2.resize(
        rng.normal(size=(3, 4)).astype(np.float32), size, interpolation=cv2.INTER_CUBIC
    )
    return (
        rng,
        size,
        layers,
        depth,
        camera_path(count, rng),
        0.004 * rng.normal(size=count).cumsum() / 5,
    )


class Writer:
    def __init__(self, path, size, crf):
        self.container = av.open(str(path), "w")
        self.stream = self.container.add_stream(
            "libx264", rate=RATE, options={"crf": str(crf), "preset": "fast"}
        )
        self.stream.width, self.stream.height = size
        self.stream.pix_fmt = "yuv420p"

    def write(self, light):
        frame = av.VideoFrame.from_ndarray(
            np.rint(255 * to_encoded(light.clip(0, 1))).astype(np.uint8), format="rgb24"
        )
        self.container.mux(self.stream.encode(frame.reformat(format="yuv420p", dst_colorspace=5)))

    def close(self):
        self.container.mux(self.stream.encode())
        self.container.close()


def make(folder, width, seconds):
    folder.mkdir(parents=True, exist_ok=True)
    rng, size, (transmission, reflection), depth, places, turns = scene(width, seconds)
    film = Writer(folder / "film.mp4", size, 14)
    truth = Writer(folder / "truth.mp4", size, 6)
    flat = np.zeros_like(depth)
    for k, place in enumerate(places):
        behind = 0.8 * view(transmission, motion_of_t(size, places, turns, depth, k))
        mirrored = 0.45 * view(
            reflection, positions(size, 0.13 * width * place, np.zeros(2), flat, turns[k])
        )
        gain = np.exp(0.1 * np.sin(6 * k / len(places)))
        total = np.maximum(gain * (behind + mirrored), 0)
        noise = rng.normal(size=(size[1], size[0], 3)).astype(np.float32)
        film.write(total + noise * np.sqrt(1e-5 + 1e-4 * total))
        truth.write(gain * behind)
    film.close()
    truth.close()


def frames_of(path):
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")


def score(folder):
    with av.open(str(folder / "film.mp4")) as container:
        stream = container.streams.video[0]
        width = stream.width
        count = stream.frames
    _, size, _, depth, places, turns = scene(width, count / RATE)
    motions = [motion_of_t(size, places, turns, depth, k) for k in range(2)]
    names = ("film", "clear", "truth")
    psnrs = {n: [] for n in names}
    flickers = {n: [] for n in names}
    gains = {}
    previous = {}
    inner = slice(size[1] // 20, -size[1] // 20), slice(size[0] // 20, -size[0] // 20)
    for name in ("film", "clear"):  # one gain for each channel of the whole film
        sums = np.zeros((2, 3))
        for k, (image, truth) in enumerate(
            zip(frames_of(folder / f"{name}.mp4"), frames_of(folder / "truth.mp4"), strict=True)
        ):
            if k % 10 == 0:
                light, true = (to_linear(some / np.float32(255)) for some in (image, truth))
                sums += np.stack([(light * true).sum((0, 1)), (light * light).sum((0, 1))])
        gains[name] = sums[0] / sums[1]
    streams = [frames_of(folder / f"{name}.mp4") for name in names]
    for k, views in enumerate(zip(*streams, strict=True)):
        images = dict(zip(names, views, strict=True))
        if k:
            motions = [motions[-1], motion_of_t(size, places, turns, depth, k)]
            # The place of each pixel in the frame before: as the motions are nearly equal, it moves
            # by their difference
            grid = np.mgrid[: size[1], : size[0]].astype(np.float32)
            x, y = (grid[1 - axis] + motions[1][axis] - motions[0][axis] for axis in (0, 1))
        for name, image in images.items():
            if name in gains:
                light = to_linear(image / np.float32(255)) * gains[name]
                error = 255 * to_encoded(light.clip(0, 1)) - images["truth"]
                psnrs[name].append(10 * np.log10(255**2 / np.square(error[inner]).mean()))
            if k:
                aligned = cv2.remap(
                    previous[name], x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR
                )
                flickers[name].append(np.abs(aligned.astype(np.float32) - image)[inner].mean())
        previous = images
    for name in names:
        db = np.array(psnrs[name] or [np.inf])
        print(
            f"{name}: PSNR {db.mean():.2f} dB (lowest {db.min():.2f}, highest {db.max():.2f}), "
            f"flicker {np.mean(flickers[name]):.3f} (largest {np.max(flickers[name]):.3f})"
        )


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
    else:
        score(Path(sys.argv[2]))

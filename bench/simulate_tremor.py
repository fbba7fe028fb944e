"""Makes films of a hand that trembles, with ground truth: layers that move apart by 2 to 14 px.

    .venv/bin/python bench/simulate_tremor.py out/tremor 40    # photos that no network has seen
    .venv/bin/python bench/simulate_tremor.py out/calibration 40 calibration
    .venv/bin/python bench/simulate_tremor.py out/null 200 calibration 1000 "one layer"
    .venv/bin/python bench/small_motions.py out/tremor

The photos are those of $BREWSTER_DATA. A film has 19 pictures of 1000 x 750 pixels, of which every
third one is a frame of the burst. The camera follows a smooth random path. T moves by a homography
and, with the parallax of a smooth depth or of two planes, differently in each place; R moves by
another distance. Light adds up; noise, exposure and a codec follow: H.265 or H.264 with as many
bits per pixel as 1080p with 8 Mbit/s, or JPEG. The cases repeat: two films of three have two
layers, one has a single layer, as a wall without glass, with the same noise, codec and parallax.

Each film is a file NUMBER.npz with the frames (7, 750, 1000, 3), both layers of the middle one
(2, 750, 1000, 3), all 8-bit sRGB, and the relative motion, parallax and case.
"""

import io
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np

from brewster import Photo
from brewster.photo.srgb import to_encoded, to_linear

WIDTH = 1000
HEIGHT = 750
PICTURES = 19
CHOSEN = range(0, PICTURES, 3)
MIDDLE = PICTURES // 2
MARGIN = 1.12
"""The layers are larger than the frames, so that a moved camera sees no border."""
FRAMES_PER_SECOND = 30
BITS_PER_SECOND = 8e6 * WIDTH * HEIGHT / (1920 * 1080)
CODECS = ("libx265", "libx265", "libx264", "jpeg")
MOTIONS_PX = (3, 12)
POOLS = {
    "held out": ("kodak24__",),
    "calibration": (
        "18f-18f",
        "codrops",
        "wagtail",
        "Indranil",
        "rchiles",
        "inzaikun",
        "cmarco1",
        "Digamma05",
        "mickaelpignier",
        "hungyenlee",
    ),
}
MIN_SIDE_PX = {"held out": 700, "calibration": 1000}


@dataclass(frozen=True)
class Film:
    """What is drawn at random for a film."""

    transmission: np.ndarray
    reflection: np.ndarray
    """Linear light, larger than the frames; 0 for a film with one layer."""
    depth: np.ndarray
    """(HEIGHT, WIDTH), a range of 1 and a mean of about 0."""
    path: np.ndarray
    """(PICTURES, 2): from the middle picture; the largest distance is 1."""
    relative_px: float
    camera_px: float
    parallax_px: float
    codec: str


def photos(pool):
    """The paths of the photos of a pool that are large enough."""
    folder = Path(os.environ["BREWSTER_DATA"], "photos/permissive")
    named = [path for path in sorted(folder.iterdir()) if path.name.startswith(POOLS[pool])]
    return [path for path in named if max(Photo.open(path).size) >= MIN_SIDE_PX[pool]]


def read_layer(rng, paths):
    """A linear photo of MARGIN times the frame."""
    pixels = Photo.open(paths[rng.integers(len(paths))]).pixels[..., :3]
    image = to_linear(pixels.astype(np.float32) / 255)
    if image.shape[0] > image.shape[1]:
        image = np.rot90(image)
    image = image[:, ::-1] if rng.random() < 0.5 else image
    scale = MARGIN * max(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = np.ascontiguousarray(image)
    return np.clip(cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation), 0, 1)


def hand_path(rng):
    """The path of a hand: smooth, without a direction of its own."""
    window = np.hanning(PICTURES // 2 + 2)
    steps = rng.normal(size=(3 * PICTURES, 2))
    speed = np.stack([np.convolve(axis, window, "same") for axis in steps.T], 1)
    path = np.cumsum(speed, 0)[PICTURES : 2 * PICTURES]
    chosen = path[list(CHOSEN)]
    length = np.linalg.norm(chosen[:, None] - chosen, axis=-1).max()
    return (path - path[MIDDLE]) / length


def draw_depth(rng):
    """The depth behind the glass: smooth, or two planes with an edge between them."""
    small = rng.normal(size=(4, 5)).astype(np.float32)
    depth = cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    if rng.random() < 0.3:
        depth = (depth > np.quantile(depth, rng.uniform(0.3, 0.8))).astype(np.float32)
    return (depth - depth.mean()) / np.ptp(depth)


def draw(seed, paths, *, has_reflection):
    """A film of this number."""
    rng = np.random.default_rng((77, seed))
    transmission = read_layer(rng, paths)
    reflection = read_layer(rng, paths)
    if rng.random() < 0.3:  # the mirrored scene is out of focus
        reflection = cv2.GaussianBlur(reflection, (0, 0), rng.uniform(1, 3))
    brightness = np.exp(rng.uniform(np.log(0.2), 0))
    reflection *= min(brightness * transmission.mean() / (reflection.mean() + 1e-3), 1)
    relative = rng.uniform(*MOTIONS_PX)
    camera = rng.uniform(1, 3) * relative
    parallax = rng.uniform(0.1, 0.6) * relative
    depth = draw_depth(rng)
    path = hand_path(rng)
    codec = CODECS[rng.integers(len(CODECS))]
    light = 0.8 / max(np.quantile(transmission, 0.98), 0.2)
    return Film(
        light * transmission,
        has_reflection * light * reflection,
        depth,
        path,
        relative,
        camera,
        parallax,
        codec,
    )


def view(layer, shift, rotation, bend):
    """The frame of the layer moved by `shift` px plus the field `bend` (2, h, w), and turned."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    x, y = columns - WIDTH / 2, rows - HEIGHT / 2
    across = np.cos(rotation) * x - np.sin(rotation) * y + layer.shape[1] / 2 + shift[0] + bend[0]
    down = np.sin(rotation) * x + np.cos(rotation) * y + layer.shape[0] / 2 + shift[1] + bend[1]
    maps = across.astype(np.float32), down.astype(np.float32)
    return cv2.remap(layer, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def render(film, seed):
    """The pictures of a film, 8-bit sRGB, and both layers of the middle one."""
    rng = np.random.default_rng((78, seed))
    pictures = []
    for k, place in enumerate(film.path):
        shake = rng.normal(0, 1.5, 2) * (k != MIDDLE)
        rotation = rng.normal(0, 0.002) * (k != MIDDLE)
        exposure = np.exp(rng.normal(0, 0.02))
        bend = film.parallax_px * place[:, None, None] * film.depth
        behind = view(film.transmission, film.camera_px * place + shake, rotation, bend)
        shift = (film.camera_px + film.relative_px) * place + shake
        mirrored = view(film.reflection, shift, rotation, np.zeros(2))
        layers = np.stack([behind, mirrored]).clip(0)
        if k == MIDDLE:
            truth = layers
        light = exposure * layers.sum(0)
        light += rng.normal(0, 1, light.shape) * np.sqrt(1e-5 + 3e-4 * light)
        pictures.append(encoded(light))
    return pictures, encoded(truth)


def encoded(light):
    """8-bit sRGB of linear light."""
    return np.rint(255 * to_encoded(light.clip(0, 1))).astype(np.uint8)


def through_codec(pictures, codec):
    """The chosen pictures after a codec."""
    if codec == "jpeg":
        return [through_jpeg(pictures[k]) for k in CHOSEN]
    options = {"preset": "fast"}
    if codec == "libx265":
        options["x265-params"] = "pools=1:frame-threads=1:log-level=none"
    file = io.BytesIO()
    with av.open(file, "w", "mp4") as container:
        stream = container.add_stream(codec, FRAMES_PER_SECOND, options=options)
        stream.width, stream.height = WIDTH, HEIGHT
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = int(BITS_PER_SECOND)
        stream.thread_count = 1
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        container.mux(stream.encode(None))
    file.seek(0)
    with av.open(file) as container:
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return [decoded[k] for k in CHOSEN]


def through_jpeg(picture):
    """A picture after JPEG with quality 88."""
    file = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return cv2.imdecode(file, cv2.IMREAD_COLOR)[..., ::-1]


def main(folder, count, pool="held out", first=0, only=None):
    folder.mkdir(parents=True, exist_ok=True)
    paths = photos(pool)
    for number in range(int(first), int(first) + count):
        case = only or ("one layer" if number % 3 == 2 else "two layers")
        film = draw(number, paths, has_reflection=case == "two layers")
        pictures, truth = render(film, number)
        np.savez(
            folder / f"{number:03}.npz",
            frames=through_codec(pictures, film.codec),
            truth=truth,
            relative_px=film.relative_px,
            parallax_px=film.parallax_px,
            path=film.path[list(CHOSEN)],
            case=case,
            codec=film.codec,
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:])

"""Makes photos that contain a film, as a phone does, with ground truth.

    .venv/bin/python bench/simulate_motion_photos.py out/motion-photos 100
    .venv/bin/python bench/motion_photos.py out/motion-photos

Both scenes are photos of $BREWSTER_DATA. The hand trembles: the film shows 30 frames of 1440 x 1080
pixels in 1 s, the layers move by 2 to 16 px relative to each other (of 1,000 px of width), and the
scene behind the glass has depth. The film has noise, its exposure drifts, most in the first .3 s,
its rows are exposed one after the other (.3 px), and x265 encodes it at 8 Mbit/s. The still has 12
megapixels, is sharper, and has a tone curve and a local tone (+-.3 stop) of its own. It is taken at
0, 64 or 100 % of the film, or after it. A quarter of the photos has no reflection; in a tenth,
somebody passes.

A sample NAME is NAME.jpg (a Motion Photo: the film follows the JPEG), NAME.transmission.png and
NAME.reflection.png (the truth at 1,440 px, with the tone of the still), and a row of samples.csv.
"""

import csv
import io
import os
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from brewster import Photo
from brewster.photo.srgb import to_encoded, to_linear

WIDTH, HEIGHT = 1440, 1080
STILL_WIDTH, STILL_HEIGHT = 4032, 3024
FRAMES = 30
RATE = 30
MARGIN = 1.18
"""The layers are larger than the frames, so that a moved camera sees no border."""
BIT_RATE = 8_000_000
MIN_WIDTH = 1000
"""Of the photos that the layers are made of."""
STILL_PLACES = (0.0, 0.64, 1.0, 1.05)
"""When the still is taken, as a share of the duration of the film."""
STEPS = 8
"""The path of the hand has this many points for each frame of the film."""


def main():
    folder = Path(sys.argv[1])
    count = int(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    photos = large_photos(Path(os.environ["BREWSTER_DATA"], "photos"))
    rows = []
    for number in range(count):
        rows.append(
            write_sample(folder, f"{number:03}", np.random.default_rng((62, number)), photos)
        )
        print(rows[-1], flush=True)
    with (folder / "samples.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def large_photos(folder):
    with (folder / "manifest.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if int(row["width"]) >= MIN_WIDTH]
    return sorted(folder / row["file"] for row in rows)


def write_sample(folder, name, rng, photos):
    """Writes a motion photo and its truth. Returns its row."""
    transmission = read_layer(rng, photos)
    reflection = read_layer(rng, photos)
    if rng.random() < 0.3:
        reflection = cv2.GaussianBlur(reflection, (0, 0), rng.uniform(1, 4))
    brightness = np.exp(rng.uniform(np.log(0.2), np.log(1.0)))
    reflection *= min(1.0, brightness * transmission.mean() / (reflection.mean() + 1e-3))
    has_reflection = rng.random() > 0.25
    if not has_reflection:
        reflection *= 0
    has_passer = rng.random() < 0.1
    light = np.float32(0.8 / max(np.quantile(transmission, 0.98), 0.2))
    relative_px = np.exp(rng.uniform(np.log(2), np.log(16)))
    place = STILL_PLACES[rng.integers(len(STILL_PLACES))]
    hand = Hand(rng, relative_px * WIDTH / 1000)
    depth = smooth_field(rng, (4, 5))
    layers = light * transmission, light * reflection

    def view(time, size, scale=1.0, roll=0.0):
        both = (
            hand.view(
                layer,
                time,
                size,
                depth=depth if n == 0 else None,
                is_mirrored=n == 1,
                scale=scale,
                roll=roll,
            )
            for n, layer in enumerate(layers)
        )
        return np.stack(list(both))

    passer = Passer(rng) if has_passer else None
    film = []
    exposure = drift(rng)
    for k in range(FRAMES):
        shown = view(k / (FRAMES - 1), (WIDTH, HEIGHT), roll=0.3)
        if passer:
            shown = passer.hide(shown, k / (FRAMES - 1))
        film.append(film_frame(rng, shown.sum(0), exposure[k]))
    still = view(place, (WIDTH, HEIGHT), scale=rng.uniform(0.997, 1.003))
    if passer and place <= 1:
        still = passer.hide(still, place)
    tone = Tone(rng)
    photo = tone(still.sum(0))
    truth_t = tone(still[0])
    truth_r = np.maximum(photo - truth_t, 0)
    write_photo(folder / f"{name}.jpg", rng, photo, encode_film(film), place * (FRAMES - 1) / RATE)
    for layer, image in (("transmission", truth_t), ("reflection", truth_r)):
        cv2.imwrite(str(folder / f"{name}.{layer}.png"), codes(image)[..., ::-1])
    return {
        "name": name,
        "relative_px": round(relative_px if has_reflection else 0.0, 2),
        "has_reflection": int(has_reflection),
        "has_passer": int(has_passer),
        "still_at": place,
        "mean_t": round(float(truth_t.mean()), 4),
        "mean_r": round(float(truth_r.mean()), 4),
    }


class Hand:
    """The path of a hand that trembles while it holds the camera.

    Both layers turn with the camera, by 0 to 60 px; the mirrored scene moves by `relative_px` more
    than the scene behind the glass, whose depths move by a part of this.
    """

    def __init__(self, rng, relative_px):
        count = FRAMES * STEPS
        kernel = np.hanning(count // 2)
        noise = rng.normal(size=(2, 2, 2 * count))
        speeds = [
            [np.convolve(axis, kernel / kernel.sum(), "same") for axis in path] for path in noise
        ]
        paths = np.cumsum(np.array(speeds)[..., count // 2 : -count // 2 + count // 10], -1)
        size = [np.ptp(path, -1).max() for path in paths]
        self.place = paths[0] / size[0] * relative_px
        self.turn = paths[1] / size[1] * np.exp(rng.uniform(np.log(7), np.log(60)))
        self.roll = rng.normal(0, 0.004) * np.sin(
            np.linspace(0, rng.uniform(1, 4), paths.shape[-1])
        )
        self.parallax = rng.uniform(0.1, 0.4)
        self.times = np.linspace(0, 1 + 0.1, paths.shape[-1])

    def at(self, values, time):
        return np.array([np.interp(time, self.times, axis) for axis in np.atleast_2d(values)])

    def view(self, layer, time, size, *, depth, is_mirrored, scale, roll):
        """The layer as the camera sees it at a time, (h, w, 3)."""
        width, height = size
        rows, columns = np.mgrid[:height, :width].astype(np.float32)
        turn = self.at(self.turn, time)
        place = self.at(self.place, time)
        shift = turn + (place if is_mirrored else 0)
        angle = self.at(self.roll, time)[0]
        speed = (self.at(self.turn, time + 1e-2) - self.at(self.turn, time - 1e-2)) / (
            np.linalg.norm(self.at(self.turn, time + 1e-2) - self.at(self.turn, time - 1e-2)) + 1e-9
        )
        x = (columns - width / 2) * scale + roll * speed[0] * (rows / height - 0.5)
        y = (rows - height / 2) * scale + roll * speed[1] * (rows / height - 0.5)
        across = np.cos(angle) * x - np.sin(angle) * y + layer.shape[1] / 2 + shift[0]
        down = np.sin(angle) * x + np.cos(angle) * y + layer.shape[0] / 2 + shift[1]
        if depth is not None:
            across += self.parallax * place[0] * depth
            down += self.parallax * place[1] * depth
        return cv2.remap(
            layer,
            across.astype(np.float32),
            down.astype(np.float32),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REFLECT,
        ).clip(0)


class Passer:
    """Somebody who walks through the picture, in front of the glass."""

    def __init__(self, rng):
        self.colour = rng.uniform(0.02, 0.25, 3).astype(np.float32)
        self.width = rng.uniform(0.08, 0.2) * WIDTH
        self.start = rng.uniform(-0.2, 0.6) * WIDTH
        self.speed = rng.uniform(0.3, 0.8) * WIDTH * rng.choice([-1, 1])

    def hide(self, layers, time):
        rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
        x = (columns - self.start - self.speed * time) / self.width
        y = (rows - 0.75 * HEIGHT) / (0.6 * HEIGHT)
        opacity = np.clip((1 - np.hypot(x, y)) * 20, 0, 1)[..., None]
        hidden = layers * (1 - opacity)
        hidden[0] += opacity * self.colour
        return hidden


class Tone:
    """The tone of the still: a curve, and a local exposure of +-.3 stop."""

    def __init__(self, rng):
        self.gamma = rng.uniform(0.88, 1.08)
        self.gain = rng.uniform(0.85, 1.15)
        self.local = np.exp2(0.3 * np.clip(2 * smooth_field(rng, (5, 6)), -1, 1))[..., None]

    def __call__(self, light):
        toned = self.gain * self.local * np.power(np.maximum(light, 0), self.gamma)
        return np.clip(toned, 0, 1).astype(np.float32)


def smooth_field(rng, knots):
    """A smooth field (h, w) between -.5 and .5."""
    field = cv2.resize(
        rng.normal(size=knots).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC
    )
    return (field - field.mean()) / np.ptp(field)


def read_layer(rng, photos):
    """A linear photo of MARGIN times the frame, upright."""
    image = to_linear(
        Photo.open(photos[rng.integers(len(photos))]).pixels[..., :3].astype(np.float32) / 255
    )
    if image.shape[0] > image.shape[1]:
        image = np.rot90(image)
    scale = MARGIN * max(WIDTH / image.shape[1], HEIGHT / image.shape[0])
    image = cv2.resize(
        np.ascontiguousarray(image),
        None,
        fx=scale,
        fy=scale,
        interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC,
    )
    image = image[:, ::-1] if rng.random() < 0.5 else image
    return np.clip(image, 0, 1)


def drift(rng):
    """The exposure of each frame, as a factor: .03 to .6 stop, most in the first .3 s."""
    stops = rng.uniform(0.03, 0.6) * rng.choice([-1, 1])
    seconds = np.arange(FRAMES) / RATE
    return np.exp2(stops * (np.exp(-seconds / 0.15) - 0.15 * seconds))


def film_frame(rng, light, exposure):
    """An 8-bit frame: softer than the still, with noise."""
    soft = cv2.GaussianBlur(light, (0, 0), 0.7) * exposure
    noisy = soft + rng.normal(0, 1, soft.shape) * np.sqrt(1e-6 + 1e-4 * soft)
    return codes(noisy)


def codes(light):
    return np.rint(255 * to_encoded(np.clip(light, 0, 1))).astype(np.uint8)


def encode_film(frames):
    """The bytes of an MP4 with the frames in HEVC."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx265", rate=RATE)
        stream.width, stream.height = WIDTH, HEIGHT
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = BIT_RATE
        stream.options = {"preset": "fast", "x265-params": "log-level=none:pools=1"}
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture.pts = number
            picture.time_base = Fraction(1, RATE)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return buffer.getvalue()


XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
 xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""
 xmlns:GCamera="http://ns.google.com/photos/1.0/camera/"
 xmlns:Container="http://ns.google.com/photos/1.0/container/"
 xmlns:Item="http://ns.google.com/photos/1.0/container/item/"
 GCamera:MotionPhoto="1" GCamera:MotionPhotoVersion="1"
 GCamera:MotionPhotoPresentationTimestampUs="{time}"><Container:Directory><rdf:Seq>
 <rdf:li rdf:parseType="Resource"><Container:Item Item:Mime="image/jpeg" Item:Semantic="Primary"
 Item:Length="0" Item:Padding="0"/></rdf:li><rdf:li rdf:parseType="Resource"><Container:Item
 Item:Mime="video/mp4" Item:Semantic="MotionPhoto" Item:Length="{length}"/></rdf:li></rdf:Seq>
 </Container:Directory></rdf:Description></rdf:RDF></x:xmpmeta>"""
"""As the specification of Motion Photos 1.0 of Android describes it."""


def write_photo(path, rng, photo, film, still_s):
    """Writes the still at 12 megapixels, followed by the film."""
    large = cv2.resize(photo, (STILL_WIDTH, STILL_HEIGHT), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    large += rng.normal(0, 1, large.shape).astype(np.float32) * np.sqrt(1e-6 + 5e-5 * large)
    _, jpeg = cv2.imencode(".jpg", codes(large)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])
    xmp = XMP.format(time=round(1e6 * still_s), length=len(film)).encode()
    block = b"http://ns.adobe.com/xap/1.0/\0" + xmp
    segment = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
    data = jpeg.tobytes()
    path.write_bytes(data[:2] + segment + data[2:] + film)


if __name__ == "__main__":
    main()

"""Measures the installed published networks, and how their layers are best enlarged.

    BREWSTER_DATA=../shared/data .venv/bin/python bench/networks.py [NAME ...]

1. Seconds and peak memory of brewster for photos of 512 px, 768 px and 12 megapixels, against the
   network alone in ONNX Runtime, which loads the same file and gets the same inputs. The time
   contains the start of Python and the loading of the model. Photos with equal inputs of the
   network share its time alone.
2. PSNR of T at 12 megapixels of twins that know the true layers: their layers at the size of the
   network, plus noise, enlarged with guided upsampling; and their layers of native tiles, plus the
   same noise.

With names, only 1 for these networks; without installed networks, only 2.
"""

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from speed import OUT, make_large_photo, measure

from brewster import Photo, Separator
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.guided_upsampling import GeneratedOverride
from brewster.separation.models.published_networks import PUBLISHED_NETWORKS
from brewster.separation.models.zoo import installed_files, model_file
from brewster.separation.predictor import MultiScalePredictor, Prediction, Predictor
from brewster.separation.tiles import run_tiled

NOISE = (0.0, 0.02, 0.055)
"""Standard deviations of the noise, sRGB-encoded. The last one is that of a network with 25 dB."""
SIZE_PX = (4000, 3000)
ALONE = """
import sys
import numpy as np
import onnxruntime as ort
options = ort.SessionOptions()
options.log_severity_level = 3
session = ort.InferenceSession(sys.argv[1], options, ["CPUExecutionProvider"])
height, width, passes = map(int, sys.argv[2:])
photo = np.random.default_rng(1).random((1, 3, height, width), np.float32)
for _ in range(passes):
    session.run(["transmission", "reflection"], {"photo": photo})
"""


def main(data: Path, names: Sequence[str] = ()) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    for name in names or [
        file.name for file in installed_files() if file.name in PUBLISHED_NETWORKS
    ]:
        speed(data, name)
    if not names:
        enlargement(data)


def speed(data: Path, name: str) -> None:
    network = PUBLISHED_NETWORKS[name]
    model = model_file(name).path
    predictor = MultiScalePredictor(lambda tile: (tile, tile), network.scales)
    alone = dict[tuple[int, int], tuple[float, int]]()
    photos = {"12 megapixels": (make_large_photo(data), SIZE_PX)}
    for side in (768, 512):
        photos[f"{side} px"] = (OUT / f"{side}.jpg", (side, side))
        pixels = Photo.open(photos["12 megapixels"][0]).pixels[:side, :side]
        Photo.from_array(pixels, encoding="srgb").save(OUT / f"{side}.jpg", overwrite=True)
    for label, (photo, size) in photos.items():
        ((width, height),) = predictor.input_sizes(size, "standard")
        if (width, height) not in alone:
            arguments = [str(side + -side % 32) for side in (height, width)] + [
                str(network.passes())
            ]
            alone[width, height] = measure([sys.executable, "-c", ALONE, str(model), *arguments])[
                :2
            ]
        alone_wall, alone_peak = alone[width, height]
        command = [
            sys.executable,
            "-m",
            "brewster",
            str(photo),
            "-o",
            str(OUT),
            "--overwrite",
            "--quiet",
        ]
        wall, peak, _ = measure([*command, "--model", name, "--device", "cpu"])
        print(
            f"{name}, {label} ({width} x {height}, {network.passes()} passes): {wall:.1f} s, "
            f"{peak / 2**20:.2f} GiB; "
            f"network alone {alone_wall:.1f} s, {alone_peak / 2**20:.2f} GiB; overhead "
            f"{wall / alone_wall - 1:+.0%}",
            flush=True,
        )


class _Twin(Predictor):
    """Knows T and R of 12 megapixels. Returns them at the size of the network, with noise."""

    def __init__(self, layers, noise, *, has_override=False):
        self._layers = layers
        self._noise = noise
        self._has_override = has_override

    def input_sizes(self, size, quality):
        return MultiScalePredictor(lambda tile: (tile, tile), (250_000,)).input_sizes(size, quality)

    def __call__(self, inputs, quality, on_progress):
        (photo,) = inputs
        rng = np.random.default_rng(3)
        small = [layer.resized(*photo.shape[1::-1]) for layer in self._layers]
        transmission, reflection = (noisy(layer, self._noise, rng) for layer in small)
        override = (
            GeneratedOverride.weighted_by_detail(transmission, reflection)
            if self._has_override
            else None
        )
        confidence = np.ones((*photo.shape[:2], 1), np.float32)
        return Prediction(transmission - photo, reflection, confidence, override)


def noisy(light, noise, rng):
    encoded = to_encoded(light) + rng.normal(0, noise, light.shape).astype(np.float32)
    return to_linear(np.clip(encoded, 0, 1)).astype(np.float32)


def enlargement(data: Path) -> None:
    """Prints the PSNR of T, sRGB-encoded, for soft and sharp reflections."""
    print(
        "| reflection | noise of the network | guided | guided, generated T at fine reflections "
        "| native tiles |\n"
        "|---|---|---|---|---|"
    )
    files = sorted((data / "photos/permissive").glob("*"), key=lambda path: path.stat().st_size)[
        -4:
    ]
    pictures = [Photo.open(path).resized(*SIZE_PX) for path in files]
    for label, blur in (("soft", 40), ("sharp", 1)):
        for noise in NOISE:
            scores = np.array(
                [twin_scores(a, b, blur, noise) for a, b in (pictures[:2], pictures[2:])]
            )
            print(
                f"| {label} | {noise:g} | "
                + " | ".join(f"{score:.1f}" for score in scores.mean(axis=0))
                + " |",
                flush=True,
            )


def twin_scores(scene, mirrored, blur, noise):
    small = Photo.from_array(mirrored, encoding="linear").resized(
        SIZE_PX[0] // blur, SIZE_PX[1] // blur
    )
    reflection = 0.3 * Photo.from_array(small, encoding="linear").resized(*SIZE_PX)
    transmission = 0.65 * scene
    photo = Photo.from_array(transmission + reflection, encoding="linear")
    layers = [Photo.from_array(layer, encoding="linear") for layer in (transmission, reflection)]
    scores = []
    for has_override in (False, True):
        separation = Separator(_Twin(layers, noise, has_override=has_override))(photo)
        scores.append(psnr(separation.transmission.linear(), transmission))
    rng = np.random.default_rng(3)
    (tiles,) = run_tiled(
        lambda tile: (noisy(tile, noise, rng),), transmission, tile_px=512, overlap_px=64
    )
    return [*scores, psnr(tiles, transmission)]


def psnr(predicted, truth):
    error = to_encoded(np.clip(predicted, 0, 1)) - to_encoded(np.clip(truth, 0, 1))
    return -10 * np.log10(max(float(np.square(error, dtype=np.float64).mean()), 1e-10))


if __name__ == "__main__":
    started = time.perf_counter()
    main(Path(os.environ["BREWSTER_DATA"]), sys.argv[1:])
    print(f"{time.perf_counter() - started:.0f} s")

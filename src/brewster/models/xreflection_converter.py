"""Converts a checkpoint of XReflection (DSRNet, DSIT, RDNet) to ONNX. `brewster models install` runs this file with the Python
of an environment that has xreflection_requirements.txt, but no brewster:

    python xreflection_converter.py XREFLECTION CHECKPOINT NETWORK FOLDER

XREFLECTION is a checkout of its repository, whose own code builds the network from the options in the checkpoint. FOLDER gets
full.onnx (float32), half.onnx (weights in half precision), and reference.npz: photos of a traced and of an untraced size, and the
layers that XReflection's unchanged code computes. Photos and layers are (1, 3, H, W) in linear light.
"""

from __future__ import annotations

import pickle
import sys
import tempfile
from pathlib import Path
from types import MethodType, ModuleType
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn

_SIZES: Final = ((160, 224), (192, 128))
"""(height, width) of the traced photo and of another one. At no level of DSIT are the sides of the first multiples of 12, its
window. Otherwise, its padding would be traced as none."""
_MAX_SIDE: Final = 64
"""The largest side of a photo, in units of 32 px."""


def add_package(name: str, folder: Path) -> None:
    """Makes the modules in the folder importable, without the package's own __init__, which imports what is not needed here."""
    package = ModuleType(name)
    package.__path__ = [str(folder)]
    sys.modules[name] = package


def import_torchvision() -> torch.library.Library | None:
    """Imports torchvision. Where its compiled part does not fit torch, defines the two operators that its import needs. They stay
    defined as long as the result exists."""
    try:
        import torchvision  # noqa: F401, PLC0415
    except RuntimeError:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        library = torch.library.Library("torchvision", "DEF")  # noqa: TOR901
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor boxes, Tensor scores, float threshold) -> Tensor")
        import torchvision  # noqa: F401, PLC0415

        return library
    return None


class PublishedNetwork(nn.Module):
    """A network of XReflection as its test loop runs it: sRGB photos (N, 3, H, W) to sRGB T and R, (N, 6, H, W)."""

    def __init__(self, network: nn.Module, features: nn.Module | None) -> None:
        super().__init__()
        self.network, self.features = network, features

    def forward(self, photo_encoded: Tensor) -> Tensor:
        """Returns the encoded transmission and reflection, concatenated along the channels."""
        inputs = [photo_encoded] if self.features is None else [photo_encoded, self.features(photo_encoded)]
        outputs = self.network(*inputs)
        if len(outputs) == 2:  # RDNet: classes, and the layers after each column
            return outputs[1][-1]  # type: ignore[no-any-return]
        return torch.cat(
            outputs[:2], dim=1
        )  # the third output of DSRNet and DSIT is what T and R do not explain


def load(checkpoint: Path, expected: str) -> PublishedNetwork:
    """Builds the network `expected` with the weights of a Lightning checkpoint. Only tensors and plain values are read. Exits
    with a message if the file is no such checkpoint."""
    try:
        saved = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)
        weights, options = saved["state_dict"], dict(saved["hyper_parameters"]["opt"]["network_g"])
    except (KeyError, TypeError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        sys.exit(f"{checkpoint} is no checkpoint of XReflection ({str(error).splitlines()[0][:200]})")
    kind = options["type"]
    if kind.removesuffix("NTIRE") != expected:
        sys.exit(f"{checkpoint} is a checkpoint of {kind}, not of {expected}")
    if kind == "RDNet" and weights["net_g.prompt.0.weight"].dim() == 4:
        options["type"] = "RDNetNTIRE"
    if "channels" in options:  # the constructor reverses this list, also in the checkpoint
        options |= {"channels": sorted(options["channels"]), "save_memory": False}
    features = None
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty.pth"
        torch.save({"model": {}}, empty)
        if kind != "DSRNet":  # the checkpoint has the weights of the backbones, too
            options["pretrained_models"] = {"swin_prior": str(empty)} if kind == "DSIT" else {}
        import torchvision  # noqa: PLC0415
        from xreflection.archs import build_network  # noqa: PLC0415

        random_vgg19 = torchvision.models.vgg19
        with (
            patch("torchvision.models.vgg19", lambda **_: random_vgg19(weights=None)),
            patch("xreflection.archs.swin_det.SwinTransformer.load_state_dict"),
        ):
            network = build_network(options)
            if kind == "DSRNet":
                from xreflection.losses.vgg import Vgg19  # noqa: PLC0415

                features = Vgg19()
    try:
        network.load_state_dict(_without_prefix(weights, "net_g."))
        if features:
            features.load_state_dict(_without_prefix(weights, "vgg."))
    except RuntimeError as error:
        sys.exit(f"{checkpoint} does not match {kind}: {' '.join(str(error).split())[:300]}")
    published = PublishedNetwork(network, features)
    for module in published.modules():
        module.training = False  # `eval` fails, because DSIT.train returns None
    return published


def _without_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}


def make_exportable(network: nn.Module) -> None:
    """Replaces what the exporter cannot trace by the same computation."""
    import xreflection.archs.dsit_arch as dsit  # noqa: PLC0415
    import xreflection.archs.swin_det as swin  # noqa: PLC0415

    for module in network.modules():
        kind = type(module).__name__
        if kind == "LayerNorm2d":  # an autograd.Function
            module.forward = MethodType(_normalize, module)
        elif kind == "BasicLayer" and hasattr(
            module, "shift_size"
        ):  # numpy functions of sizes become constants
            module.forward = MethodType(_swin_stage, module)
        elif kind == "SubNet":  # clamps its weights in every call
            for name in ("alpha0", "alpha1", "alpha2", "alpha3"):
                module._clamp_abs(getattr(module, name).data, 1e-3)  # type: ignore[operator]
            module._clamp_abs = lambda *_: None  # type: ignore[assignment]
    swin.window_reverse = dsit.window_reverse = _join_windows


def _normalize(self: Any, x: Tensor) -> Tensor:  # noqa: ANN401
    variance, mean = torch.var_mean(x, 1, correction=0, keepdim=True)
    normal = (x - mean) / (variance + self.eps).sqrt()
    return self.weight[:, None, None] * normal + self.bias[:, None, None]  # type: ignore[no-any-return]


def _swin_stage(self: Any, x: Tensor, height: int, width: int) -> tuple[Any, ...]:  # noqa: ANN401
    """A stage of the Swin transformer. Pixels attend to those of their window that have not been wrapped around by the shift."""
    from xreflection.archs.swin_det import window_partition  # noqa: PLC0415

    window, parts = self.window_size, []
    for side in (height, width):
        end = (side + window - 1) // window * window
        pixels = torch.arange(end)
        parts.append((pixels >= end - window).int() + (pixels >= end - self.shift_size).int())
    part = window_partition((3 * parts[0][:, None] + parts[1])[None, :, :, None], window).flatten(1)
    mask = -100.0 * (part[:, None] != part[:, :, None]).float()
    for block in self.blocks:
        block.H, block.W = height, width
        x = block(x, mask)
    if self.downsample is None:
        return x, height, width, x, height, width
    return x, height, width, self.downsample(x, height, width), (height + 1) // 2, (width + 1) // 2


def _join_windows(windows: Tensor, size: int, height: int, width: int) -> Tensor:
    grid = windows.view(1, height // size, width // size, size, size, windows.shape[-1])
    return grid.transpose(2, 3).reshape(1, height, width, windows.shape[-1])


def main(xreflection: Path, checkpoint: Path, kind: str, folder: Path) -> None:
    """Writes the three files."""
    torch.manual_seed(1)
    add_package("brewster", Path(__file__).parents[1])
    add_package("xreflection", xreflection / "xreflection")
    library = import_torchvision()
    from brewster.models.compact import LinearSeparator  # noqa: PLC0415
    from brewster.models.half_weights import with_half_weights  # noqa: PLC0415

    network = load(checkpoint, kind)
    separator = LinearSeparator(network)
    separator.training = False
    print("computing the reference", flush=True)  # noqa: T201
    photos = [torch.rand(1, 3, *size) for size in _SIZES]
    reference = {}
    with torch.no_grad():
        for index, photo in enumerate(photos):
            layers = separator(photo)
            reference |= {
                f"{name}{index}": image.numpy() for name, image in zip("ITR", (photo, *layers), strict=True)
            }
    np.savez(folder / "reference.npz", **reference)
    print("exporting", flush=True)  # noqa: T201
    make_exportable(network)
    rows, columns = (32 * torch.export.Dim(name, min=2, max=_MAX_SIDE) for name in ("rows", "columns"))
    with torch.no_grad():
        program = torch.onnx.export(
            separator,
            (photos[0],),
            input_names=["photo"],
            output_names=["transmission", "reflection"],
            dynamic_shapes={"photo": {2: rows, 3: columns}},
            opset_version=18,
            dynamo=True,
            optimize=False,
            verbose=False,
        )
    assert program is not None
    del separator, network, library
    model = program.model_proto
    (folder / "full.onnx").write_bytes(model.SerializeToString())
    (folder / "half.onnx").write_bytes(with_half_weights(model).SerializeToString())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], Path(sys.argv[4]))

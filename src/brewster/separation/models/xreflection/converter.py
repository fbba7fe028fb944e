"""Converts a checkpoint of XReflection (DSRNet, DSIT, RDNet) to ONNX. `brewster models install`
runs this script in an environment that has requirements.txt, but no brewster:

    python converter.py XREFLECTION CHECKPOINT KIND FOLDER

XREFLECTION is a checkout, whose own code builds the network from the options in the checkpoint.
FOLDER gets full.onnx, half.onnx (half weights), and reference.npz: photos of two sizes, with the
layers of XReflection's own code.

It is no module of brewster, and loads three files of it that import nothing of brewster.
"""

import importlib.util
import sys
import tempfile
from pathlib import Path
from types import MethodType, ModuleType
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor, nn

_BREWSTER: Final = Path(__file__).parents[3]
_SIZES: Final = ((160, 224), (192, 128))
"""(height, width) of the traced photo and of another one. The sides of the first are no multiples
of 12, DSIT's window, at any of its levels. Otherwise, padding would be traced as none.
"""


@torch.no_grad()
def main(xreflection: Path, checkpoint: Path, kind: str, folder: Path) -> None:
    """Writes the three files."""
    torch.manual_seed(1)
    # Without the package's own __init__, which imports what is not needed here
    sys.modules["xreflection"] = ModuleType("xreflection")
    sys.modules["xreflection"].__path__ = [str(xreflection / "xreflection")]
    library = import_torchvision()
    srgb = loaded_file(_BREWSTER / "photo" / "srgb.py")
    models = _BREWSTER / "separation" / "models"
    linear_separator = loaded_file(models / "linear_separator.py")
    half_weights = loaded_file(models / "half_weights.py")
    network = load(checkpoint, kind)
    separator = linear_separator.LinearSeparator(network, srgb.to_encoded, srgb.to_linear)
    separator.training = False
    photos = [torch.rand(1, 3, *size) for size in _SIZES]
    images = [(photo, *separator(photo)) for photo in photos]
    data = {
        f"{kind}{i}": image.numpy()
        for i in (0, 1)
        for kind, image in zip("ITR", images[i], strict=True)
    }
    np.savez(folder / "reference.npz", **data)
    make_exportable(separator)
    rows, columns = (32 * torch.export.Dim(name, min=2, max=64) for name in ("rows", "columns"))
    program = torch.onnx.export(
        separator,
        (photos[0],),
        input_names=["photo"],
        output_names=["transmission", "reflection"],
        dynamic_shapes={"photo": {2: rows, 3: columns}},
        opset_version=18,
        dynamo=True,
        optimize=False,  # it fails on DSIT; ONNX Runtime optimizes each model that it loads
        verbose=False,
    )
    assert program is not None
    del separator, library
    model = program.model_proto
    (folder / "full.onnx").write_bytes(model.SerializeToString())
    (folder / "half.onnx").write_bytes(half_weights.with_half_weights(model).SerializeToString())


def loaded_file(path: Path) -> Any:  # noqa: ANN401
    """Returns the module of a file that imports only other libraries."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def import_torchvision() -> Any:  # noqa: ANN401
    """Imports torchvision. If its compiled part does not fit torch, defines the two operators that
    its import needs. They last as long as the result.
    """
    try:
        import torchvision  # noqa: PLC0415
    except RuntimeError:
        for name in [name for name in sys.modules if name.startswith("torchvision")]:
            del sys.modules[name]
        library = torch.library.Library("torchvision", "DEF")  # type: ignore[no-untyped-call]
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor a, Tensor b, float c) -> Tensor")  # type: ignore[no-untyped-call]
        import torchvision  # noqa: F401, PLC0415

        return library
    return None


class _EncodedLayers(nn.Module):
    """A network as XReflection's test loop runs it: sRGB photos (N, 3, H, W) to sRGB T and R, (N,
    6, H, W).
    """

    def __init__(self, network: nn.Module, features: nn.Module | None) -> None:
        super().__init__()
        self.network = network
        self.features = features

    def forward(self, photo: Tensor) -> Tensor:
        outputs = (
            self.network(photo, self.features(photo)) if self.features else self.network(photo)
        )
        if len(outputs) == 2:  # RDNet: classes, and the layers after each column
            return outputs[1][-1]  # type: ignore[no-any-return]
        # the third output of DSRNet and DSIT is what T and R do not explain
        return torch.cat(outputs[:2], dim=1)


def load(checkpoint: Path, kind: str) -> nn.Module:
    """Builds the network with the weights of a Lightning checkpoint, of which only tensors and
    plain values are read. `brewster models install` has checked that it is one of this network.
    Exits with a message if the weights differ.
    """
    saved = torch.load(checkpoint, map_location="cpu", weights_only=True, mmap=True)
    weights = saved["state_dict"]
    options = dict(saved["hyper_parameters"]["opt"]["network_g"])
    found = options["type"]
    import torchvision  # noqa: PLC0415
    from xreflection.archs import build_network  # noqa: PLC0415
    from xreflection.losses.vgg import Vgg19  # noqa: PLC0415

    random_vgg19 = torchvision.models.vgg19
    swin = "xreflection.archs.swin_det.SwinTransformer.load_state_dict"
    with (
        tempfile.TemporaryDirectory() as folder,
        patch("torchvision.models.vgg19", lambda **_: random_vgg19(weights=None)),
        patch(swin, lambda *_: None),
    ):
        if kind != "DSRNet":  # no files of the backbones: the checkpoint has their weights, too
            torch.save({"model": {}}, f"{folder}/empty.pth")
            options["pretrained_models"] = (
                {"swin_prior": f"{folder}/empty.pth"} if kind == "DSIT" else {}
            )
        if kind == "RDNet":  # the constructor has reversed the channels in the checkpoint
            options |= {"channels": sorted(options["channels"]), "save_memory": False}
            if found == kind and weights["net_g.prompt.0.weight"].dim() == 4:
                options["type"] += "NTIRE"
        layers = _EncodedLayers(build_network(options), Vgg19() if kind == "DSRNet" else None)
    names = {"net_g.": "network.", "vgg.": "features."}
    kept = {
        new + key.removeprefix(old): value
        for old, new in names.items()
        for key, value in weights.items()
        if key.startswith(old) and (layers.features or old != "vgg.")
    }
    try:
        layers.load_state_dict(kept)
    except RuntimeError as error:
        sys.exit(f"{checkpoint} does not match {kind}: {' '.join(str(error).split())[:300]}")
    for module in layers.modules():
        module.training = False  # `eval` fails, because DSIT.train returns None
    return layers


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
        ):  # numpy functions become constants
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
    """A stage of the Swin transformer. Pixels attend only to those that the shift has not wrapped
    around.
    """
    from xreflection.archs.swin_det import window_partition  # noqa: PLC0415

    window = self.window_size
    parts = []
    for side in (height, width):
        end = (side + window - 1) // window * window
        pixels = torch.arange(end)
        parts.append((pixels >= end - window).int() + (pixels >= end - self.shift_size).int())
    part = window_partition((3 * parts[0][:, None] + parts[1])[None, :, :, None], window).flatten(1)
    mask = -100.0 * (part[:, None] != part[:, :, None]).float()
    for block in self.blocks:
        block.H = height
        block.W = width
        x = block(x, mask)
    if self.downsample is None:
        return x, height, width, x, height, width
    return x, height, width, self.downsample(x, height, width), (height + 1) // 2, (width + 1) // 2


def _join_windows(windows: Tensor, size: int, height: int, width: int) -> Tensor:
    grid = windows.view(1, height // size, width // size, size, size, windows.shape[-1])
    return grid.transpose(2, 3).reshape(1, height, width, windows.shape[-1])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], Path(sys.argv[4]))

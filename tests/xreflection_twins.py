"""Writes a twin of a published checkpoint: random weights, in the form in which XReflection's trainer saves them.

    ENVIRONMENT/bin/python tests/xreflection_twins.py XREFLECTION rdnet|dsrnet|dsit twin.ckpt

The environment is that of `brewster models install`. The residual scales, which start at zero, are random too: otherwise, a test
would compare identities. With the Adam state of one step, as in the published files.
"""

import sys
from pathlib import Path
from unittest.mock import patch

import torch
import yaml

ROOT = Path(__file__).parents[1]
OPTIONS = {"rdnet": "train_rdnet.yml", "dsrnet": "train_dsrnet.yml", "dsit": "train_dsit_w_nature.yml"}
SCALES = ("a", "b", "a_l", "a_r", "b_l", "b_r", "beta", "gamma", "gamma_1", "gamma_2")


def build(xreflection, name):
    """Returns XReflection's own Lightning module with random weights."""
    sys.path[:0] = [str(ROOT / "src/brewster/models"), str(xreflection)]
    from xreflection_converter import import_torchvision  # noqa: PLC0415

    library = import_torchvision()
    import torchvision  # noqa: PLC0415

    options = yaml.safe_load((xreflection / "options" / OPTIONS[name]).read_text())
    options["path"]["visualization"] = "visualization"
    options["network_g"]["pretrained_models"] = {} if name != "dsrnet" else None
    if name == "dsrnet":
        del options["network_g"]["pretrained_models"]
    torch.manual_seed(5)
    random_vgg19 = torchvision.models.vgg19
    import xreflection.archs.dsit_arch as dsit  # noqa: PLC0415
    import xreflection.archs.swin_det as swin  # noqa: PLC0415
    from xreflection.models import build_model  # noqa: PLC0415

    def random_swin(_):
        heads = [6, 12, 24, 48]
        return swin.SwinTransformer(
            384, embed_dim=192, depths=[2, 2, 18, 2], num_heads=heads, window_size=12, out_indices=[1, 2, 3]
        )

    with (
        patch("torchvision.models.vgg19", lambda **_: random_vgg19(weights=None)),
        patch.object(dsit, "swin_large_384_det", random_swin),
    ):
        model = build_model(options)
    with torch.no_grad():
        for path, weights in model.net_g.named_parameters():
            leaf = path.rpartition(".")[2]
            if leaf in SCALES:
                weights.copy_(0.3 * torch.randn_like(weights))
            elif leaf.startswith("alpha"):
                weights.copy_(0.5 + 0.2 * torch.randn_like(weights))
    return model, library


def save(model, path):
    import lightning  # noqa: PLC0415

    trainer = lightning.Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False, max_epochs=1
    )
    trainer.strategy.connect(model)
    groups = model.configure_optimizer_params()["params"]
    trained = [p for group in groups for p in (group["params"] if isinstance(group, dict) else [group])]
    optimizer = torch.optim.Adam(
        [p for p in trained if p.requires_grad][:8], lr=0
    )  # the state of a part: less disk
    for weights in optimizer.param_groups[0]["params"]:
        weights.grad = torch.zeros_like(weights)
    optimizer.step()
    trainer.strategy.optimizers = [optimizer]
    trainer.save_checkpoint(path)


if __name__ == "__main__":
    module, _library = build(Path(sys.argv[1]), sys.argv[2])
    save(module, sys.argv[3])

"""Compares converted networks with the code of their authors, at full size and with random weights.

    .venv/bin/python bench/xreflection_twins.py compare \\
        XREFLECTION rdnet|dsrnet|dsit OUT ENVIRONMENT/bin/python

A twin is a checkpoint with random weights, as XReflection's trainer saves it, with the Adam state
of one step. Prints the largest difference of a layer from that of XReflection's own test loop, for
three sizes (two are no multiples of 32: their loader resizes them). ENVIRONMENT has the packages of
`brewster models install`, and XREFLECTION is its checkout. Residual scales start at zero: they are
random too, because otherwise this would compare identities.
"""

import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
import yaml

ROOT = Path(__file__).parents[1]
OPTIONS = {
    "rdnet": "train_rdnet.yml",
    "dsrnet": "train_dsrnet.yml",
    "dsit": "train_dsit_w_nature.yml",
}
SCALES = ("a", "b", "a_l", "a_r", "b_l", "b_r", "beta", "gamma", "gamma_1", "gamma_2")


def build(xreflection, name):
    """Returns XReflection's own Lightning module with random weights."""
    sys.path[:0] = [str(ROOT / "src/brewster/separation/models/xreflection"), str(xreflection)]
    from converter import import_torchvision  # noqa: PLC0415

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
            384,
            embed_dim=192,
            depths=[2, 2, 18, 2],
            num_heads=heads,
            window_size=12,
            out_indices=[1, 2, 3],
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
            elif path.startswith("out."):  # the layers of DSRNet and DSIT would be nearly black
                weights.copy_(10 * weights if leaf == "weight" else torch.full_like(weights, 0.5))
    return model, library


def save(model, path):
    import lightning  # noqa: PLC0415

    trainer = lightning.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        max_epochs=1,
    )
    trainer.strategy.connect(model)
    groups = model.configure_optimizer_params()["params"]
    trained = [
        p for group in groups for p in (group["params"] if isinstance(group, dict) else [group])
    ]
    optimizer = torch.optim.Adam(
        [p for p in trained if p.requires_grad][:8], lr=0
    )  # the state of a part: less disk
    for weights in optimizer.param_groups[0]["params"]:
        weights.grad = torch.zeros_like(weights)
    optimizer.step()
    trainer.strategy.optimizers = [optimizer]
    trainer.save_checkpoint(path)


def run_test_loop(model, checkpoint, pairs, target):
    """Runs the test loop of XReflection, as its train.py does with --test_only.

    Writes the photos that its loader reads, and the layers that it scores: (H, W, 3) sRGB in 0..1.
    """
    import lightning  # noqa: PLC0415
    from xreflection.data import build_dataloader, build_dataset  # noqa: PLC0415

    options = dict(model.opt["datasets"]["val_datasets"][0]) | {
        "datadir": str(pairs),
        "phase": "test",
        "num_worker_per_gpu": 0,
    }
    loader = build_dataloader(build_dataset(options), options)
    model.opt["val"]["save_img"] = False
    model.setup_losses = lambda: (
        None
    )  # a test needs none, and the perceptual loss downloads weights
    found = {}
    step = model.validation_step

    def recorded(batch, *arguments):
        outputs = step(batch, *arguments)
        layers = (batch["input"], outputs["output_clean"], outputs["output_reflection"])
        for kind, image in zip("ITR", layers, strict=True):
            found[f"{kind}_{outputs['img_name']}"] = image[0].permute(1, 2, 0).clamp(0, 1).numpy()
        return outputs

    model.validation_step = recorded
    trainer = lightning.Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    trainer.test(model, dataloaders=[loader], ckpt_path=checkpoint)
    np.savez(target, **found)


def compare(xreflection, name, out, python):
    from brewster import Photo  # noqa: PLC0415  (not in ENVIRONMENT)
    from brewster.photo.srgb import to_encoded, to_linear  # noqa: PLC0415
    from brewster.separation.models import network_install  # noqa: PLC0415
    from brewster.separation.models.published_networks import PUBLISHED_NETWORKS  # noqa: PLC0415
    from brewster.separation.onnx_backend import OnnxBackend  # noqa: PLC0415

    rng = np.random.default_rng(7)
    for index, (height, width) in enumerate(((160, 224), (301, 215), (270, 320))):
        small = rng.uniform(0, 0.55, (height // 8 + 1, width // 8 + 1, 3))
        pixels = (255 * np.kron(small, np.ones((8, 8, 1)))[:height, :width]).astype(np.uint8)
        for folder in ("blended", "transmission_layer"):
            Photo.from_array(pixels, encoding="srgb").save(
                out / folder / f"{index}.png", overwrite=True
            )
    converter = network_install._CONVERTER
    twin = out / "twin.ckpt"
    kind = PUBLISHED_NETWORKS[name].kind
    for command in (
        [python, __file__, "save", xreflection, name, twin],
        [python, __file__, "test", xreflection, name, twin, out, out / "loop.npz"],
        [python, "-I", converter, xreflection, twin, kind, out],
    ):
        subprocess.run([*map(str, command)], check=True)
    loop = dict(np.load(out / "loop.npz"))
    network = OnnxBackend(out / "full.onnx", "cpu", is_large=True)
    for index in range(3):
        layers = [to_encoded(layer) for layer in network(to_linear(loop[f"I_{index}"]))]
        errors = [
            np.abs(layer - loop[f"{part}_{index}"]).max()
            for part, layer in zip("TR", layers, strict=True)
        ]
        print(f"{name}, {loop[f'I_{index}'].shape}: T {errors[0]:.1e}, R {errors[1]:.1e}")


if __name__ == "__main__":
    task, source, network, path, *others = sys.argv[1:]
    if task == "compare":
        compare(Path(source), network, Path(path), *others)
    else:
        module, _library = build(Path(source), network)
        if task == "save":
            save(module, path)
        else:
            run_test_loop(module, path, *others)

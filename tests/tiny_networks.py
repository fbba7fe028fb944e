"""Tiny networks in the form of XReflection's (tiny_xreflection), their checkpoints, and a Python
that imports them.
"""

import shutil
import sys
from pathlib import Path

import torch

from brewster.separation.models import network_install
from brewster.separation.models.published_networks import COMMIT

TINY_SOURCE = Path(__file__).with_name("tiny_xreflection")
OPTIONS = {"rdnet":{
    "type": "RDNet", "channels": [8, 16], "save_memory": True,
    "pretrained_models": {"cls_model": "cls_model.pth"},
}, "dsrnet": {"type": "DSRNet", "width": 4}}  # fmt: skip


def tiny_module(name):
    """Returns the tiny network with random weights, and its features or None."""
    sys.path.insert(0, str(TINY_SOURCE))
    try:
        from xreflection.archs import build_network  # noqa: PLC0415
        from xreflection.losses import vgg  # noqa: PLC0415
    finally:
        sys.path.remove(str(TINY_SOURCE))
        for stand_in in [
            module for module in sys.modules if module.partition(".")[0] == "torchvision"
        ]:
            del sys.modules[stand_in]
    torch.manual_seed(3)
    options = dict(OPTIONS[name])
    if name == "rdnet":
        options |= {
            "channels": list(options["channels"]),
            "save_memory": False,
            "pretrained_models": {},
        }
        return build_network(options), None
    features = torch.nn.Module.__new__(vgg.Vgg19)
    torch.nn.Module.__init__(features)
    features.features = vgg.models.vgg19(weights=None)
    return build_network(options), features


def tiny_checkpoint(name, path):
    """Writes a checkpoint as XReflection's trainer (Lightning) does, with the state of Adam."""
    network, features = tiny_module(name)
    optimizer = torch.optim.Adam(network.parameters(), lr=0)
    sum(weights.sum() for weights in network.parameters()).backward()
    optimizer.step()
    weights = {f"net_g.{key}": value for key, value in network.state_dict().items()}
    if features:
        weights |= {f"vgg.{key}": value for key, value in features.state_dict().items()}
    reversed_options = OPTIONS[name] | ({"channels": [16, 8]} if name == "rdnet" else {})
    settings = {"network_g": reversed_options, "model_type": f"{OPTIONS[name]['type']}Model"}
    saved = {
        "epoch": 1,
        "global_step": 1,
        "pytorch-lightning_version": "2.6.6",
        "state_dict": weights,
        "optimizer_states": [optimizer.state_dict()],
        "lr_schedulers": [],
        "hyper_parameters": {"opt": settings},
    }
    torch.save(saved, path)
    return path


def tiny_python(path):
    """Writes a program that is this Python with the tiny networks' modules in place of an
    environment's.
    """
    path.write_text(f'#!/bin/sh\nshift\nPYTHONPATH={TINY_SOURCE} exec {sys.executable} "$@"\n')
    path.chmod(0o755)
    return path


def prepare_installation():
    """Writes the code and the environment where an interrupted installation left them: none is
    downloaded.
    """
    work = network_install.work_folder()
    shutil.copytree(TINY_SOURCE, work / f"XReflection-{COMMIT}", dirs_exist_ok=True)
    (work / "environment" / "bin").mkdir(parents=True, exist_ok=True)
    python = tiny_python(work / "environment" / "bin" / "python")
    (work / "environment" / "installed.txt").write_text(network_install._REQUIREMENTS.read_text())
    return python


def install_arguments(name, folder):
    """Returns the arguments of `brewster models install` that install a tiny network, see
    `prepare_installation`.
    """
    return [
        "models",
        "install",
        name,
        "--yes",
        "--checkpoint",
        tiny_checkpoint(name, folder / f"{name}.ckpt"),
    ]

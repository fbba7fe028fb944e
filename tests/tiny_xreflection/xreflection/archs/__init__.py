"""Tiny networks with the constructors, checkpoints and outputs of XReflection's. See
tiny_networks.py.
"""

import torch
from torch import nn


class Norm(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias, eps):
        centred = x - x.mean(1, keepdim=True)
        normal = centred / (centred.pow(2).mean(1, keepdim=True) + eps).sqrt()
        return weight.view(1, -1, 1, 1) * normal + bias.view(1, -1, 1, 1)


class LayerNorm2d(nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.eps = 1e-6

    def forward(self, x):
        return Norm.apply(x, self.weight, self.bias, self.eps)


class SubNet(nn.Module):
    def __init__(self, channels, save_memory):
        super().__init__()
        assert not save_memory, "this form is not exportable"
        for name in ("alpha0", "alpha1", "alpha2", "alpha3"):
            setattr(self, name, nn.Parameter(0.5 * torch.ones(1, channels, 1, 1)))
        self.mix = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x):
        for weight in (self.alpha0, self.alpha1, self.alpha2, self.alpha3):
            self._clamp_abs(weight.data, 1e-3)
        return self.alpha0 * x + self.mix(x)

    def _clamp_abs(self, data, value):
        sign = data.sign()
        data.abs_().clamp_(value)
        data *= sign


class RDNet(nn.Module):
    def __init__(self, channels, save_memory=True, pretrained_models=None):
        super().__init__()
        pretrained_models.pop("cls_model", None)
        self.subnet0 = SubNet(channels[0], save_memory)
        channels.reverse()
        assert channels[0] > channels[-1]
        self.baseball = nn.Conv2d(3, channels[-1], 3, padding=1)
        self.norm = LayerNorm2d(channels[-1])
        self.prompt = nn.Sequential(nn.Linear(3, channels[-1]))
        self.decoder = nn.Conv2d(channels[-1], 6, 3, padding=1)

    def forward(self, x):
        prompt = self.prompt(x.mean((2, 3)))[..., None, None]
        features = self.subnet0(self.norm(self.baseball(x)) * prompt)
        return [], [torch.cat([x, x], 1), torch.cat([x, x], 1) - self.decoder(features)]


class DSRNet(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.lrm = nn.Conv2d(3 + width, 9, 3, padding=1)
        self.norm = LayerNorm2d(3)

    def forward(self, x, features):
        layers = self.lrm(torch.cat([self.norm(x), features[0]], 1))
        return x + layers[:, :3], 0.5 * x + layers[:, 3:6], layers[:, 6:]


def build_network(options):
    options = dict(options)
    return {"RDNet": RDNet, "DSRNet": DSRNet}[options.pop("type")](**options)

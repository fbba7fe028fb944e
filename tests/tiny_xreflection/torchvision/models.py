from torch import nn


def vgg19(weights):
    assert weights is None, "the weights of the backbone must not be downloaded"
    return nn.Conv2d(3, 4, 3, padding=1)

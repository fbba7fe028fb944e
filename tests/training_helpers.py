"""Helpers for tests of training: interrupted runs, and the comparison of batches."""

import torch
from torch import nn

from brewster.training.compact.trainer import CompactTrainer
from brewster.training.loop import run


def train(recipe, out, on_step):
    """Trains a recipe in the folder `out`, or resumes its run. Returns the network with the
    averaged weights.
    """
    trainer = CompactTrainer(recipe)
    run(trainer, out, on_step)
    return trainer.ema_network()


class Killed(Exception):
    """Simulates the end of a process in the middle of a run."""


def kill_after(last):
    """A report of steps that ends the run after this step."""

    def report(step, steps, metrics, logged):
        if step == last:
            raise Killed

    return report


def ignore_step(step, steps, metrics, logged):
    pass


def same(one, other):
    """Whether two batches have the same tensors."""
    return all(torch.equal(tensor, other.tensors()[name]) for name, tensor in one.tensors().items())


class SmallNetwork(nn.Module):
    """A network of two convolutions at a stride of 4."""

    def __init__(self):
        super().__init__()
        self.encoder = nn.Conv2d(3, 8, 4, stride=4)
        self.head = nn.ConvTranspose2d(8, 6, 4, stride=4)

    def forward(self, photo_encoded):
        return self.head(self.encoder(photo_encoded)) + torch.cat(
            [photo_encoded, 0 * photo_encoded], dim=1
        )

"""TensorBoard events of a run, read back with TensorBoard."""

import sys
import time

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from brewster.training.loop import IMAGE_TAG, TensorBoardLog


def read(folder):
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0})
    return events.Reload()


def test_a_resumed_run_discards_events_of_later_steps(tmp_path):
    image = torch.zeros(4, 6, 3)
    killed = TensorBoardLog(tmp_path, 0)
    for step in (1, 2, 3):
        killed.log(step, {"loss": 10.0}, image)
    time.sleep(1.1)  # event files are named and sorted by the second of their creation
    resumed = TensorBoardLog(tmp_path, 1)
    for step in (2, 3, 4):
        resumed.log(step, {"loss": 5.0}, image)
    events = read(tmp_path)
    assert [(event.step, event.value) for event in events.Scalars("loss")] == [
        (1, 10.0), (2, 5.0), (3, 5.0), (4, 5.0),
    ]  # fmt: skip
    assert [event.step for event in events.Images(IMAGE_TAG)] == [1, 2, 3, 4]


def test_without_tensorboard_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    TensorBoardLog(tmp_path, 0).log(1, {"loss": 1.0}, torch.zeros(4, 6, 3))
    assert not list(tmp_path.iterdir())

import json
import time
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from brewster.errors import RecipeError
from brewster.training.loop import Checkpoint, run
from brewster.training.plots import CAPTION_PX, sample_sheet
from brewster.training.recipe import with_value
from training_helpers import Killed, ignore_step, kill_after, train


class CountingTrainer:
    """A minimal trainer that records its steps."""

    def __init__(self, recipe):
        self.recipe = recipe
        self.steps = []
        self.initialized = False

    def initialize(self):
        self.initialized = True

    def training_step(self, step):
        self.steps.append(step)
        return {"loss": 1.0 / (1 + step)}

    def state_dict(self):
        return {"steps": self.steps}

    def load_state_dict(self, state):
        self.steps = list(state["steps"])

    def validate(self):
        return {"gain": float(len(self.steps))}, torch.zeros(4, 6, 3)

    def export(self, folder):
        return folder


def logged_steps(out):
    return [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]


def test_the_loop_runs_any_trainer(recipe, tmp_path):
    calls = []
    trainer = CountingTrainer(recipe)
    run(trainer, tmp_path, lambda step, steps, metrics, logged: calls.append((step, steps, logged)))
    assert trainer.initialized
    assert trainer.steps == list(range(6))
    assert calls == [(step, 6, step in {3, 6}) for step in range(1, 7)]
    first = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[0])
    assert first.keys() == {"step", "loss", "gain", "seconds"}
    again = CountingTrainer(recipe)
    run(again, tmp_path, ignore_step)
    assert not again.initialized
    assert again.steps == trainer.steps


def test_tensorboard_gets_the_values_of_the_log(recipe, tmp_path):
    run(CountingTrainer(recipe), tmp_path, ignore_step)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    events = EventAccumulator(str(tmp_path)).Reload()
    assert set(events.Tags()["scalars"]) == lines[0].keys() - {"step"}
    for name in ("loss", "gain"):
        logged = [(event.step, event.value) for event in events.Scalars(name)]
        assert logged == [(line["step"], pytest.approx(line[name], abs=1e-5)) for line in lines]
    assert [event.step for event in events.Images("samples")] == [3, 6]
    run(CountingTrainer(recipe), tmp_path, ignore_step)
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_a_killed_and_resumed_run_ends_with_bit_identical_weights(recipe, tmp_path):
    uninterrupted = train(recipe, tmp_path / "one", ignore_step)
    with pytest.raises(Killed):
        train(recipe, tmp_path / "two", kill_after(5))
    resumed = train(recipe, tmp_path / "two", ignore_step)
    for name, value in uninterrupted.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_a_run_resumes_after_a_key_was_added_to_the_recipe_schema(recipe, tmp_path):
    with pytest.raises(Killed):
        train(recipe, tmp_path, kill_after(5))
    saved = Checkpoint.read(tmp_path / "checkpoint.pt")
    old = json.loads(saved.recipe)
    del old["data"]["rendered"]
    replace(saved, recipe=json.dumps(old)).write(tmp_path / "checkpoint.pt")
    train(recipe, tmp_path, ignore_step)
    assert logged_steps(tmp_path) == [3, 6]


def test_a_refused_resume_names_the_values_that_differ(recipe, tmp_path):
    run(CountingTrainer(recipe), tmp_path, ignore_step)
    other = with_value(with_value(recipe, "mix.veil", [0.0, 0.5]), "learning_rate", 0.01)
    differences = (
        r"learning_rate was 0\.001, is 0\.01, mix\.veil was \[0\.0, 0\.1\], is \[0\.0, 0\.5\]"
    )
    with pytest.raises(RecipeError, match=rf"{differences}; .* may change: steps,"):
        run(CountingTrainer(other), tmp_path, ignore_step)


def test_a_run_can_be_made_longer_but_not_shorter(recipe, tmp_path):
    trainer = CountingTrainer(recipe.model_copy(update={"steps": 3}))
    run(trainer, tmp_path, ignore_step)
    longer = CountingTrainer(recipe.model_copy(update={"steps": 5, "report_every": 1}))
    run(longer, tmp_path, ignore_step)
    assert longer.steps == [0, 1, 2, 3, 4]
    assert logged_steps(tmp_path) == [3, 4, 5]
    with pytest.raises(RecipeError, match="has 5 completed steps, but the recipe has steps = 3"):
        run(trainer, tmp_path, ignore_step)


def test_a_resumed_run_logs_every_step_once(recipe, tmp_path):
    often = recipe.model_copy(update={"steps": 4, "report_every": 1, "checkpoint_every": 2})
    with pytest.raises(Killed):
        train(often, tmp_path, kill_after(3))
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 4, "lo')
    time.sleep(1.1)  # event files are named and sorted by the second of their creation
    train(often, tmp_path, ignore_step)
    assert logged_steps(tmp_path) == [1, 2, 3, 4]
    events = EventAccumulator(str(tmp_path), size_guidance={"images": 0}).Reload()
    assert [event.step for event in events.Scalars("loss")] == [1, 2, 3, 4]
    assert [event.step for event in events.Images("samples")] == [1, 2, 3, 4]


def test_a_checkpoint_is_written_every_checkpoint_every_steps_and_at_the_end(recipe, tmp_path):
    path = tmp_path / "checkpoint.pt"
    steps = []

    def record(step, total, metrics, logged):
        steps.append(Checkpoint.read(path).step if path.exists() else 0)

    run(
        CountingTrainer(recipe.model_copy(update={"steps": 5, "checkpoint_every": 2})),
        tmp_path,
        record,
    )
    assert steps == [0, 2, 2, 4, 5]


def test_a_sheet_has_the_images_unchanged_below_their_captions():
    images = [torch.rand(3, 40, 120) for _ in range(2)]
    sheet = sample_sheet(["a", "b"], [("first", images[0]), ("second", images[1])])
    assert sheet.shape == (CAPTION_PX + 2 * (CAPTION_PX + 40), 120, 3)
    for row, image in enumerate(images):
        top = 2 * CAPTION_PX + row * (CAPTION_PX + 40)
        assert torch.equal(sheet[top : top + 40], image.permute(1, 2, 0))
        caption = sheet[top - CAPTION_PX : top]
        assert caption.amin() < 0.5 < caption.amax() == 1  # dark letters on white

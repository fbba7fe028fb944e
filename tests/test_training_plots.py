"""The curves of a run and the sheet of sample predictions."""

import torch

from brewster import Photo
from brewster.training.plots import CAPTION_PX, plot_log, sample_sheet


def test_a_sheet_has_the_images_unchanged_below_their_captions():
    images = [torch.rand(3, 40, 120) for _ in range(2)]
    sheet = sample_sheet(["a", "b"], [("first", images[0]), ("second", images[1])])
    assert sheet.shape == (CAPTION_PX + 2 * (CAPTION_PX + 40), 120, 3)
    for row, image in enumerate(images):
        top = 2 * CAPTION_PX + row * (CAPTION_PX + 40)
        assert torch.equal(sheet[top : top + 40], image.permute(1, 2, 0))
        caption = sheet[top - CAPTION_PX : top]
        assert caption.amin() < 0.5 < caption.amax() == 1  # dark letters on white


def test_metrics_of_one_kind_share_a_subplot():
    """Three subplots: the loss, its terms, and the gains of both folders."""
    values = {"loss_a": 0.1, "loss_b": -0.1, "psnr_gain_db_x": 1.0, "psnr_gain_db_y": 2.0, "seconds": 5.0}
    lines = [{"step": step, "loss": 1 / step, **values} for step in (1, 2)]
    logs = lines, [{**line, "exposure_x": 1.0} for line in lines], [{"step": 1, "loss": 0.5}]
    widths = [Photo.open(plot_log(log)).size for log in logs]
    assert widths[0][0] == 3 * widths[2][0]
    assert widths[0][1] == widths[2][1]
    assert widths[1] == (widths[0][0], 2 * widths[0][1])  # a fourth subplot starts a second row

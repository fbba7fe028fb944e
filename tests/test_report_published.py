import re

import pytest

from brewster.evaluate.report.tables import PublishedScores, published_to_markdown, read_published

IMAGE_COUNTS = {"real20": 20, "nature20": 20, "postcard20": 20, "solidobject20": 20, "wildscene101": 101}
ROWS = read_published()
AVERAGED = [row for row in ROWS if "average181" in row.scores]


@pytest.mark.parametrize("row", AVERAGED, ids=lambda row: f"{row.copied_from[:7]} {row.method}")
def test_a_printed_average_is_the_mean_weighted_by_the_numbers_of_images(row):
    for metric, average in row.scores["average181"].items():
        mean = sum(count * float(row.scores[name][metric]) for name, count in IMAGE_COUNTS.items()) / 181
        digits = len(average.partition(".")[2])
        assert abs(mean - float(average)) <= 0.5001 * 10**-digits, metric


def test_a_missing_set_or_metric_is_a_dash():
    rows = [
        PublishedScores("a", "paper", "Table 1", "twenty", {"real20": {"psnr": "20.5", "ssim": "0.9"}}),
        PublishedScores(
            "b", "other paper", "Table 2", "twenty", {"real20": {"ssim": "0.8"}, "nature20": {"psnr": "21.0"}}
        ),
    ]
    text = re.sub(" +", " ", published_to_markdown(rows))
    assert "| a | 20.5 / 0.9 | - |" in text
    assert "| b | - / 0.8 | 21.0 / - |" in text
    assert "- a: paper; copied from Table 1\n- b: other paper; copied from Table 2" in text

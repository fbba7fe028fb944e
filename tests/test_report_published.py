import re

import pytest

from brewster.evaluate.report.published import PublishedScores, read_published, to_markdown

IMAGE_COUNTS = {"real20": 20, "nature20": 20, "postcard20": 20, "solidobject20": 20, "wildscene101": 101}
ROWS = read_published()
AVERAGED = [row for row in ROWS if "average181" in row.scores]


def test_all_tables_of_the_paper_are_present():
    tables = {}
    for row in ROWS:
        tables.setdefault(row.copied_from, []).append(row.method)
    assert [len(tables[f"Table {number} of that paper"]) for number in (1, 2, 4)] == [7, 3, 2]
    from_notes = {row.method for row in ROWS if "the notes" in row.copied_from}
    assert from_notes == {
        "WindowSeat",
        "GenSIRR",
        "RDNet",
        "DSRNet",
        "ERRNet",
        "IBCLN",
        "input (unprocessed)",
    }


@pytest.mark.parametrize("row", AVERAGED, ids=lambda row: f"{row.copied_from[:7]} {row.method}")
def test_a_printed_average_is_the_mean_weighted_by_the_numbers_of_images(row):
    for metric, average in row.scores["average181"].items():
        mean = sum(count * row.scores[name][metric] for name, count in IMAGE_COUNTS.items()) / 181
        digits = len(str(average).partition(".")[2])
        assert abs(mean - average) <= 0.5001 * 10**-digits, metric


def test_every_score_is_in_a_plausible_range():
    for row in ROWS:
        for scores in row.scores.values():
            assert set(scores) <= {"psnr", "ssim", "lpips", "lpips_region"}
            assert 15 < scores.get("psnr", 20) < 35
            assert all(0 < value < 1 for metric, value in scores.items() if metric != "psnr")


def test_published_scores_have_a_heading_that_separates_them_from_measured_scores():
    text = to_markdown(ROWS)
    assert text.startswith("## Published scores of other methods (not measured here; the protocols differ)\n")
    headers = [line for line in text.splitlines() if line.startswith("| published: ")]
    assert len(headers) == text.count("**Protocol.** ") == len({row.protocol for row in ROWS})


def test_the_markdown_has_the_digits_that_the_paper_printed():
    text = re.sub(" +", " ", to_markdown(ROWS))
    assert "| 26.60 / 0.934 / 0.072 |" in text
    assert "| 23.418 / 0.8881 / 0.1380 |" in text
    assert "| ERRNet | 22.9 |" in text


def test_all_lines_of_a_markdown_table_have_the_same_number_of_cells():
    for block in re.findall(r"(?:^\|.*\n)+", to_markdown(ROWS), re.M):
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_a_missing_set_or_metric_is_a_dash():
    rows = [
        PublishedScores("a", "paper", "Table 1", "twenty", {"real20": {"psnr": 20.5, "ssim": 0.9}}),
        PublishedScores(
            "b", "other paper", "Table 2", "twenty", {"real20": {"ssim": 0.8}, "nature20": {"psnr": 21.0}}
        ),
    ]
    text = re.sub(" +", " ", to_markdown(rows))
    assert "| a | 20.5 / 0.9 | - |" in text
    assert "| b | - / 0.8 | 21.0 / - |" in text
    assert "- a: paper; copied from Table 1\n- b: other paper; copied from Table 2" in text

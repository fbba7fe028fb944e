import re

import pytest

from brewster.evaluate.report.published import PublishedScores, read_published, to_markdown

PICTURES = {"real20": 20, "nature20": 20, "postcard20": 20, "solidobject20": 20, "wildscene101": 101}
ROWS = read_published()
AVERAGED = [row for row in ROWS if "average181" in row.scores]


def test_the_papers_tables_are_all_there():
    tables = {}
    for row in ROWS:
        tables.setdefault(row.copied_from, []).append(row.method)
    assert [len(tables[f"Table {number} of that paper"]) for number in (1, 2, 4)] == [7, 3, 2]
    elsewhere = {row.method for row in ROWS if "the notes" in row.copied_from}
    assert elsewhere == {"WindowSeat", "GenSIRR", "RDNet", "DSRNet", "ERRNet", "IBCLN", "input (unprocessed)"}


@pytest.mark.parametrize("row", AVERAGED, ids=lambda row: f"{row.copied_from[:7]} {row.method}")
def test_an_average_that_a_paper_prints_is_the_mean_weighted_by_pictures(row):
    for metric, average in row.scores["average181"].items():
        mean = sum(count * row.scores[name][metric] for name, count in PICTURES.items()) / 181
        digits = len(str(average).partition(".")[2])
        assert abs(mean - average) <= 0.5001 * 10**-digits, metric


def test_every_row_names_its_source_its_place_and_its_protocol():
    for row in ROWS:
        assert all((row.method, row.source, row.copied_from, row.protocol))
        assert row.scores
        assert all(row.scores.values())


def test_every_score_is_possible():
    for row in ROWS:
        for scores in row.scores.values():
            assert set(scores) <= {"psnr", "ssim", "lpips", "lpips_region"}
            assert 15 < scores.get("psnr", 20) < 35
            assert all(0 < value < 1 for metric, value in scores.items() if metric != "psnr")


def test_nobody_can_take_published_figures_for_measured_ones():
    text = to_markdown(ROWS)
    assert text.startswith("## Published by others, not measured here; protocols differ\n")
    headers = [line for line in text.splitlines() if line.startswith("| published: ")]
    assert len(headers) == text.count("**Protocol.** ") == len({row.protocol for row in ROWS})


def test_the_markdown_prints_numbers_as_their_paper_printed_them():
    text = to_markdown(ROWS)
    assert "| 26.60 / 0.934 / 0.072 |" in text
    assert "| 23.418 / 0.8881 / 0.1380 |" in text
    assert "| ERRNet | 22.9 |" in text


def test_every_table_of_the_markdown_is_rectangular():
    for block in re.findall(r"(?:^\|.*\n)+", to_markdown(ROWS), re.M):
        assert len({line.count("|") for line in block.splitlines()}) == 1


def test_a_missing_set_or_metric_is_a_dash():
    rows = [
        PublishedScores("a", "paper", "Table 1", "twenty", {"real20": {"psnr": 20.5, "ssim": 0.9}}),
        PublishedScores(
            "b", "other paper", "Table 2", "twenty", {"real20": {"ssim": 0.8}, "nature20": {"psnr": 21.0}}
        ),
    ]
    text = to_markdown(rows)
    assert "| a | 20.5 / 0.9 | - |" in text
    assert "| b | - / 0.8 | 21.0 / - |" in text
    assert "- a: paper; read in Table 1\n- b: other paper; read in Table 2" in text

"""Tables from results whose numbers are known."""

import csv
import io
import re

import pytest

from brewster.evaluate.report.tables import best_mean, overview, to_csv, to_latex, to_markdown

METRICS = {
    "psnr": {"title": "PSNR", "unit": "dB", "higher_is_better": True, "digits": 2, "about": "PSNR is so."},
    "lpips": {"title": "LPIPS", "unit": "", "higher_is_better": False, "digits": 3, "about": "LPIPS is so."},
}
SETS = ["real20", "nature20", "postcard", "solidobject", "wildscene"]


def entry(mean, count=20, low=None, high=None):
    return {"mean": mean, "low": low, "high": high, "count": count}


@pytest.fixture
def results():
    selections = {key: {"title": key.title(), "pictures": 20} for key in SETS}
    selections["average"] = {"title": "Average", "pictures": 100}
    table = {
        "doing nothing": {"psnr": entry(20.0, low=18.5, high=21.25), "lpips": entry(0.2)},
        "A_b|c": {"psnr": entry(21.5), "lpips": entry(0.1234)},
    }
    apart = {"method": "A_b|c", "than": "doing nothing"}
    rows = [
        apart | {"metric": "psnr", "mean": 1.5, "low": -0.25, "high": 3.0, "better": 15, "count": 20},
        apart | {"metric": "lpips", "mean": -0.0766, "low": None, "high": None, "better": 20, "count": 20},
    ]
    return {
        "protocol": {"choices": ["Everything is stated."]},
        "metrics": METRICS,
        "selections": selections,
        "benchmarks": {
            "real20": {"title": "Real20", "remarks": ["20 of 20"], "refused": ["x.png has no partner"]}
        },
        "methods": {"doing nothing": {}, "A_b|c": {"remark": "2 pictures answer no case"}},
        "unmeasured": ["removed_white"],
        "pictures": [{"errors": {"A_b|c": "A_b|c failed on real20/3"}}],
        "tables": dict.fromkeys(selections, table),
        "differences": dict.fromkeys(selections, rows),
    }


def test_markdown_shows_means_intervals_and_paired_differences(results):
    text = to_markdown(results)
    assert "20.00 (18.50 to 21.25)" in text
    assert "+1.50 (-0.25 to +3.00), better on 15 of 20" in text
    assert "PSNR, dB ↑" in text
    assert "LPIPS ↓" in text
    assert "21.50 / 0.123" in text


def test_markdown_says_aloud_what_was_left_out_what_failed_and_every_choice(results):
    text = to_markdown(results)
    for said in (
        "left out: x.png has no partner",
        "- A_b|c failed on real20/3",
        "2 pictures answer no case",
        "Everything is stated.",
        "LPIPS is so.",
    ):
        assert said in text


def test_a_table_has_as_many_cells_in_every_line_whatever_names_hold(results):
    for block in re.findall(r"(?:^\|.*\n)+", overview(results), re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


def test_a_method_that_failed_somewhere_shows_how_many_pictures_it_is_judged_on(results):
    results["tables"]["real20"] = {
        "doing nothing": {"psnr": entry(20.0)},
        "A_b|c": {"psnr": entry(21.5, count=19)},
    }
    assert "21.50 / - (0 to 19 of 20)" in to_markdown(results)
    assert "| 21.50, 19 of 20 " in to_markdown(results)


def test_latex_has_the_papers_layout_and_the_best_in_bold(results):
    text = to_latex(results)
    assert r"\begin{tabular}{l|cc|cc|cc|cc|cc|cc}" in text
    assert r"\multicolumn{6}{c}{SIR$^2$ (60)}" in text
    assert r"\cmidrule(lr){6-11}" in text
    assert r"A\_b|c & \textbf{21.50} & \textbf{0.123}" in text
    body = [line for line in text.splitlines() if line.startswith(("A", "doing", " &", r"\multirow"))]
    widths = [
        sum(int(n) - 1 for n in re.findall(r"multicolumn\{(\d+)\}", line)) + line.count("&") for line in body
    ]
    assert set(widths) == {12}


def test_latex_takes_the_papers_draw_where_there_is_one(results):
    for part in ("selections", "tables", "differences"):
        results[part]["postcard:paper"] = results[part]["postcard"]
    results["selections"]["postcard:paper"] = {"title": "Postcard, the paper's draw", "pictures": 7}
    text = to_latex(results)
    assert "Postcard (7)" in text
    assert "Postcard (20)" not in text


def test_latex_without_sir2_has_one_line_of_heads(results):
    for part in ("selections", "tables", "differences"):
        results[part] = {key: results[part][key] for key in ("real20", "average")}
    assert "SIR" not in to_latex(results)
    assert r"\multicolumn{2}{c}{Real20 (20)}" in to_latex(results)


def test_csv_has_a_line_for_every_mean_and_every_difference(results):
    rows = list(csv.DictReader(io.StringIO(to_csv(results))))
    assert len(rows) == 6 * (4 + 2)
    first = rows[0]
    assert (first["set"], first["method"], first["metric"], first["mean"]) == (
        "real20",
        "doing nothing",
        "psnr",
        "20.0",
    )
    assert [row["than"] for row in rows if row["set"] == "average"].count("doing nothing") == 2


def test_a_method_that_failed_somewhere_is_never_the_best(results):
    results["tables"]["real20"] = {
        "doing nothing": {"psnr": entry(20.0), "lpips": entry(0.2)},
        "A_b|c": {"psnr": entry(21.5, count=10), "lpips": entry(0.1, count=10)},
    }
    text = to_latex(results)
    assert r"21.50$^\dagger$" in text
    assert best_mean(results["tables"]["real20"], "psnr", METRICS["psnr"]) is None
    results["tables"]["real20"]["third"] = {"psnr": entry(19.0)}
    assert best_mean(results["tables"]["real20"], "psnr", METRICS["psnr"]) == "20.00"

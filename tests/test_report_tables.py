"""Tables of results with known numbers."""

import csv
import io
import re

import pytest

from brewster.evaluate.report.tables import (
    read_published,
    tables_to_markdown,
    to_csv,
    to_latex,
    to_markdown,
    to_terminal,
)
from known_results import METRICS, entry, known_results


@pytest.fixture
def results():
    return known_results()


def test_markdown_shows_means_intervals_and_paired_differences(results):
    text = to_markdown(results)
    assert "20.00 (18.50 to 21.25)" in text
    assert "+1.50 (-0.25 to +3.00), better on 15 of 20" in text
    assert "21.50 / 0.123" in text


def test_all_lines_of_a_table_have_the_same_number_of_cells_with_any_names(results):
    for block in re.findall(r"(?:^\|.*\n)+", tables_to_markdown(results), re.M):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1


def test_a_method_with_errors_shows_the_number_of_scored_images(results):
    row = {"psnr": entry(21.5, count=19)}
    results["tables"]["real20"] = {"input (unprocessed)": {"psnr": entry(20.0)}, "A_b|c": row}
    assert "21.50 / - (0 to 19 of 20)" in to_markdown(results)
    assert "| 21.50, 19 of 20 " in to_markdown(results)


def test_csv_has_a_line_for_every_mean_and_every_difference(results):
    rows = list(csv.DictReader(io.StringIO(to_csv(results))))
    assert len(rows) == 6 * (4 + 2)
    first = [rows[0][name] for name in ("set", "method", "metric", "mean")]
    assert first == ["real20", "input (unprocessed)", "psnr", "20.0"]
    assert [row["reference"] for row in rows if row["set"] == "average"].count("input (unprocessed)") == 2


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_the_tables_fit_the_terminal(results, width):
    results["metrics"] = {f"psnr{i}": METRICS["psnr"] for i in range(12)}
    name = "a method with a name of many words, quality draft"
    results["methods"] = {"input (unprocessed)": {}, name: {}, f"{name} 2": {}}
    row = {f"psnr{i}": entry(20.0 + i, low=18.0, high=21.0) for i in range(12)}
    results["tables"] = {key: dict.fromkeys(results["methods"], row) for key in results["tables"]}
    text = to_terminal(results, width)
    assert max(map(len, text.splitlines())) <= width
    for i in range(12):
        assert f"{20 + i}.00" in text
    assert "18.00" not in text
    assert "31.00 (18.00 to 21.00)" in to_terminal(results, width, intervals=True)
    shown = [line for line in text.splitlines() if line.startswith("a me")]
    assert len({re.split(" {2,}", line)[0] for line in shown}) == 2  # shortened names stay different


def test_the_latex_table_has_the_papers_layout(results):
    text = to_latex(results)
    assert r"\begin{tabular}{l|cc|cc|cc|cc|cc|cc}" in text
    assert r"A\_b|c & \textbf{21.50} & \textbf{0.123}" in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    spans = [sum(int(n) - 1 for n in re.findall(r"multicolumn\{(\d+)\}", line)) for line in body]
    assert [span + line.count("&") for span, line in zip(spans, body, strict=True)] == [12] * 4


def test_the_best_three_are_marked_but_not_the_worst(results):
    means = {"A_b|c": 21.5, "input (unprocessed)": 20.0, "third": 19.0, "fourth": 18.0, "equal": 18.0}
    results["methods"] = {key: {} for key in means}
    table = {name: {"psnr": entry(mean)} for name, mean in means.items()}
    results["tables"] = dict.fromkeys(results["tables"], table)
    text = to_latex(results)
    assert r"A\_b|c & \textbf{21.50}" in text
    assert r"input (unprocessed) & \underline{20.00}" in text
    assert r"third & \uuline{19.00}" in text
    assert all(f"{name} & 18.00" in text for name in ("fourth", "equal"))


def test_a_mean_over_fewer_images_has_a_dagger_and_no_mark(results):
    assert "dagger" not in to_latex(results)
    results["tables"]["real20"] = {
        "input (unprocessed)": {"psnr": entry(20.0), "lpips": entry(0.2)},
        "A_b|c": {"psnr": entry(21.5, count=10), "lpips": entry(0.1, count=10)},
    }
    text = to_latex(results)
    assert r"A\_b|c & 21.50$^\dagger$" in text
    assert r"\multicolumn{13}{l}{$^\dagger$ mean over fewer images" in text


@pytest.mark.parametrize(
    "names", [["psnr_channels", "ssim"], ["psnr", "ssim_clipped", "lpips", "psnr_region"]]
)
def test_requested_metrics_are_in_the_table_and_in_the_overview(results, names):
    results["metrics"] = {name: results["metrics"]["psnr"] | {"title": name.upper()} for name in names}
    titles = [name.upper() for name in names[:3]]
    assert " & ".join(f"{title}$\\uparrow$" for title in titles) in to_latex(results)
    assert to_markdown(results).startswith(" / ".join(f"{title}, dB ↑" for title in titles) + "\n")


IMAGE_COUNTS = {"real20": 20, "nature20": 20, "postcard20": 20, "solidobject20": 20, "wildscene101": 101}
ROWS = read_published()
AVERAGED = [row for row in ROWS if "average181" in row.scores]


@pytest.mark.parametrize("row", AVERAGED, ids=lambda row: f"{row.copied_from[:7]} {row.method}")
def test_a_printed_average_is_the_mean_weighted_by_the_numbers_of_images(row):
    for metric, average in row.scores["average181"].items():
        mean = sum(count * float(row.scores[name][metric]) for name, count in IMAGE_COUNTS.items()) / 181
        digits = len(average.partition(".")[2])
        assert abs(mean - float(average)) <= 0.5001 * 10**-digits, metric

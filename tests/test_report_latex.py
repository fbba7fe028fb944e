"""The LaTeX table of results with known numbers."""

import re

import pytest

from brewster.evaluate.report.latex import to_latex
from brewster.evaluate.report.tables import to_markdown
from known_results import entry, known_results


@pytest.fixture
def results():
    return known_results()


def test_the_table_has_the_papers_layout(results):
    text = to_latex(results)
    assert r"\begin{tabular}{l|cc|cc|cc|cc|cc|cc}" in text
    assert r"\multicolumn{6}{c|}{SIR$^2$ (60)}" in text
    assert r"\cline{6-11}" in text
    assert r"A\_b|c & \textbf{21.50} & \textbf{0.123}" in text
    body = [line for line in text.splitlines() if line.endswith(r"\\")]
    widths = [
        sum(int(n) - 1 for n in re.findall(r"multicolumn\{(\d+)\}", line)) + line.count("&") for line in body
    ]
    assert widths == [12] * 5


def test_the_best_three_are_marked_but_not_the_worst(results):
    means = {"A_b|c": 21.5, "input (unprocessed)": 20.0, "third": 19.0, "fourth": 18.0, "equal": 18.0}
    results["methods"] = {key: {} for key in means}
    results["tables"] = {
        key: {name: {"psnr": entry(mean)} for name, mean in means.items()} for key in results["tables"]
    }
    text = to_latex(results)
    assert r"A\_b|c & \textbf{21.50}" in text
    assert r"input (unprocessed) & \underline{20.00}" in text
    assert r"third & \uuline{19.00}" in text
    assert "fourth & 18.00" in text
    assert "equal & 18.00" in text


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

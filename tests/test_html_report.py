import base64
import json
import re
import weakref
from copy import deepcopy
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from brewster.errors import OutputError
from brewster.evaluate.report.html_report import write_report
from brewster.evaluate.report.images import (
    COLOUR_MAP,
    MAX_ERROR,
    MAX_SIDE_PX,
    CaseImages,
    error_map,
    to_thumbnails,
)
from brewster.photo import Photo

VOID = {"meta", "img", "input", "br", "link"}


class Page(HTMLParser):
    """The elements of a page as (tag, attributes), its visible text, and its scripts; refuses tags that do not match."""

    def __init__(self, source):
        super().__init__()
        self.elements, self.text, self.scripts, self.open = [], "", [], []
        self.feed(source)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        assert len(attrs) == len(dict(attrs))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] == ["script"]:
            self.scripts.append(data)
        elif self.open[-1:] != ["style"]:
            self.text += data

    def all(self, tag, **wanted):
        return [has for name, has in self.elements if name == tag and wanted.items() <= has.items()]

    def data(self):
        return json.loads(self.scripts[0])


def metric(title="PSNR", *, unit="dB", higher=True, digits=2):
    about = f"Definition of {title}."
    return {"title": title, "unit": unit, "higher_is_better": higher, "digits": digits, "definition": about}


def estimate(mean, low=None, high=None, count=2):
    return {"mean": mean, "low": low, "high": high, "count": count}


def results(names=("a", "b"), method="compact", errors=None):
    scores = {
        "input (unprocessed)": {"psnr": 20.0, "psnr_region": None},
        method: {"psnr": 21.5, "psnr_region": None},
    }
    pictures = [
        {"benchmark": "nature20", "name": name, "scene": name, "width": 60, "height": 40}
        | {"region_share": 0.25, "scores": scores, "errors": errors or {}}
        for name in names
    ]
    table = {
        "input (unprocessed)": {"psnr": estimate(20.0, 19, 21)},
        method: {"psnr": estimate(21.5, 20, 23)},
    }
    change = {"method": method, "reference": "input (unprocessed)", "metric": "psnr", "improved_count": 2}
    return {
        "brewster": "0.1.0",
        "protocol": {
            "size": "native",
            "quality": "standard",
            "region_thresholds": [0.1],
            "choices": ["Nothing is resized."],
        },
        "metrics": {"psnr": metric(), "psnr_region": metric("PSNR in the region")},
        "benchmarks": {
            "nature20": {"title": "Nature20", "cases": len(names), "expected": [20]}
            | {"remarks": ["found 2 images, expected 20"], "excluded": ["c.png has no partner"]}
        },
        "unavailable": {},
        "unmeasured": [],
        "selections": {
            "nature20": {"title": "Nature20", "cases": len(names)},
            "average": {"title": "Average", "cases": len(names)},
        },
        "methods": {"input (unprocessed)": {"kind": "baseline"}, method: {"kind": "model", "sha256": "7adb"}},
        "cases": pictures,
        "tables": {"nature20": table, "average": deepcopy(table)},
        "differences": {"nature20": [change | estimate(1.5, 0.5, 2.5)]},
    }


def make_thumbnails(name="a", method="compact", size=(40, 60), **changes):
    photo = np.full((*size, 3), 90, np.uint8)
    photo[: size[0] // 2] = 200  # bright at the top, dark at the bottom, so that the orientation is visible
    region = np.zeros(size, bool)
    region[: size[0] // 2] = True
    given = {"photo": photo, "ground_truth": photo // 2, "region": region, "predictions": {method: photo}}
    images = CaseImages("nature20", name, **(given | {"reflections": {method: photo // 4}} | changes))
    return to_thumbnails(images)


@pytest.fixture
def page(tmp_path):
    """Writes a report and reads it."""

    def page(given=None, cases=None):
        path = tmp_path / "report.html"
        write_report(given or results(), cases or [make_thumbnails("a"), make_thumbnails("b")], path)
        return Page(path.read_text("utf-8"))

    return page


def pictures(page):
    """Returns alternative text -> decoded image, for each embedded image."""
    images = {}
    for image in page.all("img"):
        media_type, data = image["src"].split(";base64,")
        photo = images[image["alt"]] = Photo.open(base64.b64decode(data))
        assert media_type == f"data:image/{photo.file_info.format_name}"
    return images


# --- the page


def test_the_page_does_not_load_other_files(page, tmp_path):
    made, source = page(), (tmp_path / "report.html").read_text()
    assert "http" not in re.sub(r"http-equiv", "", source)
    assert not made.all("link")
    assert not re.search(r"\bimport\b|@import|url\(", source)
    assert all("src" not in has for has in made.all("script"))
    policy = made.all("meta", **{"http-equiv": "Content-Security-Policy"})[0]["content"]
    assert "default-src 'none'" in policy
    assert "img-src data:" in policy


def test_every_case_and_method_appears_with_scores_and_differences(page):
    made = page()
    assert [has["data-name"] for has in made.all("article")] == ["a", "b"]
    for text in (
        "photo, input (unprocessed)",
        "compact",
        "21.50",
        "+1.50 ▲",
        "reflection region 25%",
        "60 \N{MULTIPLICATION SIGN} 40 px",
        "Nature20",
        "on 2 images of 1 benchmark: original size, quality",
    ):
        assert text in made.text
    assert made.data()["scores"][1]["compact"] == {"psnr": 21.5, "psnr_region": None}


def test_every_image_has_a_button_and_an_alternative_text(page):
    black = np.zeros((40, 60, 3), np.uint8)
    made = page(cases=[make_thumbnails("a", reflections={"": black, "compact": black})])
    kinds = [has["data-kind"] for has in made.all("button", type="button") if "data-kind" in has]
    assert len(kinds) == len(made.all("img")) == 8
    assert [has["alt"] for has in made.all("img")] == [
        "photo, a",
        "error of the photo, a",
        "ground truth, a",
        "reflection region, a",
        "ground truth of the reflection, a",
        "compact, a",
        "error of compact, a",
        "reflection by compact, a",
    ]


def test_controls_have_labels_and_scrolling_areas_can_have_the_keyboard_focus(page):
    made = page()
    assert len(made.all("label")) == len(made.all("select")) + len(made.all("input"))
    scrolling = [has for has in made.all("div") if has.get("class") == "scroll"]
    assert all(has["tabindex"] == "0" and has["aria-label"] for has in scrolling)


def test_the_same_input_gives_the_same_bytes(tmp_path):
    for name in ("one", "two"):
        write_report(results(), iter([make_thumbnails("a"), make_thumbnails("b")]), tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


@pytest.mark.parametrize(
    "name",
    ["<script>alert(1)</script>", "\"&' onerror=alert(1) ", "<!--data-->", "</article>", "\udcff", "ä/日本"],
)
def test_names_with_markup_are_escaped(page, name):
    given = results([name], method=name, errors={name: name})
    given["benchmarks"]["nature20"] |= {"title": name, "remarks": [name], "excluded": [name]}
    given["metrics"]["psnr"] |= {"title": name, "definition": name}
    made, plain = (
        page(given, [make_thumbnails(name, name)]),
        page(results(["a"], errors={"compact": "a"}), [make_thumbnails("a")]),
    )
    assert [tag for tag, _ in made.elements] == [tag for tag, _ in plain.elements]
    assert [set(has) for _, has in made.elements] == [set(has) for _, has in plain.elements]
    assert made.all("article")[0]["data-name"] == name.replace("\udcff", "?")
    assert made.data()["methods"] == ["input (unprocessed)", name]


# --- numbers


def test_the_best_mean_of_a_column_has_a_star(page):
    assert re.search(r"input \(unprocessed\)\s*20.00", page().text)
    assert re.search(r"★ best 21.50\s*20.00 to 23.00", page().text)


def test_equal_best_means_all_have_a_star(page):
    given = results()
    given["tables"]["nature20"]["compact"]["psnr"]["mean"] = 20.001
    assert page(given).text.count("★ best 20.00") == 2


def test_if_lower_is_better_the_lowest_mean_is_the_best_and_an_increase_is_worse(page):
    given = results()
    given["metrics"]["psnr"]["higher_is_better"] = False
    text = page(given).text
    assert "★ best 20.00" in text
    assert "▼ worse: +1.50" in text
    assert "+1.50 ▼worse" in text


def test_a_difference_whose_interval_contains_zero_is_inconclusive(page):
    given = results()
    given["differences"]["nature20"][0] |= {"low": -0.5}
    assert "inconclusive: +1.50\N{MINUS SIGN}0.50 to +2.502 of 2" in page(given).text


def test_differences_between_methods_are_separate_from_those_to_the_baseline(page):
    given = results()
    row = given["differences"]["nature20"][0]
    given["methods"]["RDNet"] = {"kind": "predictions"}
    given["differences"]["nature20"].append(
        row | {"method": "RDNet", "reference": "compact", "low": -3, "high": -1, "mean": -2}
    )
    text = page(given).text
    assert "RDNet minus compact▼ worse: \N{MINUS SIGN}2.00" in text
    assert "Differences between methods" in text
    assert "Differences between methods" not in page().text


def test_a_missing_score_is_a_dash_and_a_metric_without_scores_has_no_column(page):
    given = results()
    assert "PSNR in the region" in page(given).text  # its definition is still listed
    assert "PSNR in the region dB" not in page(given).text
    given["cases"][0]["scores"]["compact"] = {"psnr": None, "psnr_region": None}
    given["tables"]["nature20"]["compact"]["psnr"] = None
    assert re.search("compact\\s*\N{EN DASH}", page(given).text)


def test_an_estimate_over_fewer_pictures_shows_their_number_and_may_have_no_interval(page):
    given = results()
    given["tables"]["nature20"]["compact"]["psnr"] = estimate(21.5, count=1)
    text = page(given).text
    assert "21.501 of 2" in text
    assert "★ best 21.501 of 2" not in text


def test_settings_metrics_remarks_and_excluded_files_are_listed(page):
    text = page().text
    for expected in (
        "Nothing is resized.",
        "Definition of PSNR. (higher is better)",
        "found 2 images, expected 20",
    ):
        assert expected in text
    assert "1 file excluded" in text
    assert "c.png has no partner" in text
    assert "sha256 7adb" in text
    assert "No method failed on any image." in text
    given = results()
    given["methods"]["compact"]["remark"] = "the predictions equal the ground truth for 2 images"
    assert "compact: the predictions equal the ground truth" in page(given).text


def test_errors_are_listed_at_the_top_and_at_their_case(page):
    given = results()
    given["cases"][0] |= {
        "scores": {"input (unprocessed)": {"psnr": 20.0}},
        "errors": {"compact": "no prediction"},
    }
    made = page(given, [make_thumbnails("a", predictions={}, reflections={}), make_thumbnails("b")])
    assert "Failed: compact on 1 of 2 images" in made.text
    assert "nature20/a, compact: no prediction" in made.text
    assert "Failed: no prediction" in made.text
    assert "compact, a" not in [has["alt"] for has in made.all("img")]


def test_a_long_list_of_errors_is_collapsed(page):
    given = results([f"{number}" for number in range(9)], errors={"compact": "no prediction"})
    made = page(given, [make_thumbnails("0")])
    assert "Failed: compact on 9 of 9 images" in made.text
    assert [has for has in made.all("details") if has.get("class") == "note" and "open" not in has]
    assert (
        "This page shows 1 of 9 images: for each benchmark, first the images on which the first method after the baseline failed"
        in made.text
    )


# --- pictures


@pytest.mark.parametrize(
    ("size", "embedded"),
    [((40, 60), (60, 40)), ((600, 1200), (480, 240)), ((960, 320), (160, 480)), ((1, 2000), (480, 1))],
)
def test_images_are_downscaled_to_480_px_and_never_enlarged(page, size, embedded):
    made = page(cases=[make_thumbnails("a", size=size)])
    assert {photo.size for photo in pictures(made).values()} == {embedded}
    assert {(has["width"], has["height"]) for has in made.all("img")} == {tuple(map(str, embedded))}
    assert max(embedded) <= MAX_SIDE_PX


def test_images_keep_their_orientation_and_their_values(page):
    photo = pictures(page(cases=[make_thumbnails("a", size=(700, 500))]))["photo, a"].pixels
    assert abs(photo[:200].astype(int) - 200).max() <= 6
    assert abs(photo[-200:].astype(int) - 90).max() <= 6


def test_images_are_downscaled_like_photo_resized(page, rng):
    photo = rng.integers(0, 255, (501, 733, 3)).astype(np.uint8)
    expected = Photo.from_array(Photo.from_array(photo, encoding="srgb").resized(480, 328), encoding="linear")
    made = pictures(page(cases=[make_thumbnails("a", size=(501, 733), photo=photo)]))["photo, a"]
    expected = Photo.from_array(expected.srgb_8bit(), encoding="srgb")
    info = replace(expected.file_info, jpeg_quality=90)
    difference = abs(
        made.pixels.astype(int) - Photo.open(replace(expected, file_info=info).encode("jpeg")).pixels
    )
    assert difference.mean() < 1  # from rounding; averages of encoded values would differ by about 10


def test_the_overlay_is_coloured_inside_the_region_and_transparent_outside(page):
    tint = pictures(page(cases=[make_thumbnails("a", size=(800, 600))]))["reflection region, a"]
    assert tint.alpha[:239].min() > 50
    assert tint.alpha[241:].max() == 0


def test_an_error_map_has_the_colour_of_the_largest_channels_difference():
    truth = np.zeros((4, 4, 3), np.uint8)
    prediction = truth.copy()
    prediction[0, 0] = (0, MAX_ERROR // 2, 3)
    prediction[0, 1] = 255
    colours = error_map(prediction, truth)
    assert (colours[0, 0] == COLOUR_MAP[len(COLOUR_MAP) // 2]).all()
    assert (colours[0, 1] == COLOUR_MAP[-1]).all()
    assert (colours[1:] == COLOUR_MAP[0]).all()
    assert (error_map(truth, prediction) == colours).all()


def test_a_downscaled_error_map_averages_the_errors():
    truth = np.zeros((960, 960, 3), np.uint8)
    prediction = truth.copy()
    prediction[::2] = 48  # every other row, so the mean error is 24
    assert (error_map(prediction, truth) == COLOUR_MAP[24 * len(COLOUR_MAP) // MAX_ERROR]).all()


def test_error_maps_are_embedded_losslessly(page, rng):
    truth, photo = rng.integers(0, 255, (2, 40, 60, 3)).astype(np.uint8)
    made = pictures(page(cases=[make_thumbnails("a", photo=photo, ground_truth=truth)]))
    assert (made["error of the photo, a"].pixels == error_map(photo, truth)).all()


def test_the_lightness_of_the_colour_map_increases():
    lightness = np.sqrt(COLOUR_MAP.astype(float) @ (0.2126, 0.7152, 0.0722))
    assert (np.diff(lightness) > 0).all()


# --- the file


def test_cases_are_read_and_freed_one_at_a_time(tmp_path):
    alive = []

    def cases():
        for number in range(6):
            assert sum(case() is not None for case in alive) <= 1  # the case that was just written
            case = make_thumbnails(f"{number}")
            alive.append(weakref.ref(case))
            yield case
            del case

    write_report(results(), cases(), tmp_path / "report.html")
    assert len(alive) == 6


def test_a_report_replaces_an_older_one_atomically(tmp_path):
    def broken():
        yield make_thumbnails("a")
        raise ValueError

    path = tmp_path / "new" / "report.html"
    write_report(results(), [make_thumbnails("a")], path)
    before = path.read_bytes()
    with pytest.raises(ValueError):  # noqa: PT011
        write_report(results(), broken(), path)
    assert path.read_bytes() == before
    write_report(results(), [make_thumbnails("b")], path)
    assert path.read_bytes() != before
    assert [file.name for file in path.parent.iterdir()] == ["report.html"]


def test_a_path_that_cannot_be_written_is_an_error_that_names_it(tmp_path):
    (tmp_path / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html was not written \(.*\); .* run again"):
        write_report(results(), [make_thumbnails("a")], tmp_path / "report.html")
    assert not list(tmp_path.glob(".brewster-*"))


def test_a_case_that_is_not_in_the_results_is_shown_without_scores(page):
    assert page(cases=[make_thumbnails("unknown")]).data()["scores"] == [{}]

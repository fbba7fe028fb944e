import base64
import json
import re
from copy import deepcopy
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from brewster.evaluation.benchmarks.image_files import Case, ImageFile
from brewster.evaluation.methods import MethodOutput
from brewster.evaluation.report.html_report import write_report
from brewster.evaluation.report.images import COLOUR_MAP, MAX_ERROR, error_map, to_thumbnails
from brewster.evaluation.scoring import GroundTruth
from brewster.photo import Photo
from known_results import entry, metric

VOID = {"meta", "img", "input", "br", "link"}


class Page(HTMLParser):
    """The elements of a page as (tag, attributes), and its visible text; refuses tags that do not
    match.
    """

    def __init__(self, source):
        super().__init__()
        self.elements = []
        self.text = ""
        self.open = []
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
        if self.open[-1:] not in (["script"], ["style"]):
            self.text += data

    def all(self, tag, **wanted):
        return [has for name, has in self.elements if name == tag and wanted.items() <= has.items()]

    def scores(self):
        return [json.loads(has["data-scores"]) for has in self.all("article")]


def results(names=("a", "b"), method="compact", errors=None):
    psnrs = {"input (unprocessed)": 20.0, method: 21.5}
    scores = {name: {"psnr": psnr, "psnr_region": None} for name, psnr in psnrs.items()}
    pictures = [
        {"benchmark": "nature20", "name": name, "scene": name, "width": 60, "height": 40}
        | {"region_share": 0.25, "scores": scores, "errors": errors or {}}
        for name in names
    ]
    table = {name: {"psnr": entry(psnr, 2, psnr - 1, psnr + 1)} for name, psnr in psnrs.items()}
    change = {
        "method": method,
        "reference": "input (unprocessed)",
        "metric": "psnr",
        "improved_count": 2,
    }
    return {
        "brewster": "0.1.0",
        "protocol": {
            "size": "native",
            "quality": "standard",
            "region_thresholds": [0.1],
            "choices": [],
        },
        "metrics": {"psnr": metric(), "psnr_region": metric("PSNR in the region")},
        "benchmarks": {
            "nature20": {"title": "Nature20", "cases": len(names), "expected": [20]}
            | {"remarks": ["found 2 images, expected 20"], "excluded": ["c.png has no partner"]}
        },
        "unavailable": {},
        "unmeasured": [],
        "selections": {
            key: {"title": key.title(), "cases": len(names)} for key in ("nature20", "average")
        },
        "methods": {
            "input (unprocessed)": {"kind": "baseline"},
            method: {"kind": "model", "sha256": "7adb"},
        },
        "cases": pictures,
        "tables": {"nature20": table, "average": deepcopy(table)},
        "differences": {"nature20": [change | entry(1.5, 2, 0.5, 2.5)]},
    }


def make_thumbnails(name="a", methods=("compact",), size=(40, 60), **changes):
    photo = np.full((*size, 3), 90, np.uint8)
    photo[: size[0] // 2] = (
        200  # bright at the top, dark at the bottom, so that the orientation is visible
    )
    region = np.zeros(size, bool)
    region[: size[0] // 2] = True
    images = {"photo": photo, "transmission": photo // 2} | changes
    output = MethodOutput(
        *(Photo.from_array(layer, encoding="srgb") for layer in (photo, photo // 4))
    )
    case = Case("nature20", name, name, name, ImageFile(Path()), ImageFile(Path()))
    truth = GroundTruth(case, Photo.from_array(images["photo"], encoding="srgb"), images)
    return to_thumbnails(truth, dict.fromkeys(methods, output), region, lambda *_: "")


@pytest.fixture
def page(tmp_path):
    """Writes a report and reads it."""

    def page(given=None, cases=None):
        path = tmp_path / "report.html"
        write_report(
            given or results(), cases or [make_thumbnails("a"), make_thumbnails("b")], path
        )
        return Page(path.read_text("utf-8"))

    return page


def pictures(page):
    """Returns alternative text -> decoded image, for each embedded image."""
    images = {}
    for image in (image for image in page.all("img") if "src" in image):
        media_type, data = image["src"].split(";base64,")
        photo = images[image["alt"]] = Photo.open(base64.b64decode(data))
        assert media_type == f"data:image/{photo.file_info.format_name}"
    return images


def test_the_page_does_not_load_other_files(page, tmp_path):
    made = page()
    source = (tmp_path / "report.html").read_text()
    assert "http" not in re.sub(r"http-equiv", "", source)
    assert not made.all("link")
    assert not re.search(r"\bimport\b|@import|url\(", source)
    assert all("src" not in has for has in made.all("script"))
    policy = made.all("meta", **{"http-equiv": "Content-Security-Policy"})[0]["content"]
    assert "default-src 'none'" in policy
    assert "img-src data:" in policy


@pytest.mark.parametrize(
    "name",
    [
        "<script>alert(1)</script>",
        "\"&' onerror=alert(1) ",
        "<!--data-->",
        "</article>",
        "\udcff",
        "ä/日本",
    ],
)
def test_names_with_markup_are_escaped(page, name):
    given = results([name], method=name, errors={name: name})
    given["benchmarks"]["nature20"] |= {"title": name, "remarks": [name], "excluded": [name]}
    given["metrics"]["psnr"] |= {"title": name, "definition": name}
    made = page(given, [make_thumbnails(name, [name])])
    plain = page(results(["a"], errors={"compact": "a"}), [make_thumbnails("a")])
    assert [tag for tag, _ in made.elements] == [tag for tag, _ in plain.elements]
    assert [set(has) for _, has in made.elements] == [set(has) for _, has in plain.elements]
    assert made.all("article")[0]["data-name"] == name.replace("\udcff", "?")
    assert set(made.scores()[0]) == {"input (unprocessed)", name}


def test_errors_are_listed_at_the_top_and_at_their_case(page):
    given = results()
    scores = {"input (unprocessed)": {"psnr": 20.0}}
    given["cases"][0] |= {"scores": scores, "errors": {"compact": "no prediction"}}
    made = page(given, [make_thumbnails("a", []), make_thumbnails("b")])
    assert "Failed: compact on 1 of 2 images" in made.text
    assert "Failed: no prediction" in made.text
    assert "compact, a" not in [has["alt"] for has in made.all("img")]


@pytest.mark.parametrize(
    ("size", "embedded"),
    [
        ((40, 60), (60, 40)),
        ((600, 1200), (480, 240)),
        ((960, 320), (160, 480)),
        ((1, 2000), (480, 1)),
    ],
)
def test_images_are_downscaled_to_480_px_and_never_enlarged(page, size, embedded):
    made = page(cases=[make_thumbnails("a", size=size)])
    assert {photo.size for photo in pictures(made).values()} == {embedded}
    sizes = {(has["width"], has["height"]) for has in made.all("img") if "src" in has}
    assert sizes == {tuple(map(str, embedded))}


def test_images_are_downscaled_like_photo_resized(page, rng):
    photo = rng.integers(0, 255, (501, 733, 3)).astype(np.uint8)
    expected = Photo.from_array(
        Photo.from_array(photo, encoding="srgb").resized(480, 328), encoding="linear"
    )
    made = pictures(page(cases=[make_thumbnails("a", size=(501, 733), photo=photo)]))["photo, a"]
    expected = Photo.from_array(expected.srgb_8bit(), encoding="srgb")
    info = replace(expected.file_info, jpeg_quality=90)
    expected = Photo.open(replace(expected, file_info=info).encode("jpeg"))
    difference = abs(made.pixels.astype(int) - expected.pixels)
    assert (
        difference.mean() < 1
    )  # from rounding; averages of encoded values would differ by about 10


def test_the_reflection_region_is_tinted_in_the_photo(page):
    images = pictures(page(cases=[make_thumbnails("a", size=(800, 600))]))
    tint = abs(images["reflection region, a"].pixels.astype(int) - images["photo, a"].pixels).max(
        axis=2
    )
    assert tint[:235].min() > 50
    assert tint[245:].max() < 10


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
    made = pictures(page(cases=[make_thumbnails("a", photo=photo, transmission=truth)]))
    assert (made["error of the photo, a"].pixels == error_map(photo, truth)).all()


def test_cases_are_sorted_and_filtered_and_an_image_is_compared_with_another(chromium, tmp_path):
    given = results()
    scores = {"input (unprocessed)": 10.0, "compact": 11.0}
    worse = {name: {"psnr": value, "psnr_region": None} for name, value in scores.items()}
    given["cases"][1]["scores"] = worse
    write_report(given, [make_thumbnails("a"), make_thumbnails("b")], tmp_path / "report.html")
    page = chromium.new_page()
    failures = []
    page.on("pageerror", lambda error: failures.append(error))  # noqa: PLW0108  (playwright marks its handlers)
    page.goto((tmp_path / "report.html").as_uri())
    names = page.locator("article:visible h3")
    assert names.all_text_contents() == ["b", "a"]  # worst first
    page.get_by_label("order").select_option("best first")
    assert names.all_text_contents() == ["a", "b"]
    page.get_by_label("Name contains").fill("B")
    assert names.all_text_contents() == ["b"]
    page.get_by_role("button", name="compact, b", exact=True).click()
    page.get_by_label("Left of the line").select_option("ground truth")
    page.get_by_label("Position of the line").fill("25")
    assert page.locator("dialog h2").text_content() == "b: compact"
    after, before = page.locator("dialog img").all()
    embedded = page.locator("article[data-name=b] img")
    assert after.get_attribute("src") == embedded.nth(4).get_attribute("src")
    assert before.get_attribute("src") == embedded.nth(2).get_attribute("src")
    assert before.evaluate("image => getComputedStyle(image).clipPath") == "inset(0px 75% 0px 0px)"
    page.keyboard.press("Escape")
    assert not page.locator("dialog").is_visible()
    page.close()
    assert not failures

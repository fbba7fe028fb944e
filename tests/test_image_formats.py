"""The table of image formats agrees with the type of format names and with the page."""

import re
from pathlib import Path

import pytest

from brewster import image_formats
from brewster.image_formats import FORMATS, SUFFIXES, format_of

PAGE = Path(image_formats.__file__).parent / "web" / "page" / "index.html"


@pytest.mark.parametrize(("name", "expected"), [("a.JPG", "jpeg"), ("a.b.tif", "tiff"), ("a.gif", "gif")])
def test_the_format_of_a_file_name_is_that_of_its_suffix(name, expected):
    assert format_of(Path(name)).name == expected


@pytest.mark.parametrize("name", ["a", "a.txt", ".png"])
def test_other_suffixes_have_no_format(name):
    assert format_of(Path(name)) is None


def test_exactly_the_formats_of_libvips_have_a_name_there():
    for row in FORMATS.values():
        uses_libvips = row.library == "libvips"
        assert (row.vips_name is not None) == uses_libvips


def test_the_page_accepts_every_suffix_of_an_image():
    """The page also sorts the files of a dropped folder by this list."""
    (accepted,) = re.findall(r'accept="image/\*,([^"]*)"', PAGE.read_text())
    assert set(accepted.split(",")) == set(SUFFIXES)

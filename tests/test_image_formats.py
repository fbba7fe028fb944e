"""The table of image formats agrees with the type of format names and with the page."""

import re
from pathlib import Path
from typing import get_args

import pytest

from brewster import image_formats
from brewster.image_formats import FORMATS, SUFFIXES, WRITABLE, FormatName, format_of

PAGE = Path(image_formats.__file__).parent / "web" / "page" / "index.html"


def test_the_type_of_format_names_has_the_names_of_the_table():
    assert get_args(FormatName) == tuple(WRITABLE)


def test_each_suffix_and_each_mime_type_belongs_to_one_format():
    assert len(SUFFIXES) == sum(len(row.suffixes) for row in FORMATS.values())
    assert len({row.mime_type for row in FORMATS.values()}) == len(FORMATS)


@pytest.mark.parametrize(("name", "expected"), [("a.JPG", "jpeg"), ("a.b.tif", "tiff"), ("a.gif", "gif")])
def test_the_format_of_a_file_name_is_that_of_its_suffix(name, expected):
    assert format_of(Path(name)).name == expected


@pytest.mark.parametrize("name", ["a", "a.txt", ".png"])
def test_other_suffixes_have_no_format(name):
    assert format_of(Path(name)) is None


def test_libvips_formats_have_a_loader_and_the_written_ones_a_saver():
    for row in FORMATS.values():
        uses_libvips = row.library == "libvips"
        assert (row.vips_loader is not None) == uses_libvips
        assert (row.vips_saver is not None) == (uses_libvips and row.is_writable)


def test_the_page_accepts_every_suffix_of_an_image():
    """The page also sorts the files of a dropped folder by this list."""
    (accepted,) = re.findall(r'accept="image/\*,([^"]*)"', PAGE.read_text())
    assert set(accepted.split(",")) == set(SUFFIXES)

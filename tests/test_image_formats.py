"""The table of image formats agrees with the type of format names and with the page."""

import re
from pathlib import Path

from brewster import image_formats
from brewster.image_formats import SUFFIXES

PAGE = Path(image_formats.__file__).parent / "web" / "page" / "index.html"


def test_the_page_accepts_every_suffix_of_an_image():
    """The page also sorts the files of a dropped folder by this list."""
    (accepted,) = re.findall(r'accept="image/\*,video/\*,([^"]*)"', PAGE.read_text())
    assert set(accepted.split(",")) == set(SUFFIXES)

"""The documentation site builds offline and without warnings, and contains every public name of the Python API."""

import os
import sys
from pathlib import Path

import pytest

from other_processes import finished

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Builds the site. Returns its folder."""
    out = tmp_path_factory.mktemp("site")
    process = finished(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
    )
    assert (process.returncode, process.stderr) == (0, "")
    return out


def test_every_page_is_in_the_navigation(site):
    home = (site / "index.html").read_text("utf-8")
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    assert {page for page in pages if f'href="{page}/"' not in home} == set()


def test_pages_request_nothing_from_other_servers(site):
    page = (site / "index.html").read_text("utf-8")
    assert 'src="http' not in page
    assert 'rel="stylesheet" href="http' not in page

"""Helpers for tests of the page in a browser: upload photos, read what is shown, and download
results.
"""

import base64
from pathlib import Path

import numpy as np

from brewster import Photo


def upload(page, *files):
    """Adds files (name, bytes), and waits until all photos are done and the current photo is shown
    or has failed.
    """
    page.set_input_files(
        "#files", [{"name": name, "mimeType": "", "buffer": data} for name, data in files]
    )
    page.wait_for_selector("#photos:not(:has(.waiting, .working)) li")
    page.wait_for_selector("glass-compare:not([hidden]), #error:not([hidden])")
    settle(page)


def settle(page):
    page.evaluate(
        "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )


def wait_until(page, holds):
    """Waits until a condition holds that no event tells; the time limit of the test ends this."""
    while not holds():
        settle(page)


def canvas(page, side):
    """Returns the pixels of one of the two compared images."""
    value = page.evaluate("side => document.querySelector('glass-compare')[side].toDataURL()", side)
    return Photo.open(base64.b64decode(value.partition(",")[2])).pixels


def downloaded(page, press):
    with page.expect_download() as waiting:
        press()
    return waiting.value.suggested_filename, Path(waiting.value.path()).read_bytes()


def difference(one, other):
    assert one.shape == other.shape
    return np.abs(one.astype(int) - other.astype(int))


def names_in_list(page):
    return page.locator("#photos .name").all_inner_texts()


def share(page):
    return int(page.get_by_role("slider", name="Line").get_attribute("aria-valuenow"))

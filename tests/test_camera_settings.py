"""The flash and the exposure of a photo in EXIF."""

import struct

import pytest

from brewster.photo.camera_settings import CameraSettings, camera_settings


def exif(time=(1, 100), f_number=(4, 1), sensitivity=400, flash=0):
    """An EXIF block with the settings of a camera."""
    return (
        struct.pack("<2sHI HHHII I", b"II", 42, 8, 1, 34665, 4, 1, 26, 0)
        + struct.pack("<H", 4)
        + struct.pack("<HHII HHII", 33434, 5, 1, 80, 33437, 5, 1, 88)
        + struct.pack("<HHIHH HHIHH I", 34855, 3, 1, sensitivity, 0, 37385, 3, 1, flash, 0, 0)
        + struct.pack("<4I", *time, *f_number)
    )


@pytest.mark.parametrize(
    ("flash", "has_flash"), [(0, False), (1, True), (0x10, False), (0x19, True)]
)
def test_the_first_bit_says_whether_the_flash_fired(flash, has_flash):
    assert camera_settings(exif(flash=flash)).has_flash is has_flash


def test_the_exposure_is_proportional_to_the_light_of_the_photo():
    base = camera_settings(exif()).exposure
    assert camera_settings(exif(time=(1, 50))).exposure == pytest.approx(2 * base)
    assert camera_settings(exif(f_number=(2, 1))).exposure == pytest.approx(4 * base)
    assert camera_settings(exif(sensitivity=800)).exposure == pytest.approx(2 * base)


@pytest.mark.parametrize("block", [None, b"", b"II*\0", exif()[:60], exif(time=(1, 0))])
def test_broken_settings_are_unknown(block):
    assert camera_settings(block).exposure is None
    assert camera_settings(None) == CameraSettings(None, None)

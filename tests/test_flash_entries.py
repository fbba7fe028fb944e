"""A flash on the way from the settings of the cameras to the layers."""

import numpy as np
import pytest

from brewster.film.light.fit import fit_light
from brewster.film.light.flash import solve_flash
from brewster.film.light.registration import AlignedPhotos
from brewster.photo.camera_settings import CameraSettings
from test_changing_light import flash_photos, noisy

FLASH = CameraSettings(True, 0.8)
NONE = CameraSettings(False, 1.0)
UNKNOWN = CameraSettings(None, None)


def aligned(frames, reference, left_out=()):
    return AlignedPhotos(
        frames=np.stack(frames),
        reference=reference,
        left_out=left_out,
        travel_px=0.0,
        is_still=True,
        has_other_motion=False,
    )


def half(light):
    return 0.5 * light


# The settings are those of all photos, also of those that are left out; reference and pair are
# indices of the photos that are left.
CASES = {
    "the other has the flash": ([FLASH, NONE], (), 1, (1, 0)),
    "the reference has the flash": ([FLASH, NONE], (), 0, (0, 1)),
    "the nearest of two": ([FLASH, NONE, NONE, FLASH], (), 2, (2, 3)),
    "the photo before is left out": ([NONE, FLASH, NONE], (0,), 1, (1, 0)),
    "unknown settings": ([UNKNOWN, FLASH, NONE], (), 2, (2, 1)),
    "an unknown exposure": ([CameraSettings(True, None), NONE], (), 1, (1, 0)),
}


@pytest.mark.parametrize("case", CASES)
def test_the_nearest_photo_with_and_one_without_flash_are_compared(case):
    settings, left_out, reference, pair = CASES[case]
    transmission, (lit, ambient) = flash_photos()
    used = [each for k, each in enumerate(settings) if k not in left_out]
    frames = [
        noisy({True: lit, False: ambient, None: transmission}[each.has_flash], k)
        for k, each in enumerate(used)
    ]
    photos = aligned(frames, reference, left_out)
    light = fit_light(photos, half, settings=settings, is_forced=True).light
    flash = int(used[pair[1]].has_flash)
    compared = photos.frames[list(pair)]
    known = used[pair[flash]].exposure
    exposure = None if known is None else known / used[pair[1 - flash]].exposure
    expected = solve_flash(compared, 0, flash, half(compared[1 - flash]), exposure)
    assert light.kind == "flash"
    np.testing.assert_array_equal(light.layers, expected.layers)


def test_the_reflection_of_a_photo_with_flash_has_its_exposure():
    transmission, photos = flash_photos()
    single = transmission + 0.5 * (photos[1] - transmission)
    layers = solve_flash(photos, 0, 0, single, 0.8).layers
    in_ambient = solve_flash(photos, 1, 0, single, 0.8).layers
    assert layers[1].sum() / in_ambient[1].sum() == pytest.approx(0.8, rel=0.05)

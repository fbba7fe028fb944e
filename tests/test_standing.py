"""A quick look at photos of a camera that stands: what it tells, and the work that it saves."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from brewster.film.light.fit import aligned_photos
from brewster.film.motion.registration.tracks import layer_tracks
from brewster.film.standing import seem_to_stand
from simulated_bursts import linear_pictures
from test_changing_light import cloth_photos, flash_photos, polariser_photos

STANDING = """
from brewster import separate_burst
from test_changing_light import NOTHING, as_photos, polariser_photos
from brewster.film.motion.model.kernels.sampling import darken
separate_burst(as_photos(polariser_photos()[2]), separator=NOTHING)
print(len(darken.signatures))
"""


@pytest.mark.parametrize("photos", [cloth_photos, flash_photos, polariser_photos])
@pytest.mark.parametrize("shift", [0, 8])
def test_a_camera_stands_in_any_light_and_not_if_the_scene_moves(photos, shift):
    frames = [np.roll(frame, shift * k, axis=1) for k, frame in enumerate(photos()[-1])]
    assert seem_to_stand(frames, 0) == (shift == 0)


@pytest.mark.parametrize("shape", [(8, 8, 3), (8, 1000, 3), (750, 1000, 3)])
def test_frames_of_any_size_and_without_any_detail_can_be_looked_at(shape):
    assert seem_to_stand([np.zeros(shape, np.float32)] * 2, 1) in (True, False)


def test_the_motion_of_a_touched_tripod_is_found_in_smaller_copies_of_large_frames():
    transmission, mirrored = linear_pictures((1000, 750))
    turn = np.array([[1, 0.001, 0.6], [-0.001, 1, -0.8]])
    frames = [transmission + 0.3 * mirrored, cv2.warpAffine(transmission, turn, (1000, 750))]
    (track,) = layer_tracks(frames, 0, transmission)[:1]
    corners = np.array([[[0, 0]], [[1000, 0]], [[0, 750]], [[1000, 750]]], np.float64)
    found = cv2.perspectiveTransform(corners, track.motions[1])
    assert np.abs(found - cv2.transform(corners, turn)).max() < 0.6
    assert track.places.max(0)[0] > 700


def test_kernels_of_the_motion_are_not_compiled_for_photos_that_stand():
    done = subprocess.run(
        [sys.executable, "-c", STANDING], capture_output=True, text=True, check=False, cwd="tests"
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == 0


def test_a_mirrored_scene_that_moves_before_one_that_stands_is_seen():
    transmission, mirrored = linear_pictures((320, 240))
    frames = [transmission + 0.3 * np.roll(mirrored, 8 * k, axis=1) for k in range(4)]
    assert seem_to_stand(frames, 2)
    tracks = layer_tracks(frames, 2, transmission)
    aligned = aligned_photos(frames, 2, tracks)
    assert (aligned.is_still, aligned.has_other_motion) == (True, True)

"""The threads of bursts that overlap, as in a server."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import cv2
import pytest

from brewster.film.motion.threads import single_opencv_thread


@pytest.fixture(autouse=True)
def three_threads():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    yield
    cv2.setNumThreads(before)


def test_opencv_has_one_thread_in_a_burst_and_its_own_number_after_it():
    for error in (None, ValueError):
        try:
            with single_opencv_thread(), single_opencv_thread():
                assert cv2.getNumThreads() == 1
                if error:
                    raise error
        except ValueError:
            pass
        assert cv2.getNumThreads() == 3


@pytest.mark.parametrize("first_to_end", [0, 1])
def test_bursts_that_overlap_restore_the_threads_of_opencv(first_to_end):
    begun = [Event(), Event()]
    may_end = [Event(), Event()]

    def burst(index):
        with single_opencv_thread():
            begun[index].set()
            assert may_end[index].wait(10)
            return cv2.getNumThreads()

    with ThreadPoolExecutor(2) as pool:
        bursts = []
        for index in (0, 1):  # the second one begins in the first one
            bursts.append(pool.submit(burst, index))
            assert begun[index].wait(10)
        may_end[first_to_end].set()
        assert bursts[first_to_end].result() == 1
        assert cv2.getNumThreads() == 1  # the other one goes on
        may_end[1 - first_to_end].set()
        assert bursts[1 - first_to_end].result() == 1
    assert cv2.getNumThreads() == 3

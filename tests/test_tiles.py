import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from brewster.separation.tiles import run_tiled, tile_slices


def pointwise_backend(tile):
    return tile * 0.75, tile * 0.25


@given(st.integers(1, 90), st.integers(1, 90), st.integers(9, 40), st.integers(1, 8))
def test_tiling_does_not_change_the_output_of_a_pointwise_backend(height, width, tile, overlap):
    image = np.random.default_rng(height * width).random((height, width, 3), np.float32)
    layers = run_tiled(pointwise_backend, image, tile_px=tile, overlap_px=overlap)
    for layer, whole in zip(layers, pointwise_backend(image), strict=True):
        np.testing.assert_allclose(layer, whole, rtol=1e-5)


def test_no_tile_is_larger_than_requested():
    sizes = set()

    def recording_backend(tile):
        sizes.add(tile.shape)
        return tile, tile

    run_tiled(recording_backend, np.zeros((70, 130, 3), np.float32), tile_px=50, overlap_px=10)
    assert sizes == {(50, 50, 3)}


@given(st.integers(1, 400), st.integers(9, 60), st.integers(1, 8))
def test_tiles_cover_the_image_and_neighbours_overlap(side, tile, overlap):
    rows = [vertical for vertical, _ in tile_slices((side, 1), tile_px=tile, overlap_px=overlap)]
    assert (rows[0].start, rows[-1].stop) == (0, side)
    assert all(row.stop - row.start == min(side, tile) for row in rows)
    assert all(first.stop - second.start >= overlap for first, second in itertools.pairwise(rows))


def test_neighbouring_tiles_are_blended_without_a_seam():
    levels = iter(range(100))

    def grey_by_call(tile):
        return np.full_like(tile, next(levels)), np.zeros_like(tile)

    transmission, _ = run_tiled(
        grey_by_call, np.zeros((20, 100, 3), np.float32), tile_px=40, overlap_px=20
    )
    assert np.abs(np.diff(transmission[0, :, 0])).max() < 0.1


def test_an_image_no_larger_than_a_tile_is_not_tiled():
    calls = []
    image = np.zeros((40, 40, 3), np.float32)
    run_tiled(lambda tile: calls.append(tile) or (tile, tile), image, tile_px=40, overlap_px=8)
    assert len(calls) == 1

"""The Python API: arrays, PIL images, open files, notebooks, many photos, and custom models."""

import io
import threading

import numpy as np
import pytest
from PIL import Image, ImageOps

import brewster
from brewster import Photo, Separation, Separator
from brewster.diffusion.models import DiffusionSource
from brewster.errors import BrewsterError, ModelError, PhotoError, UnreadablePhoto, UnsupportedPhoto
from brewster.photo import FileInfo
from brewster.separation import registry
from brewster.separation.models.zoo import ModelFile
from cli_helpers import image_bytes, write_pane
from picture_files import exif_block, file_of, pil, smooth


def pane(tile):
    return 0.8 * tile, 0.2 * tile


SEPARATOR = Separator(pane)


def test_a_photo_is_an_array_of_its_stored_pixels():
    photo = Photo.from_array(smooth(), encoding="srgb")
    assert np.array_equal(np.asarray(photo), smooth())
    assert np.shares_memory(np.asarray(photo), photo.pixels)
    copy = np.array(photo)
    copy[:] = 0  # an array made with np.array may be changed
    assert np.array_equal(photo.pixels, smooth())
    assert np.asarray(photo, np.float32).dtype == np.float32


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "I;16"])
def test_a_pil_image_is_unchanged_after_conversion_to_a_photo_and_back(mode):
    wide = Image.fromarray(np.arange(64, dtype=np.uint16).reshape(8, 8) * 1000)
    image = wide if mode == "I;16" else Image.fromarray(smooth()).convert(mode)
    again = Photo.open(image).to_pil()
    assert again.mode == mode
    assert np.array_equal(np.asarray(again), np.asarray(image))


@pytest.mark.parametrize(
    ("mode", "transparency"), [("1", 0), ("L", 77), ("RGB", (10, 20, 30)), ("P", 3), ("I;16", 500)]
)
def test_a_transparent_colour_becomes_the_same_alpha_as_in_the_png(mode, transparency):
    levels = np.zeros((8, 8), np.uint16 if mode == "I;16" else np.uint8)
    levels[:4] = 500 if mode == "I;16" else 77
    image = Image.fromarray(levels) if mode == "I;16" else Image.fromarray(levels).convert(mode)
    if mode == "RGB":
        image.putpixel((5, 6), transparency)
    elif mode == "P":
        image.putpixel((5, 6), 3)
    data = file_of(image, "PNG", transparency=transparency)
    expected = Photo.open(data)
    assert expected.alpha is not None
    assert expected.alpha.min() == 0 < expected.alpha.max()
    photo = Photo.from_pil(pil(data))
    assert np.array_equal(photo.alpha, expected.alpha)
    assert np.array_equal(photo.linear(), expected.linear())
    assert photo.pixels.dtype == expected.pixels.dtype


def test_a_pil_image_has_profile_and_exif_and_is_upright():
    photo = Photo.open(file_of(smooth(), "JPEG", exif=exif_block(6)))
    photo = Photo(photo.pixels, None, FileInfo(**{**vars(photo.file_info), "icc": None}))
    image = photo.to_pil()
    assert image.getexif()[271] == "Sextant"
    data = file_of(image, "PNG", exif=image.info["exif"])
    assert np.array_equal(Photo.open(data).pixels, photo.pixels)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_colours_of_more_than_eight_bits_become_a_pil_image_of_eight(dtype):
    array = np.full((4, 4, 3), 0.5 * (65535 if dtype == np.uint16 else 1)).astype(dtype)
    assert np.unique(np.asarray(Photo.from_array(array, encoding="srgb").to_pil())).tolist() in (
        [127],
        [128],
    )


def test_a_notebook_shows_a_photo_and_a_separation_as_small_png():
    photo = Photo.from_array(np.tile(smooth(64, 64), (30, 40, 1)), encoding="srgb")
    shown = pil(photo._repr_png_())
    assert (shown.format, shown.size, shown.mode) == ("PNG", (1024, 768), "RGB")
    small = Photo.from_array(smooth(), encoding="srgb")
    assert np.abs(np.asarray(pil(small._repr_png_())).astype(int) - smooth()).max() <= 1
    assert pil(SEPARATOR(small)._repr_png_()).size == (3 * 64 + 2 * 8, 240)


def test_integers_are_srgb_encoded_by_default_and_floats_need_an_encoding():
    for array in (smooth(), 257 * smooth().astype(np.uint16)):
        expected = SEPARATOR(array, encoding="srgb")
        (result,) = SEPARATOR.many([array])
        transmission, reflection = result
        assert np.array_equal(transmission.pixels, expected.transmission.pixels)
        assert np.array_equal(reflection.pixels, expected.reflection.pixels)
    with pytest.raises(PhotoError, match="float64 is None"):
        SEPARATOR(smooth() / 255)


def test_channels_first_are_refused_with_the_way_out():
    with pytest.raises(UnsupportedPhoto, match=r"array\.transpose\(1, 2, 0\)"):
        SEPARATOR(smooth().transpose(2, 0, 1))
    tensor = pytest.importorskip("torch").zeros(3, 4, 5)
    with pytest.raises(TypeError, match=r"permute\(1, 2, 0\)"):
        Photo.open(tensor)


def test_the_quality_of_lossy_files_can_be_chosen():
    photo = Photo.open(
        file_of(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8), "PNG")
    )
    for format_name in ("jpeg", "webp", "avif"):
        sizes = [len(photo.encode(format_name, quality=quality)) for quality in (30, 95)]
        assert 2 * sizes[0] < sizes[1]
    for format_name, quality in (("png", 95), ("jpeg", 0), ("webp", 101)):
        with pytest.raises(
            UnsupportedPhoto, match=rf"quality={quality} was passed for {format_name}"
        ):
            photo.save(io.BytesIO(), format=format_name, quality=quality)


def test_open_files_are_read_and_written(tmp_path):
    (tmp_path / "a.jpg").write_bytes(image_bytes())
    with (tmp_path / "a.jpg").open("rb") as file:
        photo = Photo.open(file)
    assert np.array_equal(photo.pixels, Photo.open(tmp_path / "a.jpg").pixels)
    for format_name, kind in ((None, "JPEG"), ("png", "PNG")):
        file = io.BytesIO()
        photo.save(file, format=format_name)
        assert pil(file.getvalue()).format == kind
    photo.save(tmp_path / "without-suffix", format="TIF", depth=16)
    assert Photo.open(tmp_path / "without-suffix").file_info.bits == 16
    separation = brewster.separate(io.BytesIO(image_bytes()), quality="draft")
    assert separation.photo.size == photo.size


@pytest.mark.parametrize(
    "source", [None, 7, [1, 2], {}, io.StringIO("text")], ids=lambda source: type(source).__name__
)
def test_a_source_of_another_type_is_a_type_error_that_names_it(source):
    with pytest.raises(
        TypeError, match=rf"is of type {type(source).__name__}.*; expected a path, .*; pass"
    ):
        Photo.open(source)
    with pytest.raises(TypeError):
        SEPARATOR(source)


@pytest.mark.parametrize(("low", "high"), [(0, 255), (-1, 1), (0, 1.01)])
def test_encoded_floats_outside_their_range_are_refused(low, high):
    array = np.linspace(low, high, 48).reshape(4, 4, 3)
    with pytest.raises(UnsupportedPhoto, match=r"expected 0\.\.1"):
        Photo.from_array(array, encoding="srgb")
    assert Photo.from_array(array, encoding="linear").linear().max() == pytest.approx(high)


def test_rounding_errors_of_encoded_floats_are_accepted_and_alpha_has_a_range():
    Photo.from_array(np.full((2, 2, 3), 1 + 1e-6), encoding="srgb")
    with pytest.raises(UnsupportedPhoto, match=r"alpha values of the array are in 200\.\.200"):
        Photo.from_array(np.full((2, 2, 4), 200.0), encoding="linear")


def test_many_photos_keep_their_order_and_errors_do_not_stop_the_others():
    sources = [image_bytes(seed=seed) for seed in range(5)]
    sources[2] = b"no image"
    results = list(SEPARATOR.many(sources, threads=3, quality="draft"))
    assert isinstance(results[2], UnreadablePhoto)
    for source, result in zip(sources, results, strict=True):
        if isinstance(result, Separation):
            alone = SEPARATOR(source, quality="draft")
            assert np.array_equal(result.transmission.pixels, alone.transmission.pixels)
    assert sum(isinstance(result, Separation) for result in results) == 4


def test_many_photos_are_read_only_as_they_are_needed():
    read = []
    lock = threading.Lock()

    def endless():
        while True:
            with lock:
                read.append(1)
            yield image_bytes(20, 20)

    results = SEPARATOR.many(endless(), threads=2)
    for _ in range(3):
        assert isinstance(next(results), Separation)
    results.close()
    assert len(read) <= 3 + 2


def test_many_photos_need_a_thread_and_are_no_single_path_or_file_and_a_wrong_type_is_raised():
    for source in ("window.jpg", b"bytes of a file"):
        with pytest.raises(TypeError, match=r"pass \[source\]"):
            SEPARATOR.many(source)
    with pytest.raises(BrewsterError, match="threads is 0"):
        SEPARATOR.many([], threads=0)
    with pytest.raises(TypeError):
        list(SEPARATOR.many([None]))
    assert list(SEPARATOR.many([])) == []


@pytest.mark.parametrize(("model", "message"), [
    (lambda tile: tile, "returned a ndarray"),
    (lambda tile: (tile,), "returned a tuple; expected a pair"),
    (lambda tile: (tile, tile[:-1]), "a reflection of shape"),
    (lambda tile: (tile.transpose(2, 0, 1), tile), "a transmission of shape"),
    (lambda tile: ((255 * tile).astype(np.uint8), tile), "dtype uint8"),
    (lambda tile: (255 * tile, tile), r"values in .*; expected linear light of about 0\.\.1"),
    (lambda tile: (tile, tile + np.nan), "a reflection with values in nan"),
])  # fmt: skip
def test_an_invalid_output_of_a_model_is_an_error_that_says_what_is_wrong(model, message):
    with pytest.raises(ModelError, match=message):
        Separator(model)(smooth(), encoding="srgb")


def test_the_folder_of_a_training_run_is_a_model(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    write_pane(folder / "model.onnx")
    separator = Separator.load(str(folder))
    assert (separator.name, separator.device) == ("run", "cpu")
    model = registry.find(str(folder))
    assert model.name == "run"
    assert isinstance(model, ModelFile)
    (folder / "model.onnx").unlink()
    assert isinstance(registry.find(str(folder)), DiffusionSource)  # the folder of a LoRA


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_pil_image_is_turned_as_pillow_turns_it(orientation):
    image = Image.fromarray(smooth())
    exif = Image.Exif()
    exif[274] = orientation
    image.info["exif"] = exif.tobytes()
    assert np.array_equal(Photo.from_pil(image).pixels, np.asarray(ImageOps.exif_transpose(image)))

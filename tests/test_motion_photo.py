"""The film of a photo is found in the layouts of all makers, and only where it is."""

import io
import shutil
import struct
import subprocess

import av
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brewster import Photo
from brewster.errors import UnreadablePhoto, UnsupportedPhoto
from brewster.photo.blocks.iso_boxes import boxes, film_at
from brewster.photo.phone_films import live_photo_archive as archives
from brewster.photo.phone_films import motion_photo
from brewster.photo.phone_films.motion_photo import LAYOUTS, search_films
from motion_photos import (
    IDENTIFIER,
    MOTION_PHOTO,
    UTC_ENTRY,
    apple_exif,
    box,
    container,
    film_entry,
    google_xmp,
    heic,
    huawei_tail,
    jpeg,
    live_photo_archive,
    packet,
    samsung_block,
    small_film,
)
from video_files import write_audio

FRAMES = 6


def find_films(photo):
    """The films of a photo, best first."""
    return [*search_films(photo).films]


def find_film(photo):
    """The best film of a photo."""
    return find_films(photo)[0]


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film whose frames are before its table of contents, as phones write it."""
    return small_film(tmp_path_factory.mktemp("film") / "film.mp4")


@pytest.fixture(scope="module")
def other_film(tmp_path_factory):
    return small_film(tmp_path_factory.mktemp("film") / "other.mp4", count=4)


@pytest.fixture(scope="module")
def live_film(tmp_path_factory):
    """A film with the identifier of a Live Photo."""
    return small_film(tmp_path_factory.mktemp("film") / "live.mov", identifier=IDENTIFIER)


def decoded_frames(data):
    with av.open(io.BytesIO(data)) as container:
        return sum(1 for _ in container.decode(container.streams.video[0]))


def pixel(film):
    return jpeg(google_xmp(len(film))) + film


def pixel_with_other_prefix(film):
    xmp = google_xmp(len(film), prefix="GContainer", item_prefix="GContainerItem")
    return jpeg(xmp) + film


def pixel_with_elements(film):
    return jpeg(google_xmp(len(film), as_elements=True)) + film


def pixel_ultra_hdr(film):
    gain_map = jpeg(size=(32, 24))
    padding = 57
    xmp = google_xmp(len(film), ("image/jpeg", "GainMap", len(gain_map), 0), padding=padding)
    return jpeg(xmp) + bytes(padding) + gain_map + film


def heic_one_ui_5(film):
    """The block of Samsung is inside the box of the film, and the length is that of a pointer."""
    block = box(b"sefd", samsung_block(UTC_ENTRY, film_entry(b"mpv2" + bytes(8))))
    return heic(google_xmp(68, padding=67, mime="image/heic")) + box(b"mpvd", film + block)


def heic_one_ui_6(film):
    """The block of Samsung is after the box of the film."""
    block = box(b"sefd", samsung_block(UTC_ENTRY, film_entry(b"mpv2" + bytes(8))))
    xmp = google_xmp(len(film) + len(block), padding=8, mime="image/heic")
    return heic(xmp) + box(b"mpvd", film) + block


def heic_with_wide_header(film):
    return heic(google_xmp(len(film), mime="image/heic")) + box(b"mpvd", film, is_wide=True)


def samsung_jpeg(film):
    entries = samsung_block(UTC_ENTRY, film_entry(film))
    offset = len(entries) - entries.index(film)
    return jpeg(packet({"GCamera:MicroVideo": 1, "GCamera:MicroVideoOffset": offset})) + entries


def samsung_jpeg_with_pointer(film):
    """The entry has the position and the size of the film instead of the film."""
    still = jpeg()
    pointer = b"mpv2" + struct.pack(">II", len(still), len(film))
    return still + film + samsung_block(UTC_ENTRY, film_entry(pointer))


def samsung_s24_fe(film):
    """Nothing states where the film is."""
    gain_map = jpeg(size=(32, 24))
    return jpeg(packet(MOTION_PHOTO)) + gain_map + film + samsung_block(UTC_ENTRY)


def micro_video(film):
    values = {
        "GCamera:MicroVideo": 1,
        "GCamera:MicroVideoOffset": len(film),
        "GCamera:MicroVideoPresentationTimestampUs": 100000,
    }
    return jpeg(packet(values)) + film


def huawei(film):
    return jpeg() + film + huawei_tail(film)


def old_huawei(film):
    return jpeg() + film + huawei_tail(film, version=b"")


def huawei_cinemagraph(film):
    block = b"\x07cinemagraph" * 40
    extra = block + struct.pack("<I", len(block))
    return jpeg() + film + huawei_tail(film, version=b"v3_f35_c", extra=extra)


def oppo(film):
    values = MOTION_PHOTO | {
        "OpCamera:OLivePhotoVersion": 2,
        "OpCamera:VideoLength": len(film) - 190,
        "OpCamera:MotionPhotoPrimaryPresentationTimestampUs": 100000,
    }
    items = container(("image/jpeg", "Primary", 0, 0), ("video/mp4", "MotionPhoto", len(film), 0))
    return jpeg(packet(values, items)) + film


def from_a_messenger(film):
    """Messengers remove the metadata, but not the film."""
    return jpeg() + film


def micro_video_with_more_bytes(film):
    return micro_video(film) + b"bytes added by another program"


def padded_pixel(film):
    return pixel(film) + bytes(8)


def heic_with_film_after_its_boxes(film):
    return heic(google_xmp(len(film), mime="image/heic")) + film


PHOTOS = {
    pixel: "Google Motion Photo",
    pixel_with_other_prefix: "Google Motion Photo",
    pixel_with_elements: "Google Motion Photo",
    pixel_ultra_hdr: "Google Motion Photo",
    heic_one_ui_5: "Samsung mpvd",
    heic_one_ui_6: "Samsung mpvd",
    heic_with_wide_header: "Samsung mpvd",
    heic_with_film_after_its_boxes: "Google Motion Photo",
    samsung_jpeg: "Samsung SEF",
    samsung_jpeg_with_pointer: "Samsung SEF",
    samsung_s24_fe: "after the image",
    micro_video: "MicroVideo",
    huawei: "Huawei LIVE",
    old_huawei: "Huawei LIVE",
    huawei_cinemagraph: "Huawei LIVE",
    oppo: "OPPO",
    from_a_messenger: "after the image",
    micro_video_with_more_bytes: "after the image",
    padded_pixel: "after the image",
}


@pytest.mark.parametrize("write", PHOTOS, ids=lambda write: write.__name__)
def test_the_film_is_found_in_the_layout_of_each_maker(write, film, tmp_path):
    data = write(film)
    path = tmp_path / "photo.jpg"
    path.write_bytes(data)
    for source in (data, path):
        (found,) = find_films(source)
        assert found.layout == PHOTOS[write]
        assert found.read() == film
        assert data[found.offset : found.offset + found.size] == film
        assert found.is_certain
        assert found.frames == decoded_frames(film) == FRAMES
        assert found.duration_s == pytest.approx(FRAMES / 30, abs=0.01)


def test_every_layout_has_a_photo():
    assert {*PHOTOS.values()} == {layout.name for layout in LAYOUTS}


@pytest.mark.parametrize("write", [pixel, micro_video, oppo, heic_one_ui_5])
def test_the_stated_time_of_the_still_is_in_seconds(write, film):
    assert find_film(write(film)).still_time_s == pytest.approx(0.1)


def test_an_unspecified_time_of_the_still_is_none(film):
    values = MOTION_PHOTO | {"GCamera:MotionPhotoPresentationTimestampUs": -1}
    assert find_film(jpeg(packet(values)) + film).still_time_s is None


@pytest.mark.parametrize("make", [jpeg, heic, lambda: b"", lambda: b"text", lambda: b"GIF89a"])
def test_a_photo_without_a_film_has_none(make):
    search = search_films(make())
    assert search.films == ()
    assert search.notes == ()


# --- Metadata that are wrong


@pytest.mark.parametrize("write", [pixel, heic_one_ui_6, samsung_jpeg, from_a_messenger])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.99])
def test_a_film_that_is_cut_off_is_no_film(write, share, film):
    data = write(film)
    start = data.index(film)
    assert find_films(data[: start + int(share * len(film))]) == []


def test_a_photo_whose_film_was_removed_says_so(film):
    search = search_films(jpeg(google_xmp(len(film))))
    assert search.films == ()
    assert len(search.notes) == 1


@pytest.mark.parametrize("name", ["GCamera:MotionPhoto", "GCamera:MicroVideo"])
def test_either_flag_states_a_film(name):
    for value, count in ((1, 1), (0, 0)):
        assert len(search_films(jpeg(packet({name: value}))).notes) == count


def test_stale_lengths_of_a_changed_photo_do_not_mislead(film):
    """Takeout compresses the JPEG again, and keeps the metadata of the original."""
    values = MOTION_PHOTO | {"GCamera:MicroVideo": 1, "GCamera:MicroVideoOffset": 123}
    items = container(("image/jpeg", "Primary", 99, 7), ("video/mp4", "MotionPhoto", 456, 0))
    (found,) = find_films(jpeg(packet(values, items), quality=60) + film)
    assert found.read() == film


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(offset=st.integers(-10, 20_000), length=st.integers(0, 20_000))
def test_random_lengths_never_give_anything_but_the_film(offset, length, film):
    values = {"GCamera:MicroVideo": 1, "GCamera:MicroVideoOffset": offset}
    items = container(
        ("image/jpeg", "Primary", length // 2, 3), ("video/mp4", "MotionPhoto", length, 0)
    )
    data = jpeg(packet(values, items)) + film
    assert [found.read() for found in find_films(data)] == [film]


def test_lengths_from_the_start_of_the_file_are_used_if_bytes_follow_the_film(film):
    """As the first items of the container state them, with their padding."""
    padding = 57
    lengths = {len(jpeg(google_xmp(len(film), padding=padding, primary=n))) for n in (1000, 9999)}
    (primary,) = lengths  # the number of digits is the same
    data = jpeg(google_xmp(len(film), padding=padding, primary=primary)) + bytes(padding) + film
    (found,) = find_films(data + b"bytes added by another program")
    assert (found.layout, found.read()) == ("Google Motion Photo", film)


def test_a_film_is_found_wherever_the_chunks_of_a_search_end(film, monkeypatch):
    for size in range(5, 9):  # the word has four letters
        monkeypatch.setattr(motion_photo, "_CHUNK_BYTES", size)
        assert [found.read() for found in find_films(from_a_messenger(film))] == [film]


def test_the_first_packet_of_a_photo_counts(film):
    """Programs append their own."""
    data = pixel(film)
    other = b"http://ns.adobe.com/xap/1.0/\0" + packet({"GCamera:MicroVideo": 0})
    start = data.index(b"\xff\xdb")  # the first table of the compression
    added = b"\xff\xe1" + (len(other) + 2).to_bytes(2, "big") + other
    (found,) = find_films(data[:start] + added + data[start:])
    assert found.still_time_s == pytest.approx(0.1)


def test_two_films_in_one_file_are_both_found(film, other_film):
    data = jpeg(google_xmp(len(film) + len(other_film))) + film + other_film
    assert [found.read() for found in find_films(data)] == [film, other_film]


def test_two_items_with_films_are_both_found(film, other_film):
    first = ("video/mp4", "MotionPhoto", len(film), 0)
    data = jpeg(google_xmp(len(other_film), first)) + film + other_film
    assert [found.read() for found in find_films(data)] == [film, other_film]


def test_an_image_after_the_photo_is_no_film(film):
    assert find_films(jpeg() + heic()) == []


def test_a_file_that_changed_since_it_was_searched_is_refused(film, tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(pixel(film))
    found = find_film(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UnreadablePhoto):
        found.read()
    path.unlink()
    with pytest.raises(UnreadablePhoto):
        found.read()


def test_a_missing_photo_is_an_error(tmp_path):
    with pytest.raises(UnreadablePhoto):
        search_films(tmp_path / "no.jpg")


# --- Films next to the photo


def write_pair(folder, still, film, still_name="IMG_1.JPG", film_name="IMG_1.MOV"):
    (folder / still_name).write_bytes(still)
    (folder / film_name).write_bytes(film)
    return folder / still_name


@pytest.mark.parametrize("make", [jpeg, heic])
def test_a_live_photo_is_two_files_with_the_same_identifier(make, live_film, tmp_path):
    photo = write_pair(tmp_path, make(exif=apple_exif()), live_film)
    (found,) = find_films(photo)
    assert found.layout == "Apple Live Photo"
    assert found.is_certain
    assert found.path == tmp_path / "IMG_1.MOV"
    assert found.read() == live_film


def test_a_film_with_another_identifier_is_refused(live_film, tmp_path):
    exif = apple_exif("11111111-2222-3333-4444-555555555555")
    search = search_films(write_pair(tmp_path, jpeg(exif=exif), live_film))
    assert search.films == ()
    assert len(search.notes) == 1


@pytest.mark.parametrize("exif", [b"", apple_exif()])
def test_a_film_with_the_name_of_the_photo_alone_is_uncertain(exif, film, tmp_path):
    (found,) = find_films(write_pair(tmp_path, jpeg(exif=exif), film))
    assert not found.is_certain
    assert found.layout == "beside"


NEIGHBOURS = [
    ("IMG_1.HEIC", "IMG_1.MOV"),
    ("IMG_1.HEIC", "IMG_1.mov"),
    ("IMG_1.HEIC", "IMG_1_HEVC.MOV"),
    ("IMG_1.HEIC", "IMG_1_HEVC.mov"),
    ("IMG_1.jpg", "IMG_1.mp4"),  # vivo
    ("IMG_1.jpg", "IMG_1.m4v"),
    ("PXL_1.MP.jpg", "PXL_1.MP"),  # Google Takeout
    ("MVIMG_1.jpg", "MVIMG_1"),
    ("PXL_1.jpg", "PXL_1.MP"),
    ("PXL_1.jpg", "PXL_1.MV"),
]


@pytest.mark.parametrize(("still_name", "film_name"), NEIGHBOURS)
def test_the_film_next_to_a_photo_is_found_by_its_name(still_name, film_name, film, tmp_path):
    (found,) = find_films(write_pair(tmp_path, jpeg(), film, still_name, film_name))
    assert found.path == tmp_path / film_name


def test_a_film_next_to_a_photo_with_the_stated_length_is_certain(film, tmp_path):
    photo = write_pair(tmp_path, jpeg(google_xmp(len(film))), film, "P.MP.jpg", "P.MP")
    (found,) = find_films(photo)
    assert found.is_certain
    assert found.still_time_s == pytest.approx(0.1)


def test_a_film_inside_the_photo_comes_before_one_next_to_it(film, other_film, tmp_path):
    photo = write_pair(tmp_path, pixel(film), other_film)
    assert [found.read() for found in find_films(photo)] == [film, other_film]


def test_a_film_inside_the_photo_comes_before_one_next_to_it_that_is_as_certain(
    film, live_film, tmp_path
):
    data = jpeg(google_xmp(len(film)), apple_exif()) + film
    found = find_films(write_pair(tmp_path, data, live_film))
    assert [each.is_certain for each in found] == [True, True]
    assert [each.read() for each in found] == [film, live_film]


def test_a_film_that_is_certain_comes_before_one_that_only_has_the_name(film, live_film, tmp_path):
    photo = write_pair(tmp_path, jpeg(exif=apple_exif()), film, film_name="IMG_1.mov")
    (tmp_path / "IMG_1_HEVC.MOV").write_bytes(live_film)
    assert [found.read() for found in find_films(photo)] == [live_film, film]


def test_other_files_next_to_a_photo_are_no_films(film, tmp_path):
    photo = write_pair(tmp_path, jpeg(), film, "IMG_1.jpg", "IMG_12.MOV")
    (tmp_path / "IMG_1.json").write_text("{}")
    (tmp_path / "IMG_1").mkdir()
    assert search_films(photo) == search_films(jpeg())


def test_a_film_next_to_a_photo_that_is_cut_off_is_named(film, tmp_path):
    search = search_films(write_pair(tmp_path, jpeg(), film[:-200]))
    assert search.films == ()
    assert any("IMG_1.MOV" in note for note in search.notes)


def test_a_quicktime_film_without_a_file_type_is_found(film, tmp_path):
    """QuickTime movies need no `ftyp` box: iPhones have written them without it."""
    frames = box(b"wide", b"") + film[film.index(b"ftyp") - 4 :][int.from_bytes(film[:4], "big") :]
    shift = 8 - int.from_bytes(film[:4], "big")
    table = frames.index(b"stco")
    start = int.from_bytes(frames[table + 12 : table + 16], "big") + shift
    frames = frames[: table + 12] + start.to_bytes(4, "big") + frames[table + 16 :]
    (found,) = find_films(write_pair(tmp_path, jpeg(), frames))
    assert decoded_frames(found.read()) == FRAMES


def test_a_huge_film_next_to_a_photo_is_not_read(film, tmp_path):
    photo = write_pair(tmp_path, jpeg(), b"")
    position = film.index(b"moov") - 4
    size = 1 << 40
    head = film[: int.from_bytes(film[:4], "big")]
    with (tmp_path / "IMG_1.MOV").open("wb") as file:
        file.write(head + struct.pack(">I4sQ", 1, b"mdat", size))
        file.seek(len(head) + size)
        file.write(film[position:])
    (found,) = find_films(photo)
    assert found.size > size
    with CountingFile((tmp_path / "IMG_1.MOV").open("rb")) as file:
        assert film_at(file, 0, found.size)
        assert file.count < 1 << 16


class CountingFile(io.BufferedReader):
    """Counts the bytes that are read."""

    count = 0

    def read(self, size=-1, /):
        data = super().read(size)
        self.count += len(data)
        return data


# --- The time of the still of Apple


def meta_track(key, empty_units, scale):
    """Returns a track with one sample of metadata after an empty edit, as Apple writes it."""
    handler = box(b"hdlr", bytes(4) + b"mhlrmeta" + bytes(12))
    description = box(b"mebx", bytes(8) + box(b"keys", box(b"\0\0\0\1", box(b"keyd", key))))
    table = box(b"stbl", box(b"stsd", struct.pack(">II", 0, 1) + description))
    header = box(b"mdhd", struct.pack(">IIIIII", 0, 0, 0, scale, 1, 0))
    edits = struct.pack(">IIIiIIII", 0, 2, empty_units, -1, 1 << 16, 1, 0, 1 << 16)
    media = box(b"mdia", header + handler + box(b"minf", table))
    return box(b"trak", box(b"edts", box(b"elst", edits)) + media)


def test_the_time_of_the_still_in_a_live_photo_is_its_empty_edit(live_film, tmp_path):
    start = live_film.index(b"moov") - 4
    scale = int.from_bytes(live_film[start + 28 : start + 32], "big")
    track = meta_track(b"mdtacom.apple.quicktime.still-image-time", 3 * scale // 20, scale)
    data = live_film[:start] + box(b"moov", live_film[start + 8 :] + track)
    (found,) = find_films(write_pair(tmp_path, jpeg(exif=apple_exif()), data))
    assert found.still_time_s == pytest.approx(0.15)


# --- Archives


@pytest.mark.parametrize("is_compressed", [True, False])
@pytest.mark.parametrize(
    ("make", "suffix"),
    [(jpeg, "jpg"), (jpeg, "jpeg"), (jpeg, "JPG"), (heic, "heic"), (heic, "HEIF")],
)
def test_an_archive_of_a_live_photo_is_a_photo_with_a_film(
    make, suffix, is_compressed, live_film, tmp_path
):
    still = make(exif=apple_exif())
    files = {f"IMG_1.{suffix}.{suffix}": still, "IMG_1.mov": live_film, "metadata.json": b"{}"}
    path = tmp_path / "IMG_1.livp"
    path.write_bytes(live_photo_archive(files, is_compressed=is_compressed))
    for source in (path, path.read_bytes()):
        (found,) = find_films(source)
        assert found.layout == "livp"
        assert found.read() == live_film
        assert (Photo.open(source).pixels == Photo.open(still).pixels).all()


@pytest.mark.parametrize("stills", [[], ["a.jpg", "b.jpg"]])
def test_an_archive_needs_one_still(stills, live_film):
    files = {"a.mov": live_film} | dict.fromkeys(stills, jpeg())
    with pytest.raises(UnsupportedPhoto):
        Photo.open(live_photo_archive(files))


def test_an_archive_that_expands_to_a_huge_file_is_refused(live_film, monkeypatch):
    monkeypatch.setattr(archives, "_MAX_MEMBER_BYTES", 1 << 20)
    zeros = bytes(2 << 20)
    films = live_photo_archive({"a.jpg": jpeg(), "a.mov": zeros}, is_compressed=True)
    with pytest.raises(UnreadablePhoto):
        find_films(films)
    stills = live_photo_archive({"a.jpg": zeros, "a.mov": live_film}, is_compressed=True)
    with pytest.raises(UnreadablePhoto):
        Photo.open(stills)


def test_an_archive_that_states_too_small_a_size_is_refused(live_film):
    data = live_photo_archive({"a.jpg": jpeg(), "a.mov": bytes(1 << 20)}, is_compressed=True)
    lie = data.replace(struct.pack("<I", 1 << 20), struct.pack("<I", 1 << 10))
    with pytest.raises(UnreadablePhoto):
        find_films(lie)


def test_an_archive_of_many_files_is_refused_before_it_is_listed(live_film):
    files = {"a.jpg": jpeg(), "a.mov": live_film} | {f"{i}.txt": b"" for i in range(100)}
    for search in (find_films, Photo.open):
        with pytest.raises(UnreadablePhoto):
            search(live_photo_archive(files))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.98])
def test_a_damaged_archive_is_an_error(share, live_film):
    data = live_photo_archive({"a.jpg": jpeg(), "a.mov": live_film})
    data = data[: int(share * len(data))]
    for search in (find_films, Photo.open):
        with pytest.raises(UnreadablePhoto):
            search(data)


# --- Any bytes


@settings(max_examples=60)
@given(st.binary(max_size=600))
def test_random_bytes_have_no_film(data):
    heads = (b"", jpeg(), b"\0\0\0\x18ftypmp42", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    for head in heads:
        assert find_films(head + data) == []


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.randoms(use_true_random=False), count=st.integers(1, 40))
def test_damaged_photos_give_whole_boxes_or_nothing(seed, count, film):
    data = bytearray(seed.choice([pixel, heic_one_ui_5, samsung_jpeg, huawei])(film))
    for _ in range(count):
        data[seed.randrange(len(data))] = seed.randrange(256)
    for found in find_films(bytes(data)):
        found_bytes = found.read()
        kinds = [each.kind for each in boxes(io.BytesIO(found_bytes), 0, found.size)]
        assert kinds[0] == b"ftyp"
        assert {b"moov", b"mdat"} <= {*kinds}
        assert len(found_bytes) == found.size


HEAD = b"\0\0\0\x18ftypmp42\0\0\0\0isommp42"
MALFORMED = {
    "a size of 0 before the end": box(b"moov", b"") + struct.pack(">I4s", 0, b"mdat"),
    "sizes smaller than a header": struct.pack(">I4s", 4, b"mdat") * 100,
    "a wide size of 0": struct.pack(">I4sQ", 1, b"mdat", 0) * 100,
    "a negative wide size": struct.pack(">I4sq", 1, b"mdat", -16) * 100,
    "a wide header that is cut off": struct.pack(">I4s", 1, b"moov"),
    "many empty boxes": box(b"free", b"") * 100_000 + box(b"moov", b"") + box(b"mdat", b""),
    "boxes in boxes": box(b"moov", box(b"trak", box(b"mdia", b"\0" * 64)) * 500)
    + box(b"mdat", b""),
    "a movie in itself": box(b"moov", struct.pack(">I4s", 0, b"trak") * 50) + box(b"mdat", b""),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_boxes_end_the_walk(name):
    data = HEAD + MALFORMED[name]
    assert film_at(io.BytesIO(data), 0, len(data)) is None
    assert find_films(jpeg() + data) == []
    assert find_films(heic() + box(b"mpvd", data)) == []


@pytest.mark.parametrize("depth", [50, 2000])
def test_deeply_nested_metadata_do_not_fail(depth, film):
    """The film is found without them, and the photo opens."""
    nested = "<rdf:li>" * depth + "</rdf:li>" * depth
    data = jpeg(packet(MOTION_PHOTO, nested)) + film
    assert [found.read() for found in find_films(data)] == [film]
    assert Photo.open(data).size == (64, 48)


def test_only_the_ends_of_a_photo_without_a_film_are_read(monkeypatch):
    """Most photos of Samsung have its block, with or without a film."""
    still = jpeg(size=(1600, 1200), quality=100)
    for data in (still, still + samsung_block(UTC_ENTRY), still + bytes(40)):
        with CountingFile(io.BytesIO(data)) as file:
            monkeypatch.setattr(motion_photo, "_opened", lambda _, file=file: file)
            assert find_films(data) == []
            assert file.count < len(data) / 2


def test_a_film_with_sound_only_is_no_film(tmp_path):
    write_audio(tmp_path / "sound.mp4")
    assert find_films(jpeg() + (tmp_path / "sound.mp4").read_bytes()) == []


# --- The imitations are what another reader expects


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool")
@pytest.mark.parametrize(
    ("write", "tag", "value"),
    [
        (samsung_jpeg, "EmbeddedVideoFile", None),
        (pixel_ultra_hdr, "DirectoryItemSemantic", "Primary GainMap MotionPhoto"),
        (micro_video, "MicroVideo", "1"),
    ],
)
def test_exiftool_reads_the_imitations(write, tag, value, film, tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(write(film))
    command = ["exiftool", *(("-a", "-s3") if value else ("-b",)), f"-{tag}", str(path)]
    out = subprocess.run(command, capture_output=True, check=True).stdout
    assert out.split() == value.encode().split() if value else out == film


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool")
def test_exiftool_reads_the_same_identifiers(live_film, tmp_path):
    photo = write_pair(tmp_path, heic(exif=apple_exif()), live_film, "IMG_1.HEIC")
    for path, tag in ((photo, "MediaGroupUUID"), (tmp_path / "IMG_1.MOV", "ContentIdentifier")):
        command = ["exiftool", "-b", f"-{tag}", str(path)]
        out = subprocess.run(command, capture_output=True, check=True, text=True).stdout
        assert out == IDENTIFIER

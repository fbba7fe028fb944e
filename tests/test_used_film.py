"""Which film a photo is separated by, and what happens if it cannot be used."""

import pytest

from brewster.errors import MissingExtra, ModelError, UnreadablePhoto
from brewster.options import FILM_AUTO, FILM_NO
from brewster.photo.phone_films.motion_photo import PhotoFilm
from brewster.separation.used_film import MAX_FILM_S, FoundFilm, find_used_film
from motion_photos import google_xmp, jpeg, small_film

FILM = PhotoFilm.of_bytes(b"a film")
ERRORS = {
    UnreadablePhoto: UnreadablePhoto("it is damaged", "expected a film", "copy it again"),
    MissingExtra: MissingExtra("av is missing", "expected it", "install it"),
}


def photo_with_film(folder, seconds, *, is_inside):
    film = small_film(folder / "a.mp4", seconds, rate=1)
    path = folder / "a.jpg"
    path.write_bytes(jpeg(google_xmp(len(film))) + film if is_inside else jpeg())
    if is_inside:
        (folder / "a.mp4").unlink()
    return path


@pytest.mark.parametrize("is_inside", [True, False])
def test_a_film_of_ten_seconds_is_used_and_a_longer_one_is_noted(tmp_path, is_inside):
    photo = photo_with_film(tmp_path, int(MAX_FILM_S), is_inside=is_inside)
    sources = [photo, str(photo), *([photo.read_bytes()] if is_inside else [])]
    for source in sources:
        assert find_used_film(source, FILM_AUTO).film is not None
        assert find_used_film(source, FILM_NO).film is None
    found = find_used_film(
        photo_with_film(tmp_path, int(MAX_FILM_S) + 1, is_inside=is_inside), FILM_AUTO
    )
    assert found.film is None
    assert len(found.notes) == 1


def test_the_best_film_is_used_that_is_not_too_long(tmp_path):
    seconds = {"inside": int(MAX_FILM_S) + 1, "beside": 3}
    for _ in range(2):
        photo = photo_with_film(tmp_path, seconds["inside"], is_inside=True)
        beside = small_film(tmp_path / "a.mp4", seconds["beside"], rate=1)
        found = find_used_film(photo, FILM_AUTO)
        assert (found.film.read() == beside) == (seconds["inside"] > MAX_FILM_S)
        seconds["inside"] = 4  # then it comes first


def test_a_film_that_is_named_may_be_long_and_must_exist(tmp_path):
    photo = photo_with_film(tmp_path, int(MAX_FILM_S) + 1, is_inside=False)
    found = find_used_film(photo, str(tmp_path / "a.mp4"))
    assert found.is_named
    assert found.film.read() == (tmp_path / "a.mp4").read_bytes()
    with pytest.raises(UnreadablePhoto):
        find_used_film(photo, str(tmp_path / "b.mp4"))


def test_notes_are_kept_whether_the_film_can_be_used_or_not():
    found = FoundFilm(FILM, ("one note",))
    assert found.fitted(lambda film: (film, "layers")) == ((FILM, "layers"), ("one note",))
    assert FoundFilm(None, ("one note",)).fitted(pytest.fail) == (None, ("one note",))


@pytest.mark.parametrize("kind", ERRORS)
def test_only_a_film_that_is_named_can_stop_its_photo(kind):
    def fail(_film):
        raise ERRORS[kind]

    layers, notes = FoundFilm(FILM, ("one note",)).fitted(fail)
    assert layers is None
    assert notes[0] == "one note"
    assert len(notes) == 2
    with pytest.raises(kind):
        FoundFilm(FILM, is_named=True).fitted(fail)


def test_other_errors_are_not_blamed_on_the_film():
    def fail(_film):
        raise ModelError("the model is damaged", "expected another", "reinstall it")

    with pytest.raises(ModelError):
        FoundFilm(FILM).fitted(fail)

"""Every option of a call reaches the separator with its value, whichever way it takes: Python, the
command line, HTTP, the page, bursts and films.

The expected layers are those of a `Separator` that is called directly. No option is without effect
on them, so that an option that is lost or has another value is seen.
"""

import inspect
import re
import sys
from functools import partial

import numpy as np
import pytest

import brewster
from brewster import Photo
from brewster.batch import separate_files, separate_tasks
from brewster.batch.plan import plan_bursts
from brewster.errors import PhotoError
from brewster.film import fit_burst, read_video, separate_burst, separate_video
from brewster.film.motion.model.levels import Level
from brewster.film.motion.solver import solve
from brewster.options import Options
from brewster.separation import Separator
from brewster.web.preview import preview
from picture_files import file_of
from simulated_bursts import PICTURES, linear_pictures, read_photo, simulate_burst
from test_preview import sent_preview
from video_files import film_of, write_video
from web_servers import make_app, request

SIZE = (480, 360)


class Model:
    """Its transmission depends on the hints, and on the size of its input as on the quality."""

    takes_hints = True

    def __call__(self, tile, hints=None):
        marked = np.zeros_like(tile[..., :1]) if hints is None else hints[..., :1]
        share = np.float32(0.2 + 0.3 * (tile.shape[1] % 97) / 97) + np.float32(0.4) * marked
        return tile * (1 - share), tile * share


def left_part(size, colour):
    image = np.zeros((size[1], size[0], len(colour)), np.uint8)
    image[:, : size[0] // 3] = colour
    return file_of(image.squeeze(), "PNG")


def values_for(size):
    """A value of each option of a call that changes the result."""
    return {
        "strength": 0.3,
        "quality": "draft",
        "mask": left_part(size, (255,)),
        "hints": left_part(size, (255, 0, 0)),
        "additive": True,
        "max_pixels": 1000,
    }


VALUES = values_for(SIZE)
LAYERS = tuple(name for name in VALUES if name != "max_pixels")
"""The options that change layers."""


@pytest.fixture(scope="module")
def photos():
    pictures = (read_photo(path, SIZE) for path in PICTURES[:2])
    return [file_of((255 * np.clip(picture, 0, 1)).astype(np.uint8), "PNG") for picture in pictures]


@pytest.fixture
def separator(monkeypatch):
    separator = Separator(Model(), name="model", sha256="0" * 64)
    monkeypatch.setattr(Separator, "load", lambda *_, **__: separator)
    return separator


def in_files(call, folder):
    """The options with their images in files."""
    for name, value in call.items():
        if isinstance(value, bytes):
            (folder / f"{name}.png").write_bytes(value)
    return {
        name: folder / f"{name}.png" if isinstance(value, bytes) else value
        for name, value in call.items()
    }


def as_words(call, folder):
    """The options as words of the command line, with the images in files."""
    words = []
    for name, value in in_files(call, folder).items():
        words += [f"--{name.replace('_', '-')}", *([] if value is True else [value])]
    return words


def as_form(photos, call, **fields):
    files = [("photo", (f"{number}.png", photo)) for number, photo in enumerate(photos)]
    files += [
        (name, (f"{name}.png", value)) for name, value in call.items() if isinstance(value, bytes)
    ]
    texts = {name: str(value) for name, value in call.items() if not isinstance(value, bytes)}
    return {"files": files, "data": {"layers": "transmission", **fields, **texts}}


@pytest.fixture
def ways(photos, run_without_model, tmp_path, separator):
    """A function for each way. It takes the options, and returns the transmission."""
    photo = photos[0]
    for name, data in zip(("a.png", "b.png"), photos, strict=True):
        (tmp_path / name).write_bytes(data)

    def run(*words):
        code, _, err = run_without_model(*words, "-o", "out")
        if code:
            raise PhotoError(err, "", "")
        (path,) = (tmp_path / "out").glob("*transmission*")
        return Photo.open(path)

    def sent(files, call, **fields):
        call = dict(call)
        app = make_app(Model(), max_pixels=call.pop("max_pixels", 10**8))
        response = request(app, "POST", "/separate", **as_form(files, call, **fields))
        if response.status_code != 200:
            raise PhotoError(response.text, "", "")
        return Photo.open(response.content)

    def of_files(call):
        (result,) = separate_files(
            [tmp_path / "a.png"], tmp_path / "out", Options(**in_files(call, tmp_path))
        )
        if result.error:
            raise PhotoError(result.error, "", "")
        return Photo.open(result.outputs["transmission"])

    single = {"method": "single"}
    return {
        "Python": lambda call: brewster.separate(photo, **call).transmission,
        "files": of_files,
        "command": lambda call: run("a.png", *as_words(call, tmp_path)),
        "HTTP": lambda call: sent([photo], call),
        "burst in Python": lambda call: (
            separate_burst(photos, reference=0, separator=separator, **single, **call).transmission
        ),
        "burst command": lambda call: run(
            "burst", "a.png", "b.png", "--reference", 1, "--method", "single",
            *as_words(call, tmp_path),
        ),
        "burst by HTTP": lambda call: sent(photos, call, reference="1", **single),
    }  # fmt: skip


WAYS = (
    "Python",
    "files",
    "command",
    "HTTP",
    "burst in Python",
    "burst command",
    "burst by HTTP",
)


def same(one, other):
    return one.pixels.dtype == other.pixels.dtype and np.array_equal(one.pixels, other.pixels)


def test_the_table_has_every_option_and_every_one_has_an_effect(photos, separator):
    parameters = inspect.signature(Separator.__call__).parameters
    assert set(VALUES) == set(Options().call_options())
    assert set(VALUES) < set(parameters)
    plain = separator(photos[0]).transmission
    for name in LAYERS:
        assert not same(separator(photos[0], **{name: VALUES[name]}).transmission, plain), name


@pytest.mark.parametrize("option", LAYERS)
@pytest.mark.parametrize("way", WAYS)
def test_an_option_reaches_the_separator_with_its_value(ways, separator, photos, way, option):
    call = {option: VALUES[option]}
    assert same(ways[way](call), separator(photos[0], **call).transmission)


@pytest.mark.parametrize("way", WAYS)
def test_all_options_together_reach_the_separator(ways, separator, photos, way):
    call = {name: VALUES[name] for name in LAYERS}
    assert same(ways[way](call), separator(photos[0], **call).transmission)


@pytest.mark.parametrize("way", WAYS)
def test_the_limit_of_pixels_reaches_the_separator(ways, way):
    with pytest.raises(PhotoError, match=r"480 ?x ?360"):
        ways[way]({"max_pixels": VALUES["max_pixels"]})


@pytest.mark.parametrize(("count", "middle"), [(2, 1), (3, 1), (4, 2), (5, 2)])
@pytest.mark.parametrize("way", ["Python", "command", "HTTP"])
def test_the_middle_photo_is_separated_unless_another_is_asked_for(
    way, count, middle, run_without_model, tmp_path, separator
):
    photos = [
        file_of(np.full((48, 64, 3), 40 + 30 * number, np.uint8), "PNG") for number in range(count)
    ]
    if way == "Python":
        found = separate_burst(photos, separator=separator, method="single").transmission
    elif way == "HTTP":
        form = as_form(photos, {}, method="single")
        response = request(make_app(Model()), "POST", "/separate", **form)
        assert f"{middle}.transmission.png" in response.headers["content-disposition"]
        found = Photo.open(response.content)
    else:
        for number, photo in enumerate(photos):
            (tmp_path / f"{number}.png").write_bytes(photo)
        names = [f"{number}.png" for number in range(count)]
        assert run_without_model("burst", *names, "--method", "single", "-o", "out")[0] == 0
        found = Photo.open(tmp_path / "out" / f"{middle}.transmission.png")
    assert same(found, separator(photos[middle]).transmission)


@pytest.mark.parametrize("way", ["Python", "files", "command", "all frames", "HTTP"])
def test_the_limit_of_pixels_applies_to_the_frames_of_a_film(
    way, run_without_model, tmp_path, separator
):
    path = write_video(tmp_path / "a.mp4", film_of(np.zeros((240, 400, 3), np.uint8), 12))

    def of_files(limit):
        (result,) = separate_tasks(
            plan_bursts([path], tmp_path / "out"), Options(max_pixels=limit), separator
        )
        return result.error

    def sent(limit):
        app = make_app(Model(), max_pixels=limit)
        return request(app, "POST", "/separate", **as_form([path.read_bytes()], {})).text

    ways = {
        "Python": lambda limit: error_of(read_video, path, 3, max_pixels=limit),
        "files": of_files,
        "command": lambda limit: run_without_model("burst", path, "--max-pixels", limit)[2],
        "all frames": lambda limit: run_without_model(
            "burst", path, "--all-frames", "-o", "b.mp4", "--max-pixels", limit
        )[2],
        "HTTP": sent,
    }
    limit = 240 * 180 - 1
    assert re.search(rf"240 x 180 pixels.* at most {limit} pixels", ways[way](limit))


def error_of(function, *args, **options):
    with pytest.raises(PhotoError) as raised:
        function(*args, **options)
    return str(raised.value)


@pytest.mark.parametrize("call", [
    {"quality": VALUES["quality"]}, {"hints": VALUES["hints"]},
    {"quality": VALUES["quality"], "hints": VALUES["hints"]},
])  # fmt: skip
def test_quality_and_hints_reach_the_preview_of_the_page(photos, separator, call):
    """The page applies the strength and the mask itself."""
    response = request(make_app(Model()), "POST", "/preview", **as_form(photos[:1], call))
    options = Options(quality=call.get("quality", Options.quality))
    args = separator, Photo.open(photos[0]), options, lambda _done: None
    _, shown = sent_preview(response)
    assert shown == preview(*args, call.get("hints"))[0]
    assert shown != preview(*args[:2], Options(), args[3])[0]


SMALL = (128, 96)
MEASURED = {name: values_for(SMALL)[name] for name in ("strength", "mask", "additive")}
"""The options that apply to measured layers."""


@pytest.fixture(scope="module")
def moving():
    """Three photos in which the reflection moves."""
    motion = {"relative_px": 12, "common_px": 3, "strength": 0.4, "noise": 0}
    burst = simulate_burst(*linear_pictures((160, 120)), frames=3, size=SMALL, **motion)
    return [file_of(frame, "PNG") for frame in burst.frames]


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """The quality of measured layers is not tested here."""
    few = (Level(48, 20, None),)
    monkeypatch.setattr("brewster.film.measuring.solve", partial(solve, search=few, levels=few))


def test_options_reach_the_measured_layers_of_a_burst(
    moving, separator, run_without_model, tmp_path
):
    fitted = fit_burst(moving, separator=separator).chosen("motion", swap=False)
    plain = fitted.separate(lambda _done: None).transmission
    app = make_app(Model())
    for number, photo in enumerate(moving):
        (tmp_path / f"{number}.png").write_bytes(photo)
    for name, value in MEASURED.items():
        expected = fitted.separate(lambda _done: None, **{name: value}).transmission
        assert not same(expected, plain)
        form = as_form(moving, {name: value}, method="motion")
        assert same(Photo.open(request(app, "POST", "/separate", **form).content), expected)
    words = as_words(MEASURED, tmp_path)
    names = [f"{number}.png" for number in range(3)]
    code, _, err = run_without_model("burst", *names, "--method", "motion", "-o", "out", *words)
    assert code == 0, err
    (path,) = (tmp_path / "out").glob("*transmission*")
    assert same(Photo.open(path), fitted.separate(lambda _done: None, **MEASURED).transmission)


@pytest.mark.parametrize("way", ["Python", "command"])
def test_options_reach_the_measurement_of_all_frames(
    way, separator, run_without_model, tmp_path, monkeypatch
):
    """`strength` is tested with the frames that are written (test_separate_video.py)."""
    picture = (255 * np.clip(read_photo(PICTURES[0], (240, 180)), 0, 1)).astype(np.uint8)
    write_video(tmp_path / "a.mp4", film_of(picture, 12, step=3))
    call = {"hints": values_for((120, 90))["hints"], "max_pixels": 10**7}
    seen = {}

    def fit(photos, **options):
        seen.update(options, frames=len(photos))
        raise PhotoError("enough", "", "")

    monkeypatch.setattr(sys.modules["brewster.film.separate_video"], "fit_burst", fit)
    if way == "Python":
        with pytest.raises(PhotoError, match="enough"):
            separate_video(
                tmp_path / "a.mp4", tmp_path / "b.mp4", frames=4, reference=2,
                separator=separator, **call,
            )  # fmt: skip
    else:
        words = ("--all-frames", "--frames", 4, "--reference", 3, *as_words(call, tmp_path))
        assert run_without_model("burst", "a.mp4", "-o", "b.mp4", *words)[0] == 1
    hints = seen["hints"]
    assert (hints if isinstance(hints, bytes) else hints.read_bytes()) == call["hints"]
    assert (seen["frames"], seen["reference"], seen["max_pixels"]) == (4, 2, 10**7)
    assert seen["separator"] is separator

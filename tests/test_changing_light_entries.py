"""Changing light over HTTP and on the command line, and bursts that are rendered in it."""

import json

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from brewster import Photo
from brewster.cli import main
from brewster.render.analytic import render
from brewster.render.scene.recipe import read_scene_recipe
from brewster.render.scene.sampler import draw_frames
from brewster.render.scene.world import Cloth
from picture_files import file_of
from simulated_bursts import linear_pictures
from synthetic_scenes import ASSETS, camera_towards_glass, make_scene, map_side
from test_changing_light import as_photos, cloth_photos, polariser_photos
from test_sampler import BUILTIN
from test_serve_burst import send


@pytest.fixture(scope="module")
def files():
    _, _, photos = polariser_photos()
    return [photo.encode("png") for photo in as_photos(photos)]


def test_photos_in_changing_light_by_http(files):
    response = send("/separate", files, layers="transmission")
    assert response.status_code == 200, response.text
    assert response.headers["Brewster-Burst"] == "light"
    assert Photo.open(response.content).size == (160, 120)


def test_the_method_light_is_an_option_by_http(files):
    response = send("/preview", files[:2], method="light")
    assert (response.status_code, response.headers["Brewster-Burst"]) == (200, "light")
    assert send("/preview", files[:2], method="dark").status_code == 422


def test_photos_in_changing_light_on_the_command_line(tmp_path, capsys):
    _, photos = cloth_photos()
    paths = [tmp_path / f"{k}.png" for k in range(3)]
    for path, photo in zip(paths, as_photos(photos), strict=True):
        photo.save(path)
    out = tmp_path / "clear"
    arguments = ["burst", *map(str, paths), "-o", str(out), "--json", "--method", "light"]
    assert main(arguments) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[0])
    assert result["burst"]["method"] == "light"
    assert result["burst"]["light"]["kind"] == "changing reflection"
    assert [path.name for path in out.iterdir()]


def test_another_scene_alone_is_no_series():
    photos = as_photos(linear_pictures((320, 240))[:2])
    response = send("/preview", [photo.encode("png") for photo in photos], method="light")
    assert response.headers["Brewster-Burst"] == "single photo"


@pytest.mark.parametrize("angle", [0.0, 90.0])
def test_a_polariser_takes_the_reflection_at_brewsters_angle(angle):
    """At 56.3 degrees and n = 1.5, glass reflects no light whose electric field is in the plane of
    incidence, which is horizontal for upright glass.
    """
    camera = camera_towards_glass(56.31, fov_deg=4, width=24, height=16, polariser_deg=angle)
    sides = {"front": map_side(), "behind": map_side()}
    sample = render(make_scene(camera, [{"refractive_index": 1.5}], **sides), ASSETS)
    if angle == 0:
        assert float(sample.reflection.max()) < 0.002
        assert float(sample.transmission.min()) > 0.99
    else:
        assert float(sample.reflection.mean()) == pytest.approx(0.257, abs=0.01)
    torch.testing.assert_close(sample.photo, torch.ones_like(sample.photo), atol=1e-4, rtol=0)


def test_two_crossed_polarisers_have_the_light_of_none_on_average():
    sides = {"front": map_side("mottled"), "behind": map_side("mottled")}
    camera = camera_towards_glass(40, 8, fov_deg=2)
    images = [
        render(make_scene(camera | {"polariser_deg": angle}, [{}], **sides), ASSETS)
        for angle in (20.0, -70.0, None)
    ]
    mean = (images[0].reflection + images[1].reflection) / 2
    torch.testing.assert_close(mean, images[2].reflection, rtol=1e-3, atol=1e-5)


def test_a_cloth_covers_a_band_of_the_reflection_and_nothing_else():
    sides = {"front": map_side(), "behind": map_side()}
    camera = camera_towards_glass(20, width=40, height=30)
    plain = render(make_scene(camera, [{}], **sides), ASSETS)
    cloth = Cloth(centre=0.0, width=1.0, transmittance=0.05)
    covered = render(make_scene(camera, [{}], **sides, cloth=cloth), ASSETS)
    share = covered.reflection / plain.reflection
    assert share[:, :, 15:25].numpy() == pytest.approx(0.05, abs=1e-4)
    assert share[:, :, :5].numpy() == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(covered.transmission, plain.transmission)


@pytest.mark.parametrize("name", ["polariser", "cloth"])
def test_the_frames_of_a_recipe_differ_in_light_and_not_in_place(name):
    frames = draw_frames(read_scene_recipe(name), BUILTIN, 3, 1)
    places = {(frame.camera.position_mm, frame.camera.heading_deg) for frame in frames}
    changes = {(frame.camera.polariser_deg, frame.cloth) for frame in frames}
    assert (len(frames), len(places), len(changes)) == (5, 1, 5)


def test_rough_glass_has_no_polariser():
    with pytest.raises(ValidationError, match="smooth parallel panes"):
        make_scene(camera_towards_glass(30, polariser_deg=10), [{"roughness": 0.1}])


def test_a_frame_keeps_its_pixels_where_the_mask_is_black(files):
    mask = np.zeros((120, 160), np.uint8)
    response = send("/separate", files, mask=file_of(mask, "PNG"), layers="transmission")
    assert (Photo.open(response.content).pixels == Photo.open(files[2]).pixels).all()

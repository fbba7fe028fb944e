"""Synthetic maps, pictures and scenes: constant light, one bright texel, a bright half, a line."""

import math

import numpy as np
from hypothesis import strategies as st

from brewster.render.scene.camera import Camera, axes
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import AssetSource, EnvironmentMap, Plane, Side


class SyntheticAssets:
    """Replaces `Assets`: images (H, W, 3) in memory by the name of their source."""

    def __init__(self, **pictures):
        self.pictures = {"white": np.ones((16, 32, 3), np.float32), **pictures}

    def map_radiance(self, environment):
        return self.pictures[environment.source.file] * np.float32(environment.luminance)

    def plane_radiance(self, plane):
        return self.pictures[plane.source.file] * np.float32(plane.luminance)


def map_directions(height):
    """Unit directions (H, 2 H, 3) of the texels of a latitude-longitude map whose left edge is at
    -z.
    """
    heading = (np.arange(2 * height) + 0.5) / height * np.pi
    polar = (np.arange(height)[:, None] + 0.5) / height * np.pi
    horizontal = np.sin(polar)
    xyz = horizontal * np.sin(heading), np.cos(polar), -horizontal * np.cos(heading)
    return np.stack(np.broadcast_arrays(*xyz), axis=-1)


def smooth_map(height):
    """A smooth map, different in each channel."""
    x, y, z = np.moveaxis(map_directions(height), -1, 0)
    channels = 1 + 0.5 * x * z, 1 + 0.4 * y - 0.3 * z, 1 + 0.6 * x * y + 0.2 * y
    return np.stack(channels, -1).astype(np.float32)


def map_with_bright_texel(height, row, column):
    """A black map with one bright texel."""
    return 1e4 * image_with_white_part((height, 2 * height), (row, column))


def image_with_white_part(shape, part):
    """A black image (H, W, 3) that is white in `part`, an index or slices."""
    texels = np.zeros((*shape, 3), np.float32)
    texels[part] = 1
    return texels


ASSETS = SyntheticAssets(
    soft=smooth_map(64),
    mottled=np.random.default_rng(3).random((16, 32, 3), np.float32),
    right=image_with_white_part((32, 64), np.s_[:, 32:]),
    top=image_with_white_part((32, 64), np.s_[:16]),
    line=image_with_white_part((64, 64), np.s_[:, 32]),
)


def map_side(name="white", **values):
    """A side of a scene with an environment map."""
    return Side(map=EnvironmentMap(source=AssetSource(file=name), **values))


def plane_side(name="white", **values):
    """A side of a scene with a picture on a plane."""
    values = {"distance_mm": 800, "width_mm": 8000, **values}
    return Side(plane=Plane(source=AssetSource(file=name), **values))


def camera_towards_glass(heading_deg, pitch_deg=0.0, distance_mm=500.0, **values):
    """Values of a camera whose axis meets the centre of the glass."""
    back = axes(heading_deg, pitch_deg)[2]
    position = tuple(distance_mm * part for part in back)
    return {"heading_deg": heading_deg, "pitch_deg": pitch_deg, "position_mm": position, **values}


def make_scene(camera=None, panes=(), **values):
    """A scene of 24 x 24 px. By default, it has ordinary glass and uniform white light on both
    sides.

    `camera` and each item of `panes` are dictionaries of values.
    """
    if panes:
        gap = 12.0 if len(panes) > 1 else 0.0
        values["glass"] = Glazing(panes=tuple(Pane(**pane) for pane in panes), gap_mm=gap)
    camera = {"width": 24, "height": 24, "fov_deg": 30, **camera_towards_glass(0), **(camera or {})}
    return Scene(camera=Camera(**camera), **{"behind": map_side(), "front": map_side(), **values})


def pixel_directions(camera):
    """Unit directions (H, W, 3) through the centres of the pixels."""
    right, up, back = map(np.array, axes(camera.heading_deg, camera.pitch_deg))
    half = math.tan(math.radians(camera.fov_deg) / 2)
    x = ((np.arange(camera.width) + 0.5) * 2 - camera.width) / camera.width * half
    y = (camera.height - (np.arange(camera.height) + 0.5) * 2) / camera.width * half
    directions = x[None, :, None] * right + y[:, None, None] * up - back
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def centroid(picture):
    """The centroid (x, y) of an image (3, H, W) in pixels, measured from its upper left corner."""
    light = np.asarray(picture, np.float64).sum(0)
    height, width = light.shape
    return (
        float((light.sum(0) * (np.arange(width) + 0.5)).sum() / light.sum()),
        float((light.sum(1) * (np.arange(height) + 0.5)).sum() / light.sum()),
    )


SIDES = (
    Side(),
    map_side("mottled", heading_deg=70),
    map_side("mottled", radius_mm=4000.0),
    plane_side("mottled", width_mm=900),
    Side(map=map_side("soft").map, plane=plane_side("mottled", width_mm=400, heading_deg=20).plane),
    Side(
        map=map_side("soft", radius_mm=5000.0).map, plane=plane_side("mottled", width_mm=400).plane
    ),
)


@st.composite
def random_scenes(draw, **fixed):
    """Scenes of every kind of the analytic renderer, except rough glass: panes, tints, wedges,
    sides, lenses.
    """
    wedge_deg = draw(st.sampled_from([0.0, 0.0, 0.3]))
    panes = draw(st.integers(1, 2))
    tint = draw(st.sampled_from([(0.0, 0.0, 0.0), (20.0, 0.0, 5.0)]))
    place = draw(st.floats(-30, 30)), draw(st.floats(-15, 15)), draw(st.floats(300, 2000))
    lens = {
        "fov_deg": draw(st.floats(5, 55)),
        "aperture_mm": draw(st.sampled_from([0.0, 0.0, 60.0])),
    }
    glass = st.fixed_dictionaries(
        {"refractive_index": st.floats(1.3, 2), "thickness_mm": st.floats(1, 20)}
    )
    values = {
        "seed": draw(st.integers(0, 99)),
        "samples_per_pixel": draw(st.integers(1, 5)),
        "orders": draw(st.sampled_from(["all", "truncated"])),
        "behind": draw(st.sampled_from(SIDES)),
        "front": draw(st.sampled_from(SIDES)),
        "panes": [
            draw(glass) | {"absorption_per_m": tint, "wedge_deg": wedge_deg} for _ in range(panes)
        ],
        "camera": camera_towards_glass(*place, width=16, height=16, **lens),
    }
    return make_scene(**values | fixed)

"""Synthetic environments and scenes without files: constant light, a single bright texel, a half, a line."""

import math

import numpy as np
from hypothesis import strategies as st

from brewster.scene.camera import Camera, axes
from brewster.scene.glass import Glazing, Pane
from brewster.scene.scene import Scene
from brewster.scene.world import AssetSource, EnvironmentMap, Plane, Side


class Worlds:
    """Assets without files: images (H, W, 3) by the name of their source."""

    def __init__(self, **pictures):
        self.pictures = {"white": np.ones((16, 32, 3), np.float32), **pictures}

    def map_light(self, lit):
        return self.pictures[lit.source.file] * np.float32(lit.luminance)

    def plane_light(self, plane):
        return self.pictures[plane.source.file] * np.float32(plane.luminance)


def towards(height):
    """Unit directions (H, 2 H, 3) of the texels of a latitude-longitude map whose left edge is at -z."""
    heading = (np.arange(2 * height) + 0.5) / height * np.pi
    polar = (np.arange(height)[:, None] + 0.5) / height * np.pi
    across = np.sin(polar)
    return np.stack(
        np.broadcast_arrays(across * np.sin(heading), np.cos(polar), -across * np.cos(heading)), axis=-1
    )


def soft(height):
    """A smooth map, different in each channel."""
    x, y, z = np.moveaxis(towards(height), -1, 0)
    return np.stack([1 + 0.5 * x * z, 1 + 0.4 * y - 0.3 * z, 1 + 0.6 * x * y + 0.2 * y], -1).astype(
        np.float32
    )


def sun(height, row, column, light=1e4, night=0.0):
    """A dark map with one bright texel."""
    texels = np.full((height, 2 * height, 3), night, np.float32)
    texels[row, column] = light
    return texels


def bright(shape, where):
    """A black image that is white at an index."""
    texels = np.zeros((*shape, 3), np.float32)
    texels[where] = 1
    return texels


WORLDS = Worlds(
    soft=soft(64),
    mottled=np.random.default_rng(3).random((16, 32, 3), np.float32),
    right=bright((32, 64), np.s_[:, 32:]),
    top=bright((32, 64), np.s_[:16]),
    line=bright((64, 64), np.s_[:, 32]),
)


def around(name="white", **more):
    return Side(map=EnvironmentMap(source=AssetSource(file=name), **more))


def board(name="white", **more):
    return Side(plane=Plane(source=AssetSource(file=name), **{"distance_mm": 800, "width_mm": 8000, **more}))


def at(heading_deg, pitch_deg=0.0, distance_mm=500.0, **more):
    """Values of a camera whose axis meets the centre of the glass."""
    back = axes(heading_deg, pitch_deg)[2]
    return {
        "heading_deg": heading_deg,
        "pitch_deg": pitch_deg,
        "position_mm": tuple(distance_mm * part for part in back),
        **more,
    }


def a_scene(camera=None, panes=(), **more):
    """A scene of 24 x 24 pixels with uniform white light on both sides and ordinary glass; `panes` are dictionaries."""
    if panes:
        gap = 12.0 if len(panes) > 1 else 0.0
        more["glass"] = Glazing(panes=tuple(Pane(**pane) for pane in panes), gap_mm=gap)
    return Scene(
        camera=Camera(**{"width": 24, "height": 24, "fov_deg": 30, **at(0), **(camera or {})}),
        **{"behind": around(), "front": around(), **more},
    )


def pixel_directions(camera):
    """Unit directions (H, W, 3) through the centres of the pixels."""
    right, up, back = map(np.array, axes(camera.heading_deg, camera.pitch_deg))
    half = math.tan(math.radians(camera.fov_deg) / 2)
    x = ((np.arange(camera.width) + 0.5) * 2 - camera.width) / camera.width * half
    y = (camera.height - (np.arange(camera.height) + 0.5) * 2) / camera.width * half
    ways = x[None, :, None] * right + y[:, None, None] * up - back
    return ways / np.linalg.norm(ways, axis=-1, keepdims=True)


def centroid(picture):
    """The centroid of an image (3, H, W), in pixels to the right and down from its upper left corner."""
    light = np.asarray(picture, np.float64).sum(0)
    height, width = light.shape
    return (
        float((light.sum(0) * (np.arange(width) + 0.5)).sum() / light.sum()),
        float((light.sum(1) * (np.arange(height) + 0.5)).sum() / light.sum()),
    )


SIDES = (
    Side(),
    around("mottled", heading_deg=70),
    around("mottled", radius_mm=4000.0),
    board("mottled", width_mm=900),
    Side(map=around("soft").map, plane=board("mottled", width_mm=400, heading_deg=20).plane),
    Side(map=around("soft", radius_mm=5000.0).map, plane=board("mottled", width_mm=400).plane),
)


KINDS = ["smooth", "smooth", "wedge"]


@st.composite
def scenes(draw, **fixed):
    """Scenes of every kind that the analytic renderer supports, except rough glass: panes, tints, wedges, sides, lenses."""
    kind = draw(st.sampled_from(KINDS))
    panes = draw(st.integers(1, 2))
    tint = draw(st.sampled_from([(0.0, 0.0, 0.0), (20.0, 0.0, 5.0)]))
    heading, pitch = draw(st.floats(-30, 30)), draw(st.floats(-15, 15))
    values = {
        "seed": draw(st.integers(0, 99)),
        "samples": draw(st.integers(1, 5)),
        "orders": draw(st.sampled_from(["all", "paper"])),
        "behind": draw(st.sampled_from(SIDES)),
        "front": draw(st.sampled_from(SIDES)),
        "panes": [
            {
                "index": draw(st.floats(1.3, 2)),
                "thickness_mm": draw(st.floats(1, 20)),
                "absorption_per_m": tint,
                "roughness": 0.1 if kind == "rough" else 0.0,
                "wedge_deg": 0.3 if kind == "wedge" else 0.0,
            }
            for _ in range(panes)
        ],
        "camera": at(
            heading,
            pitch,
            draw(st.floats(300, 2000)),
            width=16,
            height=16,
            fov_deg=draw(st.floats(5, 55)),
            aperture_mm=draw(st.sampled_from([0.0, 0.0, 60.0])),
        ),
    }
    return a_scene(**{**values, **fixed})

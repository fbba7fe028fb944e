"""The exact motion of both layers between two frames of a burst, computed from their scenes.

The motion of T is that of the path that passes the panes without a reflection, and the motion of R
that of the reflection at the first surface. These paths carry nearly all light of their layers.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brewster.render.scene.camera import Camera, axes
from brewster.render.scene.glass import Glazing
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import Plane, Side

Float32 = NDArray[np.float32]
_Doubles = NDArray[np.float64]

_REFRACTION_STEPS = 4
"""Each step makes the error of the projection through the glass about a hundred times smaller."""


@dataclass(frozen=True, eq=False)
class LayerMotion:
    """The motion of both layers between two frames, float32 (H, W, 2) each: x to the right and y
    down, in px.

    The values are at the pixels of the first frame. Image coordinates plus motion are the position
    of the same point in the second frame, which may be outside the image or hidden. A pixel without
    content has NaN.
    """

    transmission: Float32
    reflection: Float32

    def relative_px(self) -> float:
        """Returns the median distance by which the layers move relative to each other, in px; NaN
        without content. Glass without effect also has a relative motion, although its reflection is
        black.
        """
        difference = self.reflection - self.transmission
        lengths = np.hypot(difference[..., 0], difference[..., 1])
        lengths = lengths[np.isfinite(lengths)]
        return float(np.median(lengths)) if lengths.size else math.nan


def layer_motion(reference: Scene, frame: Scene) -> LayerMotion:
    """Computes where the points that `reference` shows are in another frame of the same burst.
    Wedges, the roughness of glass and the aperture do not change the result. Every picture has a
    height_mm.
    """
    camera = reference.camera
    y, x = np.mgrid[: camera.height, : camera.width]
    motions = []
    for side, is_behind in ((reference.behind, True), (reference.front, False)):
        content = _Content(side, reference.glass, is_behind=is_behind)
        points = content.intersect(content.origin(camera), _pixel_rays(camera, content.to_glass))
        positions = _project(content, frame.camera, points).reshape(camera.height, camera.width, 2)
        motions.append(np.asarray(positions - np.stack([x, y], -1), np.float32))
    return LayerMotion(*motions)


class _Content:
    """The content of one layer as the camera sees it: that in front of the glass is its mirror
    image behind the glass. Vectors are (N, 3) in the glass frame, in mm.
    """

    def __init__(self, side: Side, glass: Glazing, *, is_behind: bool) -> None:
        self.to_glass = np.array(axes(glass.heading_deg, glass.pitch_deg))
        self._glass = glass
        self._is_behind = is_behind
        self._plane = _plane_frame(side.plane, is_behind) if side.plane else None
        self._radius_mm = side.map.radius_mm if side.map else None

    def origin(self, camera: Camera) -> _Doubles:
        """Returns the position of the camera, (3,)."""
        position: _Doubles = self.to_glass @ np.subtract(
            camera.position_mm, self._glass.position_mm
        )
        return position

    def shift(self, rays: _Doubles) -> _Doubles:
        """Returns how far the refraction moves rays along the glass, compared with straight
        lines.
        """
        moved = np.zeros_like(rays)
        if self._is_behind:
            across = rays[:, :2]
            length = np.linalg.norm(rays, axis=1)
            sine = np.hypot(*across.T) / length
            for pane in self._glass.panes:
                tangents = 1 / np.sqrt(pane.refractive_index**2 - sine**2) - 1 / np.sqrt(
                    1 - sine**2
                )
                moved[:, :2] += across * (pane.thickness_mm * tangents / length)[:, None]
        return moved

    def intersect(self, origin: _Doubles, rays: _Doubles) -> _Doubles:
        """Returns the first points on the rays, homogeneous (N, 4): w is 0 at infinity, NaN without
        content.
        """
        start = origin + self.shift(rays)
        points = np.full((len(rays), 4), np.nan)
        if self._radius_mm is not None:
            points = _dome_points(start, rays, self._radius_mm)
        if self._plane is not None:
            found, is_hit = _plane_points(start, rays, self._plane)
            points[is_hit] = np.pad(found[is_hit], ((0, 0), (0, 1)), constant_values=1)
        return points


def _project(content: _Content, camera: Camera, points: _Doubles) -> _Doubles:
    """Returns the image coordinates (N, 2) of homogeneous points (N, 4). The centre of the first
    pixel is at (0, 0).
    """
    rays = straight = points[:, :3] - points[:, 3:] * content.origin(camera)
    for _ in range(_REFRACTION_STEPS):
        rays = straight - points[:, 3:] * content.shift(rays)
    right, up, back = (content.to_glass @ axis for axis in np.array(camera.axes))
    depth = -(rays @ back)
    depth[depth <= 0] = np.nan  # behind the camera
    scale = camera.width / 2 / camera.half_width
    x = (rays @ right) / depth * scale + camera.width / 2
    y = camera.height / 2 - (rays @ up) / depth * scale
    return np.stack([x, y], -1) - 0.5


def _pixel_rays(camera: Camera, to_glass: _Doubles) -> _Doubles:
    """Returns the directions (N, 3) through the centres of the pixels, row by row, in the glass
    frame.
    """
    right, up, back = (to_glass @ axis for axis in np.array(camera.axes))
    step = 2 * camera.half_width / camera.width
    x = (np.arange(camera.width) + 0.5 - camera.width / 2) * step
    y = (camera.height / 2 - np.arange(camera.height) - 0.5) * step
    rays: _Doubles = x[None, :, None] * right + y[:, None, None] * up - back
    return rays.reshape(-1, 3)


def _dome_points(start: _Doubles, rays: _Doubles, radius_mm: float) -> _Doubles:
    """Intersects rays with a sphere around the glass. An infinite sphere gives points at
    infinity.
    """
    if math.isinf(radius_mm):
        return np.pad(rays, ((0, 0), (0, 1)))
    square = np.vecdot(rays, rays)
    along = np.vecdot(start, rays)
    root = np.sqrt(np.maximum(along**2 - square * (np.vecdot(start, start) - radius_mm**2), 0))
    points = start + ((root - along) / square)[:, None] * rays
    return np.pad(points, ((0, 0), (0, 1)), constant_values=1)


def _plane_points(
    start: _Doubles, rays: _Doubles, plane: _Doubles
) -> tuple[_Doubles, NDArray[np.bool_]]:
    """Intersects rays with a rectangle: its centre, and half its sides as vectors, (3, 3). Returns
    points and hits.
    """
    centre, right, up = plane
    normal = np.cross(right, up)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((centre - start) @ normal) / (rays @ normal)
        points = start + distance[:, None] * rays
        x, y = ((points - centre) @ side / (side @ side) for side in (right, up))
    return points, (distance > 0) & (np.abs(x) <= 1) & (np.abs(y) <= 1)


def _plane_frame(plane: Plane, is_behind: bool) -> _Doubles:
    """Returns the centre of a plane, or of its mirror image, and half its sides as vectors, (3,
    3).
    """
    right, up, _ = np.array(axes(plane.heading_deg, plane.pitch_deg))
    if not is_behind:  # a plane in front faces the glass; then the glass mirrors it
        right = right * (-1, 1, 1)
        up = up * (-1, 1, 1)
    x, y = plane.offset_mm
    return np.array(
        [(x, y, -plane.distance_mm), right * plane.width_mm / 2, up * plane.height_mm / 2]
    )

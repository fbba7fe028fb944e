"""Builds Mitsuba scenes: glass, camera and light as the dictionaries that `mitsuba.load_dict`
takes.

Coordinates are in the glass frame: x right, y up, z towards the camera, the origin at the position
of the glass, in mm. In this frame, the surfaces are z = 0, z = -thickness and so on, and are exact
in float32. A wedge w rotates a far surface about the vertical axis through (0, 0, -thickness), to
the normal (sin w, 0, cos w). With a positive wedge, the pane is thicker on the right. A wedge does
not change the positions of the panes behind it.
"""

import math
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brewster.errors import RecipeError
from brewster.render.environments.assets import Assets
from brewster.render.scene.camera import axes
from brewster.render.scene.glass import Glazing, Pane
from brewster.render.scene.scene import Scene
from brewster.render.scene.world import EnvironmentMap, Plane

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Plugin = dict[str, Any]
"""A dictionary from which Mitsuba builds an object."""

GlassMode = Literal["full", "truncated_transmission", "truncated_reflection", "mirror", "none"]
"""How the glass is rendered.

`full`: all orders; `truncated_transmission`: without reflections (the paper's T);
`truncated_reflection`: no light enters the last pane (the paper's R); `mirror`: the first surface
is a perfect mirror (MR); `none`: no glass (B).
"""

_BLACK: Final[Plugin] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
# Mitsuba returns NaN for a medium with an extinction of 0 in one colour.
_MIN_EXTINCTION_FRACTION: Final = 1e-6
_LENS_GRID: Final = 256  # squares of the mesh along each side of a lens
_MIN_MAP_ROWS: Final = (
    512  # a map is cut off at the glass plane with an error of at most 180 / 512 degrees
)
_RUSSIAN_ROULETTE_DEPTH: Final = 64
"""Russian roulette ends paths only after this number of surfaces, so that faint orders are not
noisy.
"""
_WALL_MM: Final = 1e6  # half the width of each part of the wall around a frame


class MitsubaSceneBuilder:
    """Builds a scene for Mitsuba: in colour, or in grey from one `channel` 0..2 (for polarised
    light). Raises RecipeError if a wedged pane has no thickness somewhere in the view, or meets the
    next pane there.
    """

    def __init__(
        self, mi: ModuleType, scene: Scene, assets: Assets, channel: int | None = None
    ) -> None:
        self.mi = mi
        self.scene = scene
        self._assets = assets
        self._channel = channel
        self._glass = scene.glass
        self._to_glass: Doubles = np.array(axes(scene.glass.heading_deg, scene.glass.pitch_deg))
        offset = np.subtract(scene.camera.position_mm, scene.glass.position_mm)
        self._camera_position = self._to_glass @ offset
        corners = self._first_surface_corners()
        largest = 4 * float(np.abs(corners).max())
        self._half_extent_mm = largest + 50 * scene.glass.depth_mm + scene.camera.aperture_mm
        _check_wedges(scene.glass, corners[:, 0])

    def scene_dict(self, *, lit_from_behind: bool, glass_mode: GlassMode) -> Plugin:
        """Returns the whole scene, lit from one side of the glass. Objects of the other side are
        black. Raises RecipeError if a lens has no thickness somewhere in its frame.
        """
        is_tinted = glass_mode not in {"mirror", "none"} and any(
            any(pane.absorption_per_m) for pane in self._glass.panes
        )
        parts = [*self._surfaces(glass_mode), *self._wall(), *self._emitters(lit_from_behind)]
        kind = "volpath" if is_tinted else "path"
        integrator = {"type": kind, "max_depth": -1, "rr_depth": _RUSSIAN_ROULETTE_DEPTH}
        numbered = {f"part{number}": part for number, part in enumerate(parts)}
        return {"type": "scene", "integrator": integrator, "sensor": self._sensor(), **numbered}

    # Camera and common helpers

    def _sensor(self) -> Plugin:
        """Returns the camera. Mitsuba's cameras look along +z with +x to the left. The pixel filter
        is a box.
        """
        camera = self.scene.camera
        right, up, back = (self._to_glass @ axis for axis in np.array(camera.axes))
        projection: Plugin = {"type": "perspective"}
        if camera.aperture_mm > 0:
            projection = {"type": "thinlens", "aperture_radius": camera.aperture_mm / 2}
            projection["focus_distance"] = camera.focus_mm
        colours = "rgb" if self._channel is None else "luminance"
        film: Plugin = {"type": "hdrfilm", "pixel_format": colours, "component_format": "float32"}
        film |= {"rfilter": {"type": "box"}, "width": camera.width, "height": camera.height}
        return {
            **projection,
            "to_world": self._transform((-right, up, -back), self._camera_position),
            "fov": camera.fov_deg,
            "fov_axis": "x",
            "near_clip": 1.0,
            "far_clip": 1e9,
            "sampler": {"type": "multijitter"},
            "film": film,
        }

    def _transform(
        self, columns: ArrayLike, origin: ArrayLike, scale: ArrayLike = (1, 1, 1)
    ) -> object:
        """Returns the transform of an object with these axes, scaled by `scale`, with its centre at
        `origin`.
        """
        matrix = np.eye(4)
        matrix[:3, :3] = np.asarray(columns).T * scale
        matrix[:3, 3] = origin
        return self.mi.ScalarTransform4f(matrix)

    def _rectangle(
        self, columns: ArrayLike, origin: ArrayLike, half_size: Sequence[float], properties: Plugin
    ) -> Plugin:
        to_world = self._transform(columns, origin, (*half_size, 1))
        return {"type": "rectangle", "to_world": to_world, **properties}

    def _select_channel(self, colours: ArrayLike) -> Floats:
        """Returns the colours (..., 3), or the selected channel repeated three times if the builder
        has a `channel`.
        """
        values = np.asarray(colours, np.float32)
        return (
            values
            if self._channel is None
            else np.repeat(values[..., self._channel, None], 3, axis=-1)
        )

    def _first_surface_corners(self) -> Doubles:
        """Returns points (4, 2) on the first surface: the corners of the frame, or of the view if
        there is none.
        """
        if self._glass.opening_mm:
            return np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * self._glass.opening_mm / 2
        rays = np.array(self.scene.camera.corners()) @ self._to_glass.T
        corners: Doubles = (
            self._camera_position - rays * (self._camera_position[2] / rays[:, 2:])
        )[:, :2]
        return corners

    # The glass

    def _surfaces(self, glass_mode: GlassMode) -> Iterator[object]:
        """Yields all surfaces, the nearest first. A frame limits the first surface; the others
        exceed the view.
        """
        if glass_mode == "none":
            return
        if self._glass.radii_mm:
            yield from self._lens(*self._glass.radii_mm, glass_mode)
            return
        height = 0.0
        max_half_size = (self._half_extent_mm, self._half_extent_mm)
        opening = self._glass.opening_mm
        half_size = (opening[0] / 2, opening[1] / 2) if opening else max_half_size
        for number, pane in enumerate(self._glass.panes, start=1):
            is_last = number == len(self._glass.panes)
            is_entered, material = self._material(pane, glass_mode, is_last=is_last)
            yield self._rectangle(np.eye(3), (0, 0, height), half_size, material)
            if not is_entered:
                return
            height -= pane.thickness_mm
            yield self._far_surface(pane, height, material)
            height -= self._glass.gap_mm
            half_size = max_half_size

    def _far_surface(self, pane: Pane, height: float, material: Plugin) -> Plugin:
        """Returns the pane's far surface. It ends at the edge where the two surfaces of a wedge
        meet.
        """
        sine = math.sin(math.radians(pane.wedge_deg))
        cosine = math.cos(math.radians(pane.wedge_deg))
        edge = -pane.thickness_mm / sine if sine else math.inf
        extent = self._half_extent_mm
        low, high = (max(edge, -extent), extent) if edge < 0 else (-extent, min(edge, extent))
        across = np.array((cosine, 0, -sine))
        middle = np.array((0, 0, height)) + across * (low + high) / 2
        columns = -across, np.array((0, 1, 0)), np.array((-sine, 0, -cosine))
        return self._rectangle(columns, middle, ((high - low) / 2, extent), material)

    def _material(self, pane: Pane, glass_mode: GlassMode, *, is_last: bool) -> tuple[bool, Plugin]:
        """Returns whether light enters the pane, and the materials of its surfaces and its
        interior.
        """
        if glass_mode == "mirror":
            return False, {"bsdf": {"type": "conductor", "material": "none"}}
        kind = ""
        rough = {}
        if pane.roughness and pane.refractive_index > 1:
            kind = "rough"
            rough = {"alpha": pane.roughness, "distribution": "ggx"}
        if glass_mode == "truncated_reflection" and is_last:
            # A conductor with k = 0 has the reflectance of glass, and Mitsuba traces no transmitted
            # rays.
            index = {"type": "spectrum", "value": pane.refractive_index}
            return False, {"bsdf": {"type": kind + "conductor", "eta": index, "k": 0.0, **rough}}
        bsdf = {
            "type": kind + "dielectric",
            "int_ior": pane.refractive_index,
            "ext_ior": 1.0,
            **rough,
        }
        if glass_mode == "truncated_transmission":
            bsdf["specular_reflectance"] = 0.0
        return True, {"bsdf": bsdf, **self._interior_medium(pane)}

    def _interior_medium(self, pane: Pane) -> Plugin:
        """Returns the medium for Beer-Lambert absorption. Colours are at most 1: `scale` is the
        largest, per mm.
        """
        max_absorption = max(pane.absorption_per_m)
        if not max_absorption:
            return {}
        relative = self._select_channel(pane.absorption_per_m) / max_absorption
        sigma = {"type": "rgb", "value": relative.clip(min=_MIN_EXTINCTION_FRACTION).tolist()}
        medium = {
            "type": "homogeneous",
            "albedo": 0.0,
            "sigma_t": sigma,
            "scale": max_absorption / 1000,
        }
        return {"interior": medium}

    def _wall(self) -> Iterator[Plugin]:
        """Yields a black wall around the frame's opening, in the plane of the first surface, as
        four rectangles.
        """
        if not self._glass.opening_mm:
            return
        right, top = np.array(self._glass.opening_mm) / 2
        for sign in (-1, 1):
            for centre, half_width in (
                ((right + _WALL_MM, 0, 0), _WALL_MM),
                ((0, top + _WALL_MM, 0), right),
            ):
                yield self._rectangle(
                    np.eye(3), sign * np.array(centre), (half_width, _WALL_MM), {"bsdf": _BLACK}
                )

    # A lens

    def _lens(self, near_mm: float, far_mm: float, glass_mode: GlassMode) -> Iterator[object]:
        """Yields two spherical surfaces as fine meshes with interpolated normals, and the black
        sides of the frame.
        """
        pane = self._glass.panes[0]
        is_entered, material = self._material(pane, glass_mode, is_last=True)
        near = self._sphere(near_mm, 0.0)
        far = self._sphere(far_mm, -pane.thickness_mm)
        depth = near[0][..., 2] - far[0][..., 2]
        if depth.min() <= 0:
            happened = f"the lens is {depth.min():.3g} mm thick at its thinnest point"
            expected = "expected a thickness above 0 everywhere in the frame"
            raise RecipeError(
                happened, expected, "increase thickness_mm or radii_mm, or reduce opening_mm"
            )
        yield self._mesh(*near, material)
        if is_entered:
            yield self._mesh(far[0][:, ::-1], -far[1][:, ::-1], material)
        low = min(far[0][..., 2].min(), 0.0)
        high = max(near[0][..., 2].max(), 0.0)
        yield from self._frame_sides(low, high)

    def _sphere(self, radius_mm: float, height: float) -> tuple[Doubles, Doubles]:
        """Returns points and normals towards the camera, (rows, columns, 3), of a surface centred
        at `height`.
        """
        half_width, half_height = np.array(self._glass.opening_mm) / 2
        line = np.linspace(-1, 1, _LENS_GRID + 1)
        x, y = np.meshgrid(line * half_width, line * half_height)
        squared = radius_mm**2 - x**2 - y**2
        if squared.min() <= 0:
            happened = f"a sphere with a radius of {abs(radius_mm):g} mm does not fill the frame"
            expected = "expected a radius above half the frame's diagonal"
            raise RecipeError(happened, expected, "increase radii_mm or reduce opening_mm")
        rise = np.copysign(np.sqrt(squared), radius_mm)
        return np.stack([x, y, height - radius_mm + rise], axis=2), np.stack(
            [x, y, rise], axis=2
        ) / radius_mm

    def _mesh(self, points: Doubles, normals: Doubles, material: Plugin) -> object:
        """Returns a mesh of triangles over a grid of points (rows, columns, 3). Mitsuba
        interpolates the normals.
        """
        corner = np.arange(points[..., 0].size).reshape(points.shape[:2])
        squares = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
        a, b, c, d = (part.ravel() for part in squares)
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint32)
        props = self.mi.Properties()
        for name, plugin in material.items():
            props[name] = self.mi.load_dict(plugin)
        mesh = self.mi.Mesh("lens", corner.size, len(faces), has_vertex_normals=True, props=props)
        values = self.mi.traverse(mesh)
        values["vertex_positions"] = points.astype(np.float32).ravel()
        values["vertex_normals"] = normals.astype(np.float32).ravel()
        values["faces"] = faces.ravel()
        values.update()
        return mesh

    def _frame_sides(self, low: float, high: float) -> Iterator[Plugin]:
        """Yields the frame's black inner sides, so that no light passes between frame and glass."""
        right, top = np.array(self._glass.opening_mm) / 2
        x, y, z = np.eye(3)
        middle = (low + high) / 2
        half = (high - low) / 2
        for sign in (-1, 1):
            yield self._rectangle(
                (y, z, x), (sign * right, 0, middle), (top, half), {"bsdf": _BLACK}
            )
            yield self._rectangle(
                (z, x, y), (0, sign * top, middle), (half, right), {"bsdf": _BLACK}
            )

    # The light

    def _emitters(self, lit_from_behind: bool) -> Iterator[Plugin]:
        """Yields the map and the plane of the lit side, and that of the other side in black, which
        hides objects.
        """
        envmap = (self.scene.behind if lit_from_behind else self.scene.front).map
        if envmap:
            emitter = self._envmap if math.isinf(envmap.radius_mm) else self._dome
            yield emitter(envmap, lit_from_behind)
        for side, is_behind in ((self.scene.behind, True), (self.scene.front, False)):
            if side.plane:
                yield self._plane(side.plane, is_behind, is_lit=is_behind == lit_from_behind)

    def _plane(self, plane: Plane, is_behind: bool, *, is_lit: bool) -> Plugin:
        """Returns a plane that faces the glass. Its heading and pitch are as seen by an observer at
        the glass.
        """
        picture = self._select_channel(self._assets.plane_radiance(plane))
        facing = 1 if is_behind else -1
        columns = np.array(axes(plane.heading_deg, plane.pitch_deg)) * (facing, 1, facing)
        height_mm = plane.height_mm or plane.width_mm * picture.shape[0] / picture.shape[1]
        half = plane.width_mm / 2, height_mm / 2
        texture = self._bitmap(picture[::-1], wrap_mode="clamp")  # v increases upwards
        emitter = {"emitter": {"type": "area", "radiance": texture}} if is_lit else {}
        return self._rectangle(
            columns,
            (*plane.offset_mm, -facing * plane.distance_mm),
            half,
            {"bsdf": _BLACK, **emitter},
        )

    def _envmap(self, envmap: EnvironmentMap, is_behind: bool) -> Plugin:
        """Returns a map at infinity. Columns are at texel centres, Mitsuba's first and last row at
        the poles.
        """
        height, width = self._map_size(envmap)
        u, v = (np.arange(width) + 0.5) / width, np.arange(2 * height + 1) / (2 * height)
        columns = self._to_glass @ np.array(axes(envmap.heading_deg, 0)).T
        bitmap = self.mi.Bitmap(self._texels(envmap, is_behind, u, v))
        return {
            "type": "envmap",
            "bitmap": bitmap,
            "to_world": self._transform(columns.T, (0, 0, 0)),
        }

    def _dome(self, envmap: EnvironmentMap, is_behind: bool) -> Plugin:
        height, width = self._map_size(envmap)
        u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
        # Mitsuba's longitude increases in the other direction, so the map is mirrored. The texture
        # repeats, so an additional row at each pole prevents interpolation between the poles.
        texels = np.pad(
            self._texels(envmap, is_behind, u, v)[:, ::-1], ((1, 1), (0, 0), (0, 0)), "edge"
        )
        to_inner_rows = np.array(
            ((1, 0, 0), (0, height / (height + 2), 1 / (height + 2)), (0, 0, 1))
        )
        texture = self._bitmap(
            texels, wrap_mode="repeat", to_uv=self.mi.ScalarTransform3f(to_inner_rows)
        )
        right, up, back = (self._to_glass @ axis for axis in np.array(axes(envmap.heading_deg, 0)))
        to_world = self._transform((-back, -right, up), (0, 0, 0))
        dome = {
            "type": "sphere",
            "to_world": to_world,
            "radius": envmap.radius_mm,
            "flip_normals": True,
        }
        return {**dome, "bsdf": _BLACK, "emitter": {"type": "area", "radiance": texture}}

    def _bitmap(self, image: Floats, **properties: object) -> Plugin:
        bitmap = self.mi.Bitmap(np.ascontiguousarray(image))
        return {"type": "bitmap", "raw": True, "bitmap": bitmap, **properties}

    def _map_size(self, envmap: EnvironmentMap) -> tuple[int, int]:
        """Returns the height and the width of the map. Coarse maps are enlarged by an odd factor:
        it keeps centres.
        """
        height, width = self._assets.map_radiance(envmap).shape[:2]
        factor = math.ceil(_MIN_MAP_ROWS / height) // 2 * 2 + 1
        return factor * height, factor * width

    def _texels(self, envmap: EnvironmentMap, is_behind: bool, u: Doubles, v: Doubles) -> Floats:
        """Returns the map's light at u and v, (rows, columns, 3). It is black on the other side of
        the glass.
        """
        texels = sample_bilinear(self._select_channel(self._assets.map_radiance(envmap)), u, v)
        azimuth = 2 * math.pi * u + math.radians(envmap.heading_deg)
        polar = math.pi * v[:, None]
        x, y, z = self._to_glass[2]
        above_glass = np.sin(polar) * (x * np.sin(azimuth) - z * np.cos(azimuth)) + y * np.cos(
            polar
        )
        texels[(above_glass < 0) != is_behind] = 0
        return texels


def sample_bilinear(texels: Floats, u: Doubles, v: Doubles) -> Floats:
    """Interpolates a map (H, W, 3) bilinearly on the grid of columns u (n,) and rows v (m,) in
    0..1: (m, n, 3). u wraps around; v is clamped to the centres of the first and last row.
    """
    height, width = texels.shape[:2]
    row, column = v * height - 0.5, u * width - 0.5
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    down = (row - top).astype(np.float32)[:, None, None]
    across = (column - left).astype(np.float32)[:, None]
    rows = (
        texels[top.clip(0, height - 1)] * (1 - down) + texels[(top + 1).clip(0, height - 1)] * down
    )
    light: Floats = rows[:, left % width] * (1 - across) + rows[:, (left + 1) % width] * across
    return light


def _check_wedges(glass: Glazing, across: Doubles) -> None:
    """Checks that wedged panes have thickness and do not touch at these x coordinates (n,) on the
    first surface.
    """
    for number, pane in enumerate(glass.panes, start=1):
        added_mm = across * math.tan(math.radians(pane.wedge_deg))
        gap_mm = math.inf if number == len(glass.panes) else glass.gap_mm
        if (pane.thickness_mm + added_mm).min() <= 0 or (gap_mm - added_mm).min() <= 0:
            raise RecipeError(
                f"the wedge of {pane.wedge_deg:g} degrees makes pane {number} meet another surface",
                "expected surfaces that do not meet in the view",
                "reduce wedge_deg, or increase thickness_mm and gap_mm",
            )

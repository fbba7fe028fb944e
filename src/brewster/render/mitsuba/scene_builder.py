"""What the tracer gives to Mitsuba: a scene's glass, camera and light as plain dictionaries.

All stands in the glass's own frame (x right, y up, z towards the camera, the origin at its position, millimetres):
surfaces then are z = 0, z = -thickness and so on, which float32 keeps plane and exactly apart. A wedge turns a far
surface about the upright axis through (0, 0, -thickness): its normal is (sin w, 0, cos w), so that with a positive
wedge the pane is thicker on the right; panes behind it stand as if it had none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brewster.environments.assets import Assets
from brewster.errors import RecipeError
from brewster.scene.camera import axes
from brewster.scene.glass import Glazing, Pane
from brewster.scene.scene import Scene
from brewster.scene.world import EnvironmentMap, Plane

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Plugin = dict[str, Any]
"""What Mitsuba builds an object from."""

Glass = Literal["full", "unreflected", "unentered", "mirror", "none"]
"""As it is; without reflections (the paper's T); what never enters the last pane (the paper's R); a mirror; away."""

_BLACK: Final[Plugin] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
_CLEAREST: Final = 1e-6  # Mitsuba makes NaN of a medium that does not absorb one colour at all
_FACETS: Final = 256  # along each side of a lens
_FINE_ROWS: Final = 512  # of a map, so that its dark half begins within a third of a degree
_LONGEST: Final = 64  # reflections, before chance may end a path
_WALL_MM: Final = 1e6


class MitsubaSceneBuilder:
    """Builds a scene for Mitsuba: in colour, or in grey from one of its colours (for polarised light).

    Raises:
        RecipeError: a wedge or lens has no thickness left somewhere in the view.
    """

    def __init__(self, mi: ModuleType, scene: Scene, assets: Assets, colour: int | None = None) -> None:
        self.mi, self.scene, self._assets, self._colour = mi, scene, assets, colour
        self._glass = scene.glass
        self._to_glass: Doubles = np.array(axes(scene.glass.heading_deg, scene.glass.pitch_deg))
        self._eye = self._to_glass @ np.subtract(scene.camera.position_mm, scene.glass.position_mm)
        self._seen = self._corners()
        self._reach = (
            4 * float(np.abs(self._seen).max()) + 50 * scene.glass.depth_mm + scene.camera.aperture_mm
        )
        _refuse_knife_edges(scene.glass, self._seen[:, 0])

    def room(self, *, behind: bool, glass: Glass) -> Plugin:
        """The whole scene, lit from one side of the glass; the other side's objects are there, in black."""
        tinted = glass not in {"mirror", "none"} and any(
            any(pane.absorption_per_m) for pane in self._glass.panes
        )
        parts = [*self._surfaces(glass), *self._wall(), *self._lights(behind)]
        return {
            "type": "scene",
            "integrator": {"type": "volpath" if tinted else "path", "max_depth": -1, "rr_depth": _LONGEST},
            "sensor": self._sensor(),
            **{f"part{number}": part for number, part in enumerate(parts)},
        }

    # Camera and common tools

    def _sensor(self) -> Plugin:
        """The camera; Mitsuba's own looks along +z with +x to the left, and has another pixel filter."""
        camera = self.scene.camera
        right, up, back = (
            self._to_glass @ axis for axis in np.array(axes(camera.heading_deg, camera.pitch_deg))
        )
        lens = {
            "type": "thinlens",
            "aperture_radius": camera.aperture_mm / 2,
            "focus_distance": camera.focus_mm,
        }
        colours = "rgb" if self._colour is None else "luminance"
        film = {
            "type": "hdrfilm",
            "pixel_format": colours,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        }
        return {
            **(lens if camera.aperture_mm > 0 else {"type": "perspective"}),
            "to_world": self._placed((-right, up, -back), self._eye),
            "fov": camera.fov_deg,
            "fov_axis": "x",
            "near_clip": 1.0,
            "far_clip": 1e9,
            "sampler": {"type": "multijitter"},
            "film": {**film, "width": camera.width, "height": camera.height},
        }

    def _placed(self, columns: ArrayLike, origin: ArrayLike, size: ArrayLike = (1, 1, 1)) -> object:
        """The transform to where `columns` are an object's axes, scaled by `size`, and `origin` is its middle."""
        matrix = np.eye(4)
        matrix[:3, :3] = np.asarray(columns).T * size
        matrix[:3, 3] = origin
        return self.mi.ScalarTransform4f(matrix)

    def _rectangle(
        self, columns: ArrayLike, origin: ArrayLike, half: Sequence[float], more: Plugin
    ) -> Plugin:
        return {"type": "rectangle", "to_world": self._placed(columns, origin, (*half, 1)), **more}

    def _painted(self, colours: ArrayLike) -> Floats:
        """Colours (..., 3) as they are, or the studio's one colour three times."""
        values = np.asarray(colours, np.float32)
        return values if self._colour is None else np.repeat(values[..., self._colour, None], 3, axis=-1)

    def _corners(self) -> Doubles:
        """Places (4, 2) on the first surface: the corners of its frame, or of the view."""
        if self._glass.frame_mm:
            return np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * self._glass.frame_mm / 2
        rays = np.array(self.scene.camera.corners()) @ self._to_glass.T
        corners: Doubles = (self._eye - rays * (self._eye[2] / rays[:, 2:]))[:, :2]
        return corners

    # The glass

    def _surfaces(self, glass: Glass) -> Iterator[object]:
        """From the camera on. Without sides: flat surfaces reach farther than any ray, but for the frame's opening."""
        if glass == "none":
            return
        if self._glass.radii_mm:
            yield from self._lens(*self._glass.radii_mm, glass)
            return
        height, wide = 0.0, (self._reach, self._reach)
        half = (self._glass.frame_mm[0] / 2, self._glass.frame_mm[1] / 2) if self._glass.frame_mm else wide
        for pane in self._glass.panes:
            is_entered, material = self._material(pane, glass)
            yield self._rectangle(np.eye(3), (0, 0, height), half, material)
            if not is_entered:
                return
            height -= pane.thickness_mm
            yield self._far_surface(pane, height, material)
            height -= self._glass.gap_mm
            half = wide

    def _far_surface(self, pane: Pane, height: float, material: Plugin) -> Plugin:
        """Its outside is away from the camera; it ends where a wedge's surfaces meet in a knife's edge."""
        sine, cosine = math.sin(math.radians(pane.wedge_deg)), math.cos(math.radians(pane.wedge_deg))
        edge = -pane.thickness_mm / sine if sine else math.inf
        low, high = (
            (max(edge, -self._reach), self._reach) if edge < 0 else (-self._reach, min(edge, self._reach))
        )
        across = np.array((cosine, 0, -sine))
        middle = np.array((0, 0, height)) + across * (low + high) / 2
        columns = -across, np.array((0, 1, 0)), np.array((-sine, 0, -cosine))
        return self._rectangle(columns, middle, ((high - low) / 2, self._reach), material)

    def _material(self, pane: Pane, glass: Glass) -> tuple[bool, Plugin]:
        """Whether light enters the pane, and what its surfaces (outside in the air) and inside are made of."""
        if glass == "mirror":
            return False, {"bsdf": {"type": "conductor", "material": "none"}}
        rough = {"alpha": pane.roughness, "distribution": "ggx"} if pane.roughness and pane.index > 1 else {}
        kind = "rough" if rough else ""
        if glass == "unentered" and pane is self._glass.panes[-1]:
            # A conductor that does not absorb reflects as glass does, and no ray is lost to what it would let in.
            index = {"type": "spectrum", "value": pane.index}
            return False, {"bsdf": {"type": kind + "conductor", "eta": index, "k": 0.0, **rough}}
        bsdf = {"type": kind + "dielectric", "int_ior": pane.index, "ext_ior": 1.0, **rough}
        if glass == "unreflected":
            bsdf["specular_reflectance"] = 0.0
        return True, {"bsdf": bsdf, **self._inside(pane)}

    def _inside(self, pane: Pane) -> Plugin:
        """Beer-Lambert absorption, per mm. Mitsuba takes colours up to 1, so their strength goes into `scale`."""
        strongest = max(pane.absorption_per_m)
        if not strongest:
            return {}
        share = (self._painted(pane.absorption_per_m) / strongest).clip(min=_CLEAREST)
        sigma = {"type": "rgb", "value": share.tolist()}
        return {
            "interior": {"type": "homogeneous", "albedo": 0.0, "sigma_t": sigma, "scale": strongest / 1000}
        }

    def _wall(self) -> Iterator[Plugin]:
        """Four black strips around the frame's opening, in the plane of the first surface."""
        if not self._glass.frame_mm:
            return
        right, top = self._glass.frame_mm[0] / 2, self._glass.frame_mm[1] / 2
        beside, above = (_WALL_MM, _WALL_MM), (right, _WALL_MM)
        for sign in (-1, 1):
            yield self._rectangle(np.eye(3), (sign * (right + _WALL_MM), 0, 0), beside, {"bsdf": _BLACK})
            yield self._rectangle(np.eye(3), (0, sign * (top + _WALL_MM), 0), above, {"bsdf": _BLACK})

    # A lens

    def _lens(self, near_mm: float, far_mm: float, glass: Glass) -> Iterator[object]:
        """Two spherical surfaces, smooth between fine facets, in a black tunnel as large as the frame."""
        pane = self._glass.panes[0]
        is_entered, material = self._material(pane, glass)
        near, far = self._sphere(near_mm, 0.0), self._sphere(far_mm, -pane.thickness_mm)
        depth = near[0][..., 2] - far[0][..., 2]
        if depth.min() <= 0:
            raise RecipeError(
                f"the lens is {depth.min():.3g} mm thick at its thinnest", "it has glass everywhere in its frame",
                "make it thicker, flatter or smaller",
            )  # fmt: skip
        yield self._mesh(*near, material)
        if is_entered:
            yield self._mesh(far[0][:, ::-1], -far[1][:, ::-1], material)
        low, high = min(far[0][..., 2].min(), 0.0), max(near[0][..., 2].max(), 0.0)
        yield from self._tunnel(low, high)

    def _sphere(self, radius_mm: float, height: float) -> tuple[Doubles, Doubles]:
        """Places and normals towards the camera, (rows, columns, 3), of a surface with its middle at `height`."""
        half_width, half_height = np.array(self._glass.frame_mm) / 2
        line = np.linspace(-1, 1, _FACETS + 1)
        x, y = np.meshgrid(line * half_width, line * half_height)
        squared = radius_mm**2 - x**2 - y**2
        if squared.min() <= 0:
            raise RecipeError(
                f"a sphere of {abs(radius_mm):g} mm does not fill the frame", "its radius is above half the frame's diagonal",
                "enlarge radii_mm or make frame_mm smaller",
            )  # fmt: skip
        rise = np.copysign(np.sqrt(squared), radius_mm)
        return np.stack([x, y, height - radius_mm + rise], axis=2), np.stack([x, y, rise], axis=2) / radius_mm

    def _mesh(self, places: Doubles, normals: Doubles, material: Plugin) -> object:
        """Triangles over a grid of places (rows, columns, 3), with normals between which Mitsuba interpolates."""
        corner = np.arange(places[..., 0].size).reshape(places.shape[:2])
        a, b, c, d = (
            part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1])
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint32)
        props = self.mi.Properties()
        for name, plugin in material.items():
            props[name] = self.mi.load_dict(plugin)
        mesh = self.mi.Mesh("lens", corner.size, len(faces), has_vertex_normals=True, props=props)
        values = self.mi.traverse(mesh)
        values["vertex_positions"] = places.astype(np.float32).ravel()
        values["vertex_normals"] = normals.astype(np.float32).ravel()
        values["faces"] = faces.ravel()
        values.update()
        return mesh

    def _tunnel(self, low: float, high: float) -> Iterator[Plugin]:
        """The frame's black inner sides: no light passes between them and the glass."""
        right, top = np.array(self._glass.frame_mm) / 2
        x, y, z = np.eye(3)
        middle, half = (low + high) / 2, (high - low) / 2
        for sign in (-1, 1):
            yield self._rectangle((y, z, x), (sign * right, 0, middle), (top, half), {"bsdf": _BLACK})
            yield self._rectangle((z, x, y), (0, sign * top, middle), (half, right), {"bsdf": _BLACK})

    # The light

    def _lights(self, behind: bool) -> Iterator[Plugin]:
        """One side's map and plane; the other side's plane stands in black, and all else there is farther out."""
        lit = (self.scene.behind if behind else self.scene.front).map
        if lit:
            yield self._sky(lit, behind) if math.isinf(lit.radius_mm) else self._dome(lit, behind)
        for side, is_behind in ((self.scene.behind, True), (self.scene.front, False)):
            if side.plane:
                yield self._plane(side.plane, is_behind, is_lit=is_behind == behind)

    def _plane(self, plane: Plane, behind: bool, *, is_lit: bool) -> Plugin:
        """It faces the glass, turned by its heading and pitch in the frame of one who looks at it from there."""
        picture = self._painted(self._assets.plane_light(plane))
        facing = 1 if behind else -1
        columns = np.array(axes(plane.heading_deg, plane.pitch_deg)) * (facing, 1, facing)
        half = plane.width_mm / 2, plane.width_mm / 2 * picture.shape[0] / picture.shape[1]
        texture = self._bitmap(picture[::-1], wrap_mode="clamp")  # a rectangle's v goes up
        lamp = {"emitter": {"type": "area", "radiance": texture}} if is_lit else {}
        return self._rectangle(
            columns, (*plane.offset_mm, -facing * plane.distance_mm), half, {"bsdf": _BLACK, **lamp}
        )

    def _sky(self, lit: EnvironmentMap, behind: bool) -> Plugin:
        """Mitsuba's columns are between its texels' centres, like ours; its rows go from pole to pole."""
        height, width = self._sizes(lit)
        u, v = (np.arange(width) + 0.5) / width, np.arange(2 * height + 1) / (2 * height)
        columns = self._to_glass @ np.array(axes(lit.heading_deg, 0)).T
        texels = self._texels(lit, behind, u, v)
        return {
            "type": "envmap",
            "bitmap": self.mi.Bitmap(texels),
            "to_world": self._placed(columns.T, (0, 0, 0)),
        }

    def _dome(self, lit: EnvironmentMap, behind: bool) -> Plugin:
        """A sphere around the glass that shines inwards. Its longitude runs the other way, so the map is mirrored.

        A row more at both poles stops Mitsuba's texture, which repeats, from mixing one pole into the other.
        """
        height, width = self._sizes(lit)
        u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
        texels = np.pad(self._texels(lit, behind, u, v)[:, ::-1], ((1, 1), (0, 0), (0, 0)), "edge")
        inner = np.array(((1, 0, 0), (0, height / (height + 2), 1 / (height + 2)), (0, 0, 1)))
        texture = self._bitmap(texels, wrap_mode="repeat", to_uv=self.mi.ScalarTransform3f(inner))
        right, up, back = (self._to_glass @ axis for axis in np.array(axes(lit.heading_deg, 0)))
        return {
            "type": "sphere",
            "to_world": self._placed((-back, -right, up), (0, 0, 0)),
            "radius": lit.radius_mm,
            "flip_normals": True,
            "bsdf": _BLACK,
            "emitter": {"type": "area", "radiance": texture},
        }

    def _bitmap(self, picture: Floats, **more: object) -> Plugin:
        return {
            "type": "bitmap",
            "raw": True,
            "bitmap": self.mi.Bitmap(np.ascontiguousarray(picture)),
            **more,
        }

    def _sizes(self, lit: EnvironmentMap) -> tuple[int, int]:
        """Of the map, times an odd number if it is coarse: then every texel's centre is still one."""
        height, width = self._assets.map_light(lit).shape[:2]
        times = math.ceil(_FINE_ROWS / height) // 2 * 2 + 1
        return times * height, times * width

    def _texels(self, lit: EnvironmentMap, behind: bool, u: Doubles, v: Doubles) -> Floats:
        """The map's light at columns u and rows v, (rows, columns, 3); black on the other side of the glass."""
        texels = between(self._painted(self._assets.map_light(lit)), u, v)
        azimuth, polar = 2 * math.pi * u + math.radians(lit.heading_deg), math.pi * v[:, None]
        x, y, z = self._to_glass[2]
        above_glass = np.sin(polar) * (x * np.sin(azimuth) - z * np.cos(azimuth)) + y * np.cos(polar)
        texels[(above_glass < 0) != behind] = 0
        return texels


def between(texels: Floats, u: Doubles, v: Doubles) -> Floats:
    """A map (H, W, 3) between its texels' centres, at all columns u (n,) and rows v (m,) in 0..1: (m, n, 3).

    Bilinear; the left edge joins the right one, the first and last row reach to the poles.
    """
    height, width = texels.shape[:2]
    row, column = v * height - 0.5, u * width - 0.5
    top, left = np.floor(row).astype(int), np.floor(column).astype(int)
    down = (row - top).astype(np.float32)[:, None, None]
    across = (column - left).astype(np.float32)[:, None]
    rows = texels[top.clip(0, height - 1)] * (1 - down) + texels[(top + 1).clip(0, height - 1)] * down
    light: Floats = rows[:, left % width] * (1 - across) + rows[:, (left + 1) % width] * across
    return light


def _refuse_knife_edges(glass: Glazing, across: Doubles) -> None:
    """A wedged pane has thickness, and clear air behind it, at all these places (n,) across the first surface."""
    for number, pane in enumerate(glass.panes):
        more = across * math.tan(math.radians(pane.wedge_deg))
        is_last = number == len(glass.panes) - 1
        if (pane.thickness_mm + more).min() <= 0 or (not is_last and (glass.gap_mm - more).min() <= 0):
            raise RecipeError(
                f"the wedge of {pane.wedge_deg:g} degrees makes pane {number + 1} meet another surface in the view",
                "its surfaces stay apart from all others",
                "reduce wedge_deg, or enlarge thickness_mm and gap_mm",
            )

"""Draws random scenes. The same recipe, catalog, seed and index give the same scene on every
machine.
"""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from pydantic import ValidationError

from brewster import __version__
from brewster.base.settings import FrozenModel
from brewster.errors import RecipeError, expected_value
from brewster.render.scene.camera import Camera, axes, dot
from brewster.render.scene.glass import Glazing, Pane, Point
from brewster.render.scene.recipe import (
    BurstRecipe,
    CameraRecipe,
    CameraResponseRecipe,
    GlassRecipe,
    SceneRecipe,
    SideRecipe,
)
from brewster.render.scene.scene import BurstFrame, CameraResponse, Scene
from brewster.render.scene.world import AssetSource, Cloth, EnvironmentMap, Plane, Side

_MAX_ATTEMPTS: Final = 100
_MAX_FOCUS_MM: Final = 1e6


class Asset(FrozenModel):
    """A map or a picture in a catalog: source, size in px, and a category such as indoor, outdoor
    or night.
    """

    source: AssetSource
    width: int
    height: int
    category: str = ""


class Catalog(FrozenModel):
    """The environment maps and pictures from which the content of scenes is drawn."""

    maps: tuple[Asset, ...] = ()
    pictures: tuple[Asset, ...] = ()


def draw(recipe: SceneRecipe, catalog: Catalog, seed: int, index: int) -> Scene:
    """Draws the scene with this index. An impossible scene, such as a view at a grazing angle, is
    drawn again. Raises RecipeError if the catalog has no suitable maps or pictures, or 100 attempts
    failed.
    """
    number, frame = divmod(index, recipe.frames)
    return draw_frames(recipe, catalog, seed, number)[frame]


def draw_frames(recipe: SceneRecipe, catalog: Catalog, seed: int, index: int) -> list[Scene]:
    """Draws the scenes of all frames of the burst with this index, as `draw`: one scene without a
    table [burst].
    """
    key = f"{recipe.name}/{seed}/{index}"
    rng = _SceneRng(key)
    moves = _draw_moves(recipe.burst, _SceneRng(f"{key}/burst")) if recipe.burst else None
    reason = ""
    for _ in range(_MAX_ATTEMPTS):
        try:
            scene = _draw_once(recipe, catalog, rng, seed, index)
            if recipe.burst is None or moves is None:
                return [scene]
            changes = _draw_light(recipe.burst, _SceneRng(f"{key}/light"))
            return _frames(scene, moves, catalog, changes)
        except ValidationError as error:
            reason = expected_value(error.errors()[0])
    happened = f"the recipe {recipe.name!r} gave no possible scene in {_MAX_ATTEMPTS} attempts"
    raise RecipeError(happened, reason, "change its ranges")


def _six_digits(number: float) -> float:
    """Rounds to six significant digits, so that scene files are readable."""
    return float(f"{number:.6g}")


class _SceneRng(Random):
    """A random number generator with a method for each type of distribution in recipes."""

    def from_range(self, bounds: tuple[float, float]) -> float:
        return _six_digits(self.uniform(*bounds))

    def from_log_range(self, bounds: tuple[float, float]) -> float:
        return _six_digits(math.exp(self.uniform(*map(math.log, bounds))))

    def bernoulli(self, probability: float) -> bool:
        return self.random() < probability


@dataclass(frozen=True)
class _PartialScene:
    """The glass and the camera of a scene, which are drawn before its two sides."""

    rng: _SceneRng
    catalog: Catalog
    glass: Glazing
    camera: Camera

    @property
    def camera_distance_mm(self) -> float:
        """The distance of the camera from the first surface. All glazings that are drawn are at the
        origin.
        """
        return self.to_glass(self.camera.position_mm)[2]

    def to_glass(self, vector: Point) -> Point:
        """Returns a vector of the world in the axes of the glass."""
        right, up, back = axes(self.glass.heading_deg, self.glass.pitch_deg)
        return dot(vector, right), dot(vector, up), dot(vector, back)


def _draw_once(
    recipe: SceneRecipe, catalog: Catalog, rng: _SceneRng, seed: int, index: int
) -> Scene:
    if recipe.setups:
        setups, weights = zip(*recipe.setups.items(), strict=True)
        recipe = recipe.with_setup(rng.choices(setups, weights)[0])
    glass = _draw_glazing(recipe.glass, rng)
    behind_map = _choose_map(recipe.behind, recipe.camera, catalog, rng)
    front_map = _choose_map(recipe.front, recipe.camera, catalog, rng)
    camera = _draw_camera(recipe, [(recipe.behind, behind_map), (recipe.front, front_map)], rng)
    partial = _PartialScene(rng, catalog, glass, camera)
    behind = _draw_side(recipe.behind, behind_map, partial, glass.depth_mm)
    front = _draw_side(recipe.front, front_map, partial, partial.camera_distance_mm)
    return Scene(
        recipe=recipe.name,
        seed=seed,
        index=index,
        version=__version__,
        orders=recipe.orders,
        samples_per_pixel=recipe.rough_samples_per_pixel
        if glass.is_rough
        else recipe.samples_per_pixel,
        glass=glass,
        camera=_focus_camera(recipe.camera, partial, behind, front),
        behind=behind,
        front=front,
        camera_response=_draw_camera_response(recipe.camera_response, rng),
    )


def _draw_glazing(recipe: GlassRecipe, rng: _SceneRng) -> Glazing:
    count = 2 if rng.bernoulli(recipe.double_probability) else 1
    is_structural = rng.bernoulli(recipe.structural_probability)
    thickness_mm = recipe.structural_thickness_mm if is_structural else recipe.thickness_mm
    tint = rng.choice(recipe.absorption_per_m)
    strength = rng.from_log_range(recipe.tint_strength)
    rough = rng.from_log_range(recipe.roughness) if rng.bernoulli(recipe.rough_probability) else 0.0
    wedged = rng.bernoulli(recipe.wedge_probability)
    red, green, blue = (_six_digits(colour * strength) for colour in tint)
    refractive_index = rng.from_range(recipe.refractive_index)

    def pane() -> Pane:
        return Pane(
            thickness_mm=rng.from_log_range(thickness_mm),
            refractive_index=refractive_index,
            absorption_per_m=(red, green, blue),
            roughness=rough,
            wedge_deg=rng.from_log_range(recipe.wedge_deg) * rng.choice((-1, 1)) if wedged else 0.0,
        )

    return Glazing(
        panes=tuple(pane() for _ in range(count)),
        gap_mm=rng.from_range(recipe.gap_mm) if count > 1 else 0.0,
        pitch_deg=rng.from_range(recipe.pitch_deg),
    )


def _choose_map(
    recipe: SideRecipe, camera: CameraRecipe, catalog: Catalog, rng: _SceneRng
) -> Asset | None:
    """Draws a map that is sharp enough for the widest view; None for a side without one, or if
    pictures replace it.
    """
    sufficient = [
        asset
        for asset in catalog.maps
        if (not recipe.map_categories or asset.category in ("", *recipe.map_categories))
        and _min_fov_deg(asset, recipe, camera) <= camera.fov_deg[1]
    ]
    if not rng.bernoulli(recipe.map_probability) or (
        not sufficient and recipe.plane_probability > 0
    ):
        return None
    if not sufficient:
        raise RecipeError(
            f"none of {len(catalog.maps)} maps is suitable for the recipe",
            f"expected categories {', '.join(recipe.map_categories) or 'any'}, and texels of at "
            "most"
            f" {recipe.max_px_per_texel:g} px for a field of view of {camera.fov_deg[1]:g} degrees",
            "choose other or larger --maps, or a smaller --size",
        )
    return rng.choice(sufficient)


def _min_fov_deg(asset: Asset, recipe: SideRecipe, camera: CameraRecipe) -> float:
    """Returns the smallest horizontal field of view in degrees at which a texel of the map is at
    most `max_px_per_texel` wide.
    """
    return camera.width * 360 / asset.width / recipe.max_px_per_texel


def _draw_camera(
    recipe: SceneRecipe, maps: list[tuple[SideRecipe, Asset | None]], rng: _SceneRng
) -> Camera:
    """Draws a camera whose axis meets the glass near its centre. Its focus is set in
    `_focus_camera`.
    """
    ranges = recipe.camera
    sharp_fovs_deg = (_min_fov_deg(asset, side, ranges) for side, asset in maps if asset)
    min_fov_deg = max([ranges.fov_deg[0], *sharp_fovs_deg])
    heading = rng.from_range(ranges.incidence_deg)
    pitch = rng.from_range(ranges.pitch_deg)
    _, _, back = axes(heading, pitch)
    distance_mm = rng.from_log_range(ranges.distance_mm) / max(back[2], 0.1)
    x, y, z = (_six_digits(distance_mm * part) for part in back)
    return Camera(
        position_mm=(x, y, z),
        heading_deg=heading,
        pitch_deg=pitch,
        fov_deg=rng.from_range((min_fov_deg, ranges.fov_deg[1])),
        width=ranges.width,
        height=ranges.height,
    )


def _draw_side(
    recipe: SideRecipe, asset: Asset | None, partial: _PartialScene, base_mm: float
) -> Side:
    """Draws a map, a picture, or both. The distance of the picture from the glass is `base_mm` plus
    that drawn.
    """
    rng = partial.rng
    luminance = rng.from_log_range(recipe.luminance)
    # A recipe without partial pictures draws the same numbers as before there were any.
    is_partial = (asset is not None and recipe.partial_probability > 0) and rng.bernoulli(
        recipe.partial_probability
    )
    picture_luminance = luminance
    if is_partial:
        dimmed = _six_digits(luminance / rng.from_log_range(recipe.partial_contrast))
        luminance, picture_luminance = rng.choice(((luminance, dimmed), (dimmed, luminance)))
    environment_map = plane = None
    if asset:
        is_dome = rng.bernoulli(recipe.dome_probability)
        environment_map = EnvironmentMap(
            source=asset.source,
            heading_deg=rng.from_range((0, 360)),
            luminance=luminance,
            radius_mm=rng.from_log_range(recipe.radius_mm) if is_dome else math.inf,
        )
    if rng.bernoulli(recipe.plane_probability) or not asset or is_partial:
        plane = _draw_plane(
            recipe, partial, picture_luminance, base_mm + rng.from_log_range(recipe.distance_mm)
        )
        plane = _cut_to_part(plane, recipe, partial) if is_partial else plane
    return Side(map=environment_map, plane=plane)


def _draw_plane(
    recipe: SideRecipe, partial: _PartialScene, luminance: float, distance_mm: float
) -> Plane:
    """Draws a picture. Its width is `relative_width` times the width that covers the direct or
    mirrored view.
    """
    if not partial.catalog.pictures:
        raise RecipeError(
            "the catalog has no pictures",
            "expected pictures, because the recipe uses them",
            "choose a folder with --photos",
        )
    rng = partial.rng
    asset = partial.rng.choice(partial.catalog.pictures)
    (left, right), (bottom, top) = _visible_extent(partial, distance_mm)
    cover = max(right - left, (top - bottom) * asset.width / asset.height)
    return Plane(
        source=asset.source,
        distance_mm=_six_digits(distance_mm),
        offset_mm=(_six_digits((left + right) / 2), _six_digits((bottom + top) / 2)),
        width_mm=_six_digits(cover * rng.from_range(recipe.relative_width)),
        heading_deg=rng.from_range(recipe.heading_deg),
        pitch_deg=rng.from_range(recipe.heading_deg) / 2,
        luminance=luminance,
        highlight_boost=rng.from_range(recipe.highlight_boost),
    )


def _cut_to_part(plane: Plane, recipe: SideRecipe, partial: _PartialScene) -> Plane:
    """Returns the picture with `partial_width` of the width of the view, and its centre at a random
    point of the view.
    """
    rng = partial.rng
    points = _corner_points(partial, plane.distance_mm)
    weights = [rng.random() for _ in points]
    centre_x, centre_y = (
        _six_digits(sum(map(operator.mul, weights, values)) / sum(weights))
        for values in zip(*points, strict=True)
    )
    left, right = min(x for x, _ in points), max(x for x, _ in points)
    return plane.model_copy(
        update={
            "width_mm": _six_digits((right - left) * rng.from_range(recipe.partial_width)),
            "offset_mm": (centre_x, centre_y),
        }
    )


def _visible_extent(
    partial: _PartialScene, distance_mm: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Returns the ranges of x and y in mm that the view covers at this distance behind the glass,
    or mirrored.
    """
    xs, ys = zip(*_corner_points(partial, distance_mm), strict=True)
    return (min(xs), max(xs)), (min(ys), max(ys))


def _corner_points(partial: _PartialScene, distance_mm: float) -> list[tuple[float, float]]:
    """Returns x and y in mm of the corners of the view at this distance behind the glass, or
    mirrored.
    """
    x, y, z = partial.to_glass(partial.camera.position_mm)
    points = []
    for corner in partial.camera.corners():
        x_rate, y_rate, z_rate = partial.to_glass(corner)
        length = (z + distance_mm) / max(-z_rate, 1e-3)
        points.append((x + length * x_rate, y + length * y_rate))
    return points


def _focus_camera(
    recipe: CameraRecipe, partial: _PartialScene, behind: Side, front: Side
) -> Camera:
    rng = partial.rng
    camera = partial.camera
    focused_side = front if rng.bernoulli(recipe.focus_on_front_probability) else behind
    is_pinhole = rng.bernoulli(recipe.pinhole_probability)
    aperture = rng.from_log_range(recipe.aperture_mm)
    distance_mm = partial.camera_distance_mm + focused_side.distance_mm
    cosine = partial.to_glass(camera.axes[2])[2]
    return camera.model_copy(
        update={
            "focus_mm": _six_digits(min(distance_mm / max(cosine, 0.1), _MAX_FOCUS_MM)),
            "aperture_mm": 0.0 if is_pinhole else aperture,
        }
    )


def _draw_camera_response(recipe: CameraResponseRecipe, rng: _SceneRng) -> CameraResponse:
    return CameraResponse(
        target_luminance=rng.from_log_range(recipe.target_luminance),
        white_balance=rng.choice(recipe.white_balance),
        white_balance_strength=rng.from_range(recipe.white_balance_strength),
        contrast=rng.from_range(recipe.contrast),
        shot_noise=rng.from_range(recipe.shot_noise),
        read_noise=rng.from_range(recipe.read_noise),
        jpeg_quality=rng.randint(*recipe.jpeg_quality),
    )


_CameraMove = tuple[Point, Point, float]
"""A frame relative to the reference frame: mm to the right, up and back; turns of heading, pitch,
roll; exposure.
"""


def _draw_moves(recipe: BurstRecipe, rng: _SceneRng) -> list[_CameraMove]:
    """Draws the move to each frame. They do not depend on the scene, so a scene that is drawn again
    keeps them.
    """
    for _ in range(3):
        rng.random()  # the numbers of keys that were removed: all bursts stay the same
    baseline_mm = rng.from_range(recipe.baseline_mm) * rng.choice((-1, 1))
    direction = math.radians(rng.from_range(recipe.direction_deg))
    reference = recipe.frames // 2
    moves: list[_CameraMove] = []
    is_static = recipe.static_probability > 0 and rng.bernoulli(recipe.static_probability)
    for frame in range(recipe.frames):
        along_mm = baseline_mm * (frame - reference) / (recipe.frames - 1)
        line = along_mm * math.cos(direction), along_mm * math.sin(direction), 0.0
        x, y, z = (_six_digits(place + rng.gauss(0, recipe.tremble_mm)) for place in line)
        heading, pitch, roll = (_six_digits(rng.gauss(0, recipe.tremble_deg)) for _ in range(3))
        exposure_ev = rng.gauss(0, recipe.exposure_jitter_ev)
        if is_static:
            moves.append(((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), exposure_ev))
        else:
            moves.append(((x, y, z), (heading, pitch, roll), exposure_ev))
    moves[reference] = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    return moves


def _draw_light(recipe: BurstRecipe, rng: _SceneRng) -> list[tuple[float | None, Cloth | None]]:
    """Draws the angle of the polariser and the cloth of each frame."""
    frames = range(recipe.frames)
    if recipe.light == "polariser":
        start = rng.from_range((-90, 90))
        steps = [start + 180 * frame / recipe.frames for frame in frames]
        jittered = [step + rng.gauss(0, recipe.polariser_jitter_deg) for step in steps]
        return [(_six_digits((angle + 90) % 180 - 90), None) for angle in jittered]
    if recipe.light == "cloth":
        width = rng.from_range(recipe.cloth_width)
        path = rng.from_range(recipe.cloth_path)
        direction = rng.from_range((0, 360))
        softness = rng.from_log_range(recipe.cloth_softness)
        transmittance = rng.from_range(recipe.cloth_transmittance)
        places = [path * (frame / (recipe.frames - 1) - 0.5) for frame in frames]
        rng.shuffle(places)
        return [
            (
                None,
                Cloth(
                    centre=_six_digits(place + rng.gauss(0, 0.05)),
                    width=width,
                    direction_deg=direction,
                    softness=softness,
                    transmittance=transmittance,
                ),
            )
            for place in places
        ]
    return [(None, None)] * recipe.frames


def _frames(
    scene: Scene,
    moves: Sequence[_CameraMove],
    catalog: Catalog,
    changes: Sequence[tuple[float | None, Cloth | None]],
) -> list[Scene]:
    """Returns the scenes of a burst. `scene` is that of the reference frame without the effects of
    the burst; `changes` are those of the light, from `_draw_light`.
    """
    values = dict(scene)
    response = scene.camera_response
    frames = []
    values |= {name: _with_height(getattr(scene, name), catalog) for name in ("behind", "front")}
    for number, (move, (polariser_deg, cloth)) in enumerate(zip(moves, changes, strict=True)):
        offset_mm, turn_deg, exposure_ev = move
        target = min(1.0, _six_digits(response.target_luminance * 2**exposure_ev))
        camera = scene.camera.moved(offset_mm, turn_deg)
        values["camera"] = camera.model_copy(update={"polariser_deg": polariser_deg})
        values["cloth"] = cloth
        values["camera_response"] = response.model_copy(update={"target_luminance": target})
        values["burst"] = BurstFrame(frame=number, frames=len(moves))
        frames.append(Scene(**values))
    return frames


def _with_height(side: Side, catalog: Catalog) -> Side:
    """Returns the side with the height of its picture, so that the motion of the layers can be
    computed without it.
    """
    plane = side.plane
    if plane is None:
        return side
    asset = next(asset for asset in catalog.pictures if asset.source == plane.source)
    height_mm = plane.width_mm * asset.height / asset.width
    return side.model_copy(update={"plane": plane.model_copy(update={"height_mm": height_mm})})

"""Draws scenes: (recipe, catalog, seed, index) to a Scene, the same on every machine.

scene = draw(read_scene_recipe("window"), catalog, seed=7, index=12)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from random import Random
from typing import Final

from pydantic import ValidationError

from brewster import __version__
from brewster.errors import RecipeError
from brewster.scene.camera import Camera, axes, dot
from brewster.scene.glass import Glazing, Pane, Point
from brewster.scene.recipe import CameraRecipe, DevelopmentRecipe, GlassRecipe, SceneRecipe, SideRecipe
from brewster.scene.scene import Development, Scene
from brewster.scene.values import FrozenModel
from brewster.scene.world import AssetSource, EnvironmentMap, Plane, Side

_TRIES: Final = 100
_FAR_MM: Final = 1e6


class Asset(FrozenModel):
    """A file that can light a scene: its size, and a category such as indoor, outdoor or night."""

    source: AssetSource
    width: int
    height: int
    category: str = ""


class Catalog(FrozenModel):
    """The maps and pictures to draw from."""

    maps: tuple[Asset, ...] = ()
    pictures: tuple[Asset, ...] = ()


def draw(recipe: SceneRecipe, catalog: Catalog, seed: int, index: int) -> Scene:
    """The scene of this number. What turns out impossible (a view that grazes the glass, say) is drawn again.

    Raises:
        RecipeError: the recipe asks for maps or pictures that the catalog lacks, or for the impossible.
    """
    rng = _NamedRng(f"{recipe.name}/{seed}/{index}")
    reason = ""
    for _ in range(_TRIES):
        try:
            return _try(recipe, catalog, rng, seed, index)
        except ValidationError as error:
            reason = error.errors()[0]["msg"].removeprefix("Value error, ")
    raise RecipeError(
        f"the recipe {recipe.name!r} gave no possible scene in {_TRIES} tries", reason, "change its ranges"
    )


def _six(number: float) -> float:
    """Six digits, so that scenes read well."""
    return float(f"{number:.6g}")


class _NamedRng(Random):
    """Random numbers by the words of a recipe."""

    def within(self, bounds: tuple[float, float]) -> float:
        return _six(self.uniform(*bounds))

    def within_log(self, bounds: tuple[float, float]) -> float:
        return _six(math.exp(self.uniform(*map(math.log, bounds))))

    def chance(self, probability: float) -> bool:
        return self.random() < probability


@dataclass(frozen=True)
class _PartialScene:
    """What is settled when the sides are drawn."""

    rng: _NamedRng
    catalog: Catalog
    glass: Glazing
    camera: Camera


def _try(recipe: SceneRecipe, catalog: Catalog, rng: _NamedRng, seed: int, index: int) -> Scene:
    glass = _glass(recipe.glass, rng)
    behind_map = _choose_map(recipe.behind, recipe.camera, catalog, rng)
    front_map = _choose_map(recipe.front, recipe.camera, catalog, rng)
    camera = _camera(recipe, [(recipe.behind, behind_map), (recipe.front, front_map)], rng)
    draft = _PartialScene(rng, catalog, glass, camera)
    behind = _side(recipe.behind, behind_map, draft, glass.depth_mm)
    front = _side(recipe.front, front_map, draft, _camera_in_glass(camera, glass)[2])
    return Scene(
        recipe=recipe.name,
        seed=seed,
        index=index,
        version=__version__,
        orders=recipe.orders,
        samples=recipe.rough_samples if glass.is_rough else recipe.samples,
        glass=glass,
        camera=_focused(recipe.camera, draft, behind, front),
        behind=behind,
        front=front,
        development=_development(recipe.development, rng),
    )


def _glass(recipe: GlassRecipe, rng: _NamedRng) -> Glazing:
    count = 2 if rng.chance(recipe.double_probability) else 1
    structural = rng.chance(recipe.structural_probability)
    tint, strength = rng.choice(recipe.tints), rng.within_log(recipe.tint_strength_log)
    rough = rng.within_log(recipe.roughness_log) if rng.chance(recipe.rough_probability) else 0.0
    wedged = rng.chance(recipe.wedge_probability)
    red, green, blue = (_six(colour * strength) for colour in tint)
    index = rng.within(recipe.index)

    def pane() -> Pane:
        return Pane(
            thickness_mm=rng.within_log(recipe.structural_mm if structural else recipe.thickness_mm),
            index=index,
            absorption_per_m=(red, green, blue),
            roughness=rough,
            wedge_deg=rng.within_log(recipe.wedge_deg_log) * rng.choice((-1, 1)) if wedged else 0.0,
        )

    return Glazing(
        panes=tuple(pane() for _ in range(count)),
        gap_mm=rng.within(recipe.gap_mm) if count > 1 else 0.0,
        pitch_deg=rng.within(recipe.pitch_deg),
    )


def _choose_map(recipe: SideRecipe, camera: CameraRecipe, catalog: Catalog, rng: _NamedRng) -> Asset | None:
    """A map that is sharp enough for the widest view that the recipe allows; None for a side of pictures."""
    wanted = [asset for asset in catalog.maps if not recipe.maps or asset.category in ("", *recipe.maps)]
    sharp = [asset for asset in wanted if _least_fov(asset, recipe, camera) <= camera.fov_deg[1]]
    if not rng.chance(recipe.map_probability) or (not sharp and recipe.picture_probability > 0):
        return None
    if not sharp:
        raise RecipeError(
            f"of {len(catalog.maps)} maps none fits the recipe",
            f"categories {', '.join(recipe.maps) or 'any'}, and texels finer than {recipe.most_px_per_texel:g} px"
            f" at {camera.fov_deg[1]:g} degrees",
            "give other --maps, larger ones, or a smaller --size",
        )
    return rng.choice(sharp)


def _least_fov(asset: Asset, recipe: SideRecipe, camera: CameraRecipe) -> float:
    """The narrowest view in degrees in which a texel of the map is not too many pixels wide."""
    return camera.width * 360 / asset.width / recipe.most_px_per_texel


def _camera(recipe: SceneRecipe, maps: list[tuple[SideRecipe, Asset | None]], rng: _NamedRng) -> Camera:
    """A camera whose axis meets the glass near its middle; where it focuses is settled later."""
    wanted = recipe.camera
    least = max([wanted.fov_deg[0], *(_least_fov(asset, side, wanted) for side, asset in maps if asset)])
    heading, pitch = rng.within(wanted.incidence_deg), rng.within(wanted.pitch_deg)
    _, _, back = axes(heading, pitch)
    away = rng.within_log(wanted.distance_mm_log) / max(back[2], 0.1)
    x, y, z = (_six(away * part) for part in back)
    return Camera(
        position_mm=(x, y, z),
        heading_deg=heading,
        pitch_deg=pitch,
        fov_deg=rng.within((least, wanted.fov_deg[1])),
        width=wanted.width,
        height=wanted.height,
    )


def _side(recipe: SideRecipe, asset: Asset | None, draft: _PartialScene, nearest_mm: float) -> Side:
    """A map, a picture, or both; the picture stands further from the glass than `nearest_mm`."""
    rng = draft.rng
    luminance = rng.within_log(recipe.luminance_log)
    world = plane = None
    if asset:
        is_dome = rng.chance(recipe.dome_probability)
        world = EnvironmentMap(
            source=asset.source,
            heading_deg=rng.within((0, 360)),
            luminance=luminance,
            radius_mm=rng.within_log(recipe.radius_mm_log) if is_dome else math.inf,
        )
    if rng.chance(recipe.picture_probability) or not asset:
        plane = _plane(recipe, draft, luminance, nearest_mm + rng.within_log(recipe.distance_mm_log))
    return Side(map=world, plane=plane)


def _plane(recipe: SideRecipe, draft: _PartialScene, luminance: float, distance_mm: float) -> Plane:
    """A picture that covers as much of the view, straight or mirrored, as the recipe says."""
    if not draft.catalog.pictures:
        raise RecipeError(
            "there are no pictures to draw from", "the recipe asks for them", "name a folder with --photos"
        )
    rng, asset = draft.rng, draft.rng.choice(draft.catalog.pictures)
    (left, right), (bottom, top) = _reach(draft.camera, draft.glass, distance_mm)
    cover = max(right - left, (top - bottom) * asset.width / asset.height)
    return Plane(
        source=asset.source,
        distance_mm=_six(distance_mm),
        offset_mm=(_six((left + right) / 2), _six((bottom + top) / 2)),
        width_mm=_six(cover * rng.within(recipe.fill)),
        heading_deg=rng.within(recipe.turn_deg),
        pitch_deg=rng.within(recipe.turn_deg) / 2,
        luminance=luminance,
        highlights=rng.within(recipe.highlights),
    )


def _camera_in_glass(camera: Camera, glass: Glazing) -> Point:
    (x, y, z), (at_x, at_y, at_z) = camera.position_mm, glass.position_mm
    return _in_glass((x - at_x, y - at_y, z - at_z), glass)


def _in_glass(vector: Point, glass: Glazing) -> Point:
    right, up, back = axes(glass.heading_deg, glass.pitch_deg)
    return dot(vector, right), dot(vector, up), dot(vector, back)


def _reach(
    camera: Camera, glass: Glazing, distance_mm: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """What the view spans on a plane this far beyond the glass, or as far before it in the mirror: x and y, in mm."""
    x, y, z = _camera_in_glass(camera, glass)
    places = []
    for corner in camera.corners():
        across, upward, towards = _in_glass(corner, glass)
        away = (z + distance_mm) / max(-towards, 1e-3)
        places.append((x + away * across, y + away * upward))
    xs, ys = zip(*places, strict=True)
    return (min(xs), max(xs)), (min(ys), max(ys))


def _focused(recipe: CameraRecipe, draft: _PartialScene, behind: Side, front: Side) -> Camera:
    """The camera with its lens set on something of the scene."""
    rng, camera = draft.rng, draft.camera
    on = front if rng.chance(recipe.focus_on_front_probability) else behind
    is_pinhole, aperture = rng.chance(recipe.pinhole_probability), rng.within_log(recipe.aperture_mm_log)
    away = _camera_in_glass(camera, draft.glass)[2] + on.distance_mm
    slant = _in_glass(axes(camera.heading_deg, camera.pitch_deg)[2], draft.glass)[2]
    return camera.model_copy(
        update={
            "focus_mm": _six(min(away / max(slant, 0.1), _FAR_MM)),
            "aperture_mm": 0.0 if is_pinhole else aperture,
        }
    )


def _development(recipe: DevelopmentRecipe, rng: _NamedRng) -> Development:
    return Development(
        exposure=rng.within_log(recipe.exposure),
        white_balance=rng.choice(recipe.white_balance),
        white_balance_strength=rng.within(recipe.white_balance_strength),
        contrast=rng.within(recipe.contrast),
        shot_noise=rng.within(recipe.shot_noise),
        read_noise=rng.within(recipe.read_noise),
        jpeg_quality=rng.randint(*recipe.jpeg_quality),
    )

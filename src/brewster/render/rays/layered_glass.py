"""Smooth parallel panes: Fresnel reflectance, Beer-Lambert absorption and the table of reflection
orders.

s- and p-polarised light are computed separately, each with its own reflectance at every surface,
and averaged at the end. For unpolarised light this is exact. An average at each surface is not
exact, because the mean of a product is not the product of the means. Intensities are added, not
amplitudes, because a pane is thousands of wavelengths thick and interference averages out. Angles
are measured in air and given as cosines of any shape (...).
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import NamedTuple

import torch
from torch import Tensor

from brewster.render.scene.glass import Glazing, Pane

MIN_ORDER_WEIGHT = 1e-5
"""Orders with a smaller weight are not enumerated; the last order of their side gets their light.
"""


def refracted_cosine(cosine: Tensor, index: float) -> Tensor:
    """Returns the cosine of the angle inside the glass, from the cosine in air (Snell's law)."""
    return (1 - (1 - cosine**2) / index**2).clamp(min=1e-9).sqrt()


def fresnel(cosine: Tensor, index: float) -> tuple[Tensor, Tensor]:
    """Returns the reflectance of one surface between air and glass for s- and p-polarised light
    (Fresnel's equations). From inside the glass, at the refracted angle, it is the same (Stokes'
    relations).
    """
    inside = refracted_cosine(cosine, index)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return s**2, p**2


def internal_transmittance(pane: Pane, cosine: Tensor) -> Tensor:
    """Returns the fraction of the light that remains after one traversal of the pane, (3, ...) RGB
    (Beer-Lambert).
    """
    absorption = torch.tensor(pane.absorption_per_m, dtype=cosine.dtype, device=cosine.device)
    path_m = pane.thickness_mm / 1000 / refracted_cosine(cosine, pane.refractive_index)
    return torch.exp(-absorption.view(3, *[1] * cosine.ndim) * path_m)


class Throughput(NamedTuple):
    """Transmittance and reflectance of a glazing along a camera ray; each (3, ...) if tinted, else
    (...).
    """

    transmittance: Tensor
    reflectance: Tensor


def total_throughput(glazing: Glazing, cosine: Tensor, s_share: Tensor | None = None) -> Throughput:
    """Returns the sum of all orders in closed form. Panes are combined by the adding method.

    Args:
        glazing: smooth parallel panes.
        cosine: that of the angle of incidence, (...).
        s_share: the share of s-polarised light that a polariser passes, (...) in 0..1; None is
            unpolarised light.
    """
    s, p = (
        _combine([_slab(*pane) for pane in panes]) for panes in _by_polarisation(glazing, cosine)
    )
    return _mixed(s, p, s_share)


def truncated_throughput(
    glazing: Glazing, cosine: Tensor, s_share: Tensor | None = None
) -> Throughput:
    """Returns the paper's layers: T without any reflection, and R of all light that never enters
    the last pane. For the arguments, see `total_throughput`.
    """
    s, p = map(_truncated_layers, _by_polarisation(glazing, cosine))
    return _mixed(s, p, s_share)


_SurfaceAndInterior = tuple[Tensor, Tensor | float]
"""The reflectance r of a surface of a pane for one polarisation, and the internal transmittance a
of the pane.
"""


def _by_polarisation(glazing: Glazing, cosine: Tensor) -> list[list[_SurfaceAndInterior]]:
    interiors = [
        internal_transmittance(pane, cosine) if any(pane.absorption_per_m) else 1.0
        for pane in glazing.panes
    ]
    surfaces = [fresnel(cosine, pane.refractive_index) for pane in glazing.panes]
    return [[(r[which], a) for r, a in zip(surfaces, interiors, strict=True)] for which in (0, 1)]


def _slab(r: Tensor, a: Tensor | float) -> Throughput:
    """Returns the sums of the paper's two series of light paths in one pane, which are geometric:
    T = (1 - r)^2 a (1 + (r a)^2 + (r a)^4 + ...) and R = r + (1 - r)^2 r a^2 (1 + (r a)^2 + ...).
    """
    transmittance = (1 - r) ** 2 * a / (1 - (r * a) ** 2)
    return Throughput(transmittance, r + transmittance * r * a)


def _combine(layers: list[Throughput]) -> Throughput:
    """Combines layers, the nearest first, each with the same properties from both sides, by the
    adding method (Stokes 1862): T = T1 T2 / (1 - R1 R2), R = R1 + T1^2 R2 / (1 - R1 R2).
    """
    *others, stack = layers
    for t, r in reversed(others):
        interreflection = 1 / (1 - r * stack.reflectance)
        reflectance = r + t**2 * stack.reflectance * interreflection
        stack = Throughput(t * stack.transmittance * interreflection, reflectance)
    return stack


def _truncated_layers(panes: list[_SurfaceAndInterior]) -> Throughput:
    """Returns the transmittance without any reflection, and the reflectance without light that
    enters the last pane.
    """
    transmittance = torch.ones_like(panes[0][0])
    for r, a in panes:
        transmittance = transmittance * (1 - r) ** 2 * a
    # No light of R enters the last pane, so the first surface of the pane replaces the pane.
    first_surface, _ = panes[-1]
    before = [_slab(*pane) for pane in panes[:-1]]
    reflectance = _combine([*before, Throughput(transmittance, first_surface)]).reflectance
    return Throughput(transmittance, reflectance)


def _mixed(s: Throughput, p: Throughput, s_share: Tensor | None) -> Throughput:
    if s_share is not None:
        return Throughput(
            *(torch.lerp(of_p, of_s, s_share) for of_s, of_p in zip(s, p, strict=True))
        )
    return Throughput((s.transmittance + p.transmittance) / 2, (s.reflectance + p.reflectance) / 2)


@dataclass(frozen=True)
class ReflectionOrder:
    """A set of `count` light paths through parallel panes, with equal exit side, in-plane shift and
    throughput.

    `reflections` and `transmissions` are the counts at the surfaces of each pane. `traversals` are
    the counts of each layer: pane, gap, pane and so on. `is_transmitted` is True for light that
    comes from behind the glass.
    """

    is_transmitted: bool
    reflections: tuple[int, ...]
    transmissions: tuple[int, ...]
    traversals: tuple[int, ...]
    count: int

    @property
    def in_truncated_layers(self) -> bool:
        """Whether the paper's T or R contains this order."""
        return sum(self.reflections) == 0 if self.is_transmitted else self.traversals[-1] == 0


@lru_cache(maxsize=256)
def enumerate_orders(reflectances: tuple[float, ...]) -> tuple[ReflectionOrder, ...]:
    """Returns the orders of panes whose surfaces have these reflectances, the brightest first."""
    # A breadth-first search: at each surface, a path is reflected and transmitted. Paths in the
    # same state are merged, because the number of separate paths grows exponentially with the
    # number of reflections.
    surfaces = 2 * len(reflectances)
    zeros = (0,) * len(reflectances), (0,) * len(reflectances), (0,) * (surfaces - 1)
    frontier: dict[_State, int] = {(0, True, *zeros): 1}
    exited: defaultdict[tuple[bool, _Counts, _Counts, _Counts], int] = defaultdict(int)
    while frontier:
        next_frontier: defaultdict[_State, int] = defaultdict(int)
        for state, count in frontier.items():
            for surface, is_downward, *counts in _branches(state):
                if surface in (-1, surfaces):
                    exited[surface == surfaces, *counts] += count  # type: ignore[index]
                elif count * _weight(counts, reflectances) > MIN_ORDER_WEIGHT:
                    next_frontier[(surface, is_downward, *counts)] += count  # type: ignore[index]
        frontier = next_frontier
    orders = [ReflectionOrder(*key, count) for key, count in exited.items()]
    return tuple(
        sorted(
            orders, key=lambda o: -o.count * _weight((o.reflections, o.transmissions), reflectances)
        )
    )


_Counts = tuple[int, ...]
_State = tuple[int, bool, _Counts, _Counts, _Counts]
"""The next surface, whether the path is downward (away from the camera), reflections,
transmissions, traversals.
"""


def _branches(state: _State) -> list[_State]:
    surface, is_downward, reflections, transmissions, traversals = state
    pane = surface // 2
    branches = []
    for is_reflected in (False, True):
        downward = is_downward != is_reflected
        next_surface = surface + (1 if downward else -1)
        layer = min(surface, next_surface)  # outside the stack there is no layer to traverse
        branches.append(
            (
                next_surface,
                downward,
                _incremented(reflections, pane) if is_reflected else reflections,
                transmissions if is_reflected else _incremented(transmissions, pane),
                _incremented(traversals, layer) if 0 <= layer < len(traversals) else traversals,
            )
        )
    return branches


def _incremented(counts: _Counts, which: int) -> _Counts:
    return (*counts[:which], counts[which] + 1, *counts[which + 1 :])


def _weight(
    counts: tuple[_Counts, _Counts] | list[_Counts], reflectances: tuple[float, ...]
) -> float:
    """Returns the product of the reflectances and transmittances along one path of an order,
    without absorption.
    """
    reflections, transmissions = counts[:2]
    return math.prod(
        r**reflected * (1 - r) ** transmitted
        for r, reflected, transmitted in zip(reflectances, reflections, transmissions, strict=True)
    )


def order_throughputs(
    glazing: Glazing,
    cosine: Tensor,
    table: Sequence[ReflectionOrder],
    s_share: Tensor | None = None,
) -> list[Tensor]:
    """Returns the throughput of each order, (3, ...) or (...). For each side, they sum to
    `total_throughput`: the last order of a side also gets the light of all fainter orders.
    """
    interiors = [
        _powers(internal_transmittance(pane, cosine)) if any(pane.absorption_per_m) else None
        for pane in glazing.panes
    ]
    polarised = [
        [(_powers(r), _powers(1 - r)) for r in surfaces]
        for surfaces in zip(
            *(fresnel(cosine, pane.refractive_index) for pane in glazing.panes), strict=True
        )
    ]
    weights = [torch.ones_like(cosine)] * 2 if s_share is None else [2 * s_share, 2 - 2 * s_share]
    throughputs = []
    for order in table:
        throughput = sum(
            (
                weight * _surface_throughput(order, panes)
                for weight, panes in zip(weights, polarised, strict=True)
            ),
            torch.zeros_like(cosine),
        ) * (order.count / 2)
        for power, exponent in zip(interiors, order.traversals[::2], strict=True):
            throughput = throughput * power(exponent) if power and exponent else throughput
        throughputs.append(throughput)
    closed_form = total_throughput(glazing, cosine, s_share)
    for is_transmitted, total in (
        (True, closed_form.transmittance),
        (False, closed_form.reflectance),
    ):
        side = [i for i, order in enumerate(table) if order.is_transmitted == is_transmitted]
        if side:
            throughputs[side[-1]] = throughputs[side[-1]] + (
                total - sum(throughputs[i] for i in side)
            )
    return throughputs


def _powers(base: Tensor) -> Callable[[int], Tensor]:
    """Returns a function that returns integer powers of the base. Each power is computed once."""
    cached = [torch.ones_like(base), base]

    def power(exponent: int) -> Tensor:
        while len(cached) <= exponent:
            cached.append(cached[-1] * base)
        return cached[exponent]

    return power


def _surface_throughput(
    order: ReflectionOrder, panes: list[tuple[Callable[[int], Tensor], Callable[[int], Tensor]]]
) -> Tensor:
    """Returns the product of all reflectances and transmittances along one path of an order, for
    one polarisation.
    """
    factors = [
        power(exponent)
        for (reflect, transmit), reflections, transmissions in zip(
            panes, order.reflections, order.transmissions, strict=True
        )
        for power, exponent in ((reflect, reflections), (transmit, transmissions))
        if exponent
    ]
    return reduce(torch.mul, factors)


def in_plane_shifts_mm(glazing: Glazing, cosine: Tensor) -> list[Tensor]:
    """Returns the shift of a ray along the glass for one traversal of each layer (pane, gap,
    pane...), mm, (...).
    """
    shifts = []
    for pane in glazing.panes:
        inside = refracted_cosine(cosine, pane.refractive_index)
        shifts += [pane.thickness_mm * _tangent(inside), glazing.gap_mm * _tangent(cosine)]
    return shifts[:-1]


def _tangent(cosine: Tensor) -> Tensor:
    return (1 - cosine**2).clamp(min=0).sqrt() / cosine


def ghost_distance_mm(pane: Pane, incidence_deg: float) -> float:
    """Returns the distance in mm between the mirror images in a pane's two surfaces, perpendicular
    to the view: 2 t tan(theta_t) cos(theta_i), with thickness t and the angles of refraction and
    incidence.
    """
    cosine = torch.tensor(math.cos(math.radians(incidence_deg)), dtype=torch.float64)
    return float(
        2 * pane.thickness_mm * _tangent(refracted_cosine(cosine, pane.refractive_index)) * cosine
    )

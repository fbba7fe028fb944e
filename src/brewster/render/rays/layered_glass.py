"""Smooth parallel panes: Fresnel reflectance, Beer-Lambert absorption and the table of reflection orders.

s- and p-polarised light are computed separately, each with its own reflectance at every surface, and averaged at the
end. For unpolarised light this is exact; an average at each surface is not, because the mean of a product is not the
product of the means. Intensities add up, not amplitudes: a pane is thousands of wavelengths thick, so interference
averages out. Angles are given by their cosines, of any shape (...), measured in air.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce

import torch
from torch import Tensor

from brewster.scene.glass import Glazing, Pane

MIN_ORDER_WEIGHT = 1e-5
"""Orders with a smaller weight are not enumerated; the last order of their side gets their light."""


def refracted_cosine(cosine: Tensor, index: float) -> Tensor:
    """Cosine of the angle inside the glass, from the cosine in air (Snell's law)."""
    return (1 - (1 - cosine**2) / index**2).clamp(min=1e-9).sqrt()


def fresnel(cosine: Tensor, index: float) -> tuple[Tensor, Tensor]:
    """Reflectance of one surface between air and glass for s- and p-polarised light (Fresnel's equations).

    The reflectance from inside the glass, at the refracted angle, is the same (Stokes' relations).
    """
    inside = refracted_cosine(cosine, index)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return s**2, p**2


def internal_transmittance(pane: Pane, cosine: Tensor) -> Tensor:
    """Share of the light left after one traversal of the pane, (3, ...) for RGB (Beer-Lambert law)."""
    absorption = torch.tensor(pane.absorption_per_m, dtype=cosine.dtype, device=cosine.device)
    path_m = pane.thickness_mm / 1000 / refracted_cosine(cosine, pane.refractive_index)
    return torch.exp(-absorption.view(3, *[1] * cosine.ndim) * path_m)


@dataclass(frozen=True)
class Throughput:
    """Transmittance and reflectance of a glazing along a camera ray; each (3, ...) if tinted, else (...)."""

    transmittance: Tensor
    reflectance: Tensor


def total_throughput(glazing: Glazing, cosine: Tensor) -> Throughput:
    """The sum of all orders in closed form; panes are combined by the adding method."""
    return _average_polarisations(
        [_combine([_slab(r, a) for r, a in panes]) for panes in _by_polarisation(glazing, cosine)]
    )


def truncated_throughput(glazing: Glazing, cosine: Tensor) -> Throughput:
    """The paper's layers: T without any reflection, and R of all light that never enters the last pane."""
    return _average_polarisations([_truncated_layers(panes) for panes in _by_polarisation(glazing, cosine)])


_TransmittanceReflectance = tuple[Tensor, Tensor]
_SurfaceAndInterior = tuple[Tensor, Tensor | float]
"""The reflectance r of a surface of a pane for one polarisation, and the internal transmittance a of the pane."""


def _by_polarisation(glazing: Glazing, cosine: Tensor) -> list[list[_SurfaceAndInterior]]:
    """The panes for s-polarised light, then for p-polarised light."""
    interiors = [
        internal_transmittance(pane, cosine) if any(pane.absorption_per_m) else 1.0 for pane in glazing.panes
    ]
    surfaces = [fresnel(cosine, pane.refractive_index) for pane in glazing.panes]
    return [[(r[which], a) for r, a in zip(surfaces, interiors, strict=True)] for which in (0, 1)]


def _slab(r: Tensor, a: Tensor | float) -> _TransmittanceReflectance:
    """Transmittance and reflectance of one pane: the paper's two series of light paths, summed.

    T = (1 - r)^2 a (1 + (r a)^2 + (r a)^4 + ...) and R = r + (1 - r)^2 r a^2 (1 + (r a)^2 + ...) are geometric series.
    """
    transmittance = (1 - r) ** 2 * a / (1 - (r * a) ** 2)
    return transmittance, r + transmittance * r * a


def _combine(layers: list[_TransmittanceReflectance]) -> _TransmittanceReflectance:
    """The adding method (Stokes 1862): T = T1 T2 / (1 - R1 R2), R = R1 + T1^2 R2 / (1 - R1 R2).

    It needs layers that are symmetric front to back, which uniform panes are. The first layer is nearest to the camera.
    """
    transmittance, reflectance = layers[-1]
    for t, r in reversed(layers[:-1]):
        interreflection = 1 / (1 - r * reflectance)
        transmittance, reflectance = (
            t * transmittance * interreflection,
            r + t**2 * reflectance * interreflection,
        )
    return transmittance, reflectance


def _truncated_layers(panes: list[_SurfaceAndInterior]) -> _TransmittanceReflectance:
    """Transmittance without any reflection, and reflectance without the light that enters the last pane."""
    transmittance: Tensor | float = 1.0
    for r, a in panes:
        transmittance = transmittance * (1 - r) ** 2 * a
    # No light of R enters the last pane, so the pane's first surface takes the place of the pane.
    first_surface, _ = panes[-1]
    before = [_slab(*pane) for pane in panes[:-1]]
    assert isinstance(transmittance, Tensor)
    return transmittance, _combine([*before, (transmittance, first_surface)])[1]


def _average_polarisations(polarised: list[_TransmittanceReflectance]) -> Throughput:
    (s_transmittance, s_reflectance), (p_transmittance, p_reflectance) = polarised
    return Throughput((s_transmittance + p_transmittance) / 2, (s_reflectance + p_reflectance) / 2)


@dataclass(frozen=True)
class ReflectionOrder:
    """A set of `count` light paths through a parallel stack, with equal exit side, in-plane shift and throughput.

    `reflections` and `transmissions` at surfaces are counted per pane, `traversals` per layer: pane, gap, pane...
    `is_transmitted` is true for light that comes from behind the glass.
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
    """The orders of panes whose surfaces have these reflectances, from the brightest to the faintest.

    A breadth-first search: at each of the 2 N surfaces a path is reflected or transmitted, and paths in the same state
    are merged. Without merging, their number would grow exponentially with the number of reflections.
    """
    surfaces = 2 * len(reflectances)
    zeros = (0,) * len(reflectances), (0,) * len(reflectances), (0,) * (surfaces - 1)
    frontier: dict[_State, int] = {(0, True, *zeros): 1}
    exited: defaultdict[tuple[bool, _Counts, _Counts, _Counts], int] = defaultdict(int)
    while frontier:
        next_frontier: defaultdict[_State, int] = defaultdict(int)
        for state, count in frontier.items():
            for surface, down, *counts in _branches(state):
                if surface in (-1, surfaces):
                    exited[surface == surfaces, *counts] += count  # type: ignore[index]
                elif count * _weight(counts, reflectances) > MIN_ORDER_WEIGHT:
                    next_frontier[(surface, down, *counts)] += count  # type: ignore[index]
        frontier = next_frontier
    orders = [ReflectionOrder(*key, count) for key, count in exited.items()]
    return tuple(
        sorted(orders, key=lambda o: -o.count * _weight((o.reflections, o.transmissions), reflectances))
    )


_Counts = tuple[int, ...]
_State = tuple[int, bool, _Counts, _Counts, _Counts]
"""The next surface, whether the path goes down (away from the camera), reflections, transmissions, traversals."""


def _branches(state: _State) -> list[_State]:
    """The states after transmission and after reflection at the surface of a path."""
    surface, down, reflections, transmissions, traversals = state
    pane = surface // 2
    ahead, back = (surface + 1, surface - 1) if down else (surface - 1, surface + 1)
    return [
        (ahead, down, reflections, _incremented(transmissions, pane), _traversed(traversals, surface, ahead)),
        (
            back,
            not down,
            _incremented(reflections, pane),
            transmissions,
            _traversed(traversals, surface, back),
        ),
    ]


def _incremented(counts: _Counts, which: int) -> _Counts:
    return (*counts[:which], counts[which] + 1, *counts[which + 1 :])


def _traversed(traversals: _Counts, surface: int, next_surface: int) -> _Counts:
    """Counts the traversal of the layer between two surfaces; there is no layer outside the stack."""
    layer = min(surface, next_surface)
    return _incremented(traversals, layer) if 0 <= layer < len(traversals) else traversals


def _weight(counts: tuple[_Counts, _Counts] | list[_Counts], reflectances: tuple[float, ...]) -> float:
    """The product of the reflectances and transmittances along one path of an order, without absorption."""
    reflections, transmissions = counts[:2]
    return math.prod(
        r**reflected * (1 - r) ** transmitted
        for r, reflected, transmitted in zip(reflectances, reflections, transmissions, strict=True)
    )


def order_throughputs(glazing: Glazing, cosine: Tensor, table: Sequence[ReflectionOrder]) -> list[Tensor]:
    """The throughput of each order, (3, ...) or (...).

    For each side they sum to `total_throughput`: the last order of a side also gets the light of all fainter orders, so
    that no energy is lost.
    """
    interiors = [
        _powers(internal_transmittance(pane, cosine)) if any(pane.absorption_per_m) else None
        for pane in glazing.panes
    ]
    polarised = [
        [(_powers(r), _powers(1 - r)) for r in surfaces]
        for surfaces in zip(*(fresnel(cosine, pane.refractive_index) for pane in glazing.panes), strict=True)
    ]
    throughputs = []
    for order in table:
        throughput = sum(
            (_surface_throughput(order, panes) for panes in polarised), torch.zeros_like(cosine)
        ) * (order.count / 2)
        for power, exponent in zip(interiors, order.traversals[::2], strict=True):
            throughput = throughput * power(exponent) if power and exponent else throughput
        throughputs.append(throughput)
    closed_form = total_throughput(glazing, cosine)
    for behind, total in ((True, closed_form.transmittance), (False, closed_form.reflectance)):
        side = [i for i, order in enumerate(table) if order.is_transmitted == behind]
        if side:
            throughputs[side[-1]] = throughputs[side[-1]] + (total - sum(throughputs[i] for i in side))
    return throughputs


def _powers(base: Tensor) -> Callable[[int], Tensor]:
    """A function that returns integer powers of the base; each is computed once."""
    cached = [torch.ones_like(base), base]

    def power(exponent: int) -> Tensor:
        while len(cached) <= exponent:
            cached.append(cached[-1] * base)
        return cached[exponent]

    return power


def _surface_throughput(
    order: ReflectionOrder, panes: list[tuple[Callable[[int], Tensor], Callable[[int], Tensor]]]
) -> Tensor:
    """The product of all reflectances and transmittances along one path of an order, for one polarisation."""
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
    """Shift of a ray along the glass per traversal of each layer (pane, gap, pane...), in mm, (...) each."""
    shifts = []
    for pane in glazing.panes:
        inside = refracted_cosine(cosine, pane.refractive_index)
        shifts += [pane.thickness_mm * _tangent(inside), glazing.gap_mm * _tangent(cosine)]
    return shifts[:-1]


def _tangent(cosine: Tensor) -> Tensor:
    return (1 - cosine**2).clamp(min=0).sqrt() / cosine


def ghost_distance_mm(pane: Pane, incidence_deg: float) -> float:
    """Distance between the mirror images in a pane's two surfaces, across the view, in mm.

    2 t tan(theta_t) cos(theta_i), with the thickness t, the angle of incidence theta_i and that of refraction theta_t.
    """
    cosine = torch.tensor(math.cos(math.radians(incidence_deg)), dtype=torch.float64)
    return float(2 * pane.thickness_mm * _tangent(refracted_cosine(cosine, pane.refractive_index)) * cosine)

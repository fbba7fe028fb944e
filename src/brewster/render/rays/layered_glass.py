"""What a stack of flat panes does to a ray: Fresnel, Beer-Lambert, and the table of its orders.

Light is carried as s- and p-polarised parts, each with its own reflectance at every surface, and averaged at the
end: for unpolarised light that is exact, where averaging at each surface is not. Nothing here knows of pictures.
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

FAINTEST = 1e-5
"""Orders of less weight are not followed; what they carry goes to the last that is."""


def inner_cosine(cosine: Tensor, index: float) -> Tensor:
    """Cosine of the angle inside the glass, from the one outside (Snell's law)."""
    return (1 - (1 - cosine**2) / index**2).clamp(min=1e-9).sqrt()


def fresnel(cosine: Tensor, index: float) -> tuple[Tensor, Tensor]:
    """Reflectance of one surface between air and glass for s- and p-polarised light (Fresnel's equations).

    `cosine`, of any shape, is that of the angle in the air; light that comes from inside is reflected alike.
    """
    inside = inner_cosine(cosine, index)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return s**2, p**2


def pass_once(pane: Pane, cosine: Tensor) -> Tensor:
    """What one traversal of the pane leaves of light, (3, ...) for cosines (...) (Beer-Lambert)."""
    absorption = torch.tensor(pane.absorption_per_m, dtype=cosine.dtype, device=cosine.device)
    path_m = pane.thickness_mm / 1000 / inner_cosine(cosine, pane.index)
    return torch.exp(-absorption.view(3, *[1] * cosine.ndim) * path_m)


@dataclass(frozen=True)
class Throughput:
    """How much of the light of the two sides a glazing sends along a camera ray; each (3, ...) or (...)."""

    transmitted: Tensor
    reflected: Tensor


def all_orders(glazing: Glazing, cosine: Tensor) -> Throughput:
    """The sum of all orders in closed form: panes joined by the adding formula, s and p apart."""
    return _averaged([_add_up([_pane(r, a) for r, a in lane]) for lane in _lanes(glazing, cosine)])


def paper_orders(glazing: Glazing, cosine: Tensor) -> Throughput:
    """T without any reflection; R of all that never enters the last pane (the paper's two layers)."""
    return _averaged([_paper_pair(lane) for lane in _lanes(glazing, cosine)])


_Pair = tuple[Tensor, Tensor]
_Lane = list[tuple[Tensor, Tensor | float]]


def _lanes(glazing: Glazing, cosine: Tensor) -> list[_Lane]:
    """For s and for p: each pane's reflectance at a surface, and what one traversal leaves."""
    left = [pass_once(pane, cosine) if any(pane.absorption_per_m) else 1.0 for pane in glazing.panes]
    both = [fresnel(cosine, pane.index) for pane in glazing.panes]
    return [[(r[which], a) for r, a in zip(both, left, strict=True)] for which in (0, 1)]


def _pane(r: Tensor, a: Tensor | float) -> _Pair:
    """Transmittance and reflectance of a pane whose surfaces reflect r and whose glass leaves a."""
    through = (1 - r) ** 2 * a / (1 - (r * a) ** 2)
    return through, r + through * r * a


def _add_up(pairs: list[_Pair]) -> _Pair:
    """Stacks of layers, each the same from both sides: T = T1 T2 / (1 - R1 R2'), from the camera on."""
    through, back = pairs[-1]
    for t, r in reversed(pairs[:-1]):
        echo = 1 / (1 - r * back)
        through, back = t * through * echo, r + t**2 * back * echo
    return through, back


def _paper_pair(lane: _Lane) -> _Pair:
    through: Tensor | float = 1.0
    for r, a in lane:
        through = through * (1 - r) ** 2 * a
    first_surface, _ = lane[-1]
    before = [_pane(*panes) for panes in lane[:-1]]
    assert isinstance(through, Tensor)
    return through, _add_up([*before, (through, first_surface)])[1]


def _averaged(lanes: list[_Pair]) -> Throughput:
    (s_through, s_back), (p_through, p_back) = lanes
    return Throughput((s_through + p_through) / 2, (s_back + p_back) / 2)


@dataclass(frozen=True)
class ReflectionOrder:
    """Paths through a parallel stack that end alike: `count` of them, on one side, shifted and weakened equally.

    `reflections` and `transmissions` are counted per pane, `traversals` per layer: pane, gap, pane...
    """

    behind: bool
    reflections: tuple[int, ...]
    transmissions: tuple[int, ...]
    traversals: tuple[int, ...]
    count: int

    @property
    def in_paper(self) -> bool:
        """Whether the paper's T or R has it."""
        return sum(self.reflections) == 0 if self.behind else self.traversals[-1] == 0


@lru_cache(maxsize=256)
def orders(reflectances: tuple[float, ...]) -> tuple[ReflectionOrder, ...]:
    """The orders of panes whose surfaces reflect about this much, the brightest paths first.

    Every path is a word of reflections and transmissions at the 2 N surfaces; words that end alike are merged.
    """
    surfaces = 2 * len(reflectances)
    nothing = (0,) * len(reflectances), (0,) * len(reflectances), (0,) * (surfaces - 1)
    reached: dict[_State, int] = {(0, True, *nothing): 1}
    ended: defaultdict[tuple[bool, _Counts, _Counts, _Counts], int] = defaultdict(int)
    while reached:
        following: defaultdict[_State, int] = defaultdict(int)
        for state, count in reached.items():
            for surface, down, *counts in _next(state):
                if surface in (-1, surfaces):
                    ended[surface == surfaces, *counts] += count  # type: ignore[index]
                elif count * _weight(counts, reflectances) > FAINTEST:
                    following[(surface, down, *counts)] += count  # type: ignore[index]
        reached = following
    found = [ReflectionOrder(*key, count) for key, count in ended.items()]
    return tuple(
        sorted(found, key=lambda o: -o.count * _weight((o.reflections, o.transmissions), reflectances))
    )


_Counts = tuple[int, ...]
_State = tuple[int, bool, _Counts, _Counts, _Counts]


def _next(state: _State) -> list[_State]:
    """A path that meets a surface goes on through it, or turns back."""
    surface, down, reflections, transmissions, traversals = state
    pane = surface // 2
    ahead, back = (surface + 1, surface - 1) if down else (surface - 1, surface + 1)
    return [
        (ahead, down, reflections, _more(transmissions, pane), _crossed(traversals, surface, ahead)),
        (back, not down, _more(reflections, pane), transmissions, _crossed(traversals, surface, back)),
    ]


def _more(counts: _Counts, which: int) -> _Counts:
    return (*counts[:which], counts[which] + 1, *counts[which + 1 :])


def _crossed(traversals: _Counts, surface: int, following: int) -> _Counts:
    layer = min(surface, following)
    return _more(traversals, layer) if 0 <= layer < len(traversals) else traversals


def _weight(counts: tuple[_Counts, _Counts] | list[_Counts], reflectances: tuple[float, ...]) -> float:
    reflections, transmissions = counts[:2]
    return math.prod(
        r**reflected * (1 - r) ** through
        for r, reflected, through in zip(reflectances, reflections, transmissions, strict=True)
    )


def order_shares(glazing: Glazing, cosine: Tensor, table: Sequence[ReflectionOrder]) -> list[Tensor]:
    """Each order's share of its light, (3, ...) or (...); per side they sum to `all_orders`."""
    left = [
        _powers(pass_once(pane, cosine)) if any(pane.absorption_per_m) else None for pane in glazing.panes
    ]
    lanes = [
        [(_powers(r), _powers(1 - r)) for r in polarised]
        for polarised in zip(*(fresnel(cosine, pane.index) for pane in glazing.panes), strict=True)
    ]
    shares = []
    for order in table:
        share = sum((_surfaces(order, lane) for lane in lanes), torch.zeros_like(cosine)) * (order.count / 2)
        for powers, times in zip(left, order.traversals[::2], strict=True):
            share = share * powers(times) if powers and times else share
        shares.append(share)
    whole = all_orders(glazing, cosine)
    for behind, total in ((True, whole.transmitted), (False, whole.reflected)):
        mine = [i for i, order in enumerate(table) if order.behind == behind]
        if mine:
            shares[mine[-1]] = shares[mine[-1]] + (total - sum(shares[i] for i in mine))
    return shares


def _powers(base: Tensor) -> Callable[[int], Tensor]:
    """The base's powers, each multiplied out once."""
    known = [torch.ones_like(base), base]

    def power(exponent: int) -> Tensor:
        while len(known) <= exponent:
            known.append(known[-1] * base)
        return known[exponent]

    return power


def _surfaces(
    order: ReflectionOrder, lane: list[tuple[Callable[[int], Tensor], Callable[[int], Tensor]]]
) -> Tensor:
    """What the surfaces leave to one path of an order, for one polarisation."""
    factors = [
        power(times)
        for (reflect, transmit), reflections, transmissions in zip(
            lane, order.reflections, order.transmissions, strict=True
        )
        for power, times in ((reflect, reflections), (transmit, transmissions))
        if times
    ]
    return reduce(torch.mul, factors)


def shift_per_traversal(glazing: Glazing, cosine: Tensor) -> list[Tensor]:
    """How far along the glass one traversal of each layer (pane, gap, pane...) takes a ray, in mm."""
    shifts = []
    for pane in glazing.panes:
        inside = inner_cosine(cosine, pane.index)
        shifts += [pane.thickness_mm * _tangent(inside), glazing.gap_mm * _tangent(cosine)]
    return shifts[:-1]


def _tangent(cosine: Tensor) -> Tensor:
    return (1 - cosine**2).clamp(min=0).sqrt() / cosine


def ghost_distance_mm(pane: Pane, incidence_deg: float) -> float:
    """How far apart the mirror images of a pane's two surfaces are: 2 t tan(theta_t) cos(theta_i)."""
    cosine = torch.tensor(math.cos(math.radians(incidence_deg)), dtype=torch.float64)
    return float(2 * pane.thickness_mm * _tangent(inner_cosine(cosine, pane.index)) * cosine)

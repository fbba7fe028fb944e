"""Layered glass, compared with independently written formulas."""

import math

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from brewster.render.analytic import render
from brewster.render.rays.layered_glass import (
    all_orders,
    enumerate_orders,
    fresnel,
    ghost_distance_mm,
    internal_transmittance,
    lateral_shifts_mm,
    order_throughputs,
    paper_orders,
    refracted_cosine,
)
from brewster.render.rays.rough_glass import _reflectances
from brewster.scene.glass import Glazing, Pane
from synthetic_scenes import ASSETS, camera_towards_glass, make_scene, plane_side

some = settings(max_examples=40, deadline=None, database=None)
COSINES = st.floats(0.05, 1)
INDICES = st.floats(1, 2)
TINTS = st.tuples(*[st.floats(0, 100)] * 3)
PANES = st.lists(
    st.builds(Pane, index=INDICES, thickness_mm=st.floats(1, 50), absorption_per_m=TINTS),
    min_size=1,
    max_size=3,
)


def glazing(panes):
    panes = list(panes)
    return Glazing(panes=tuple(panes), gap_mm=10.0 if len(panes) > 1 else 0.0)


def exact(number):
    return torch.tensor(float(number), dtype=torch.float64)


def surface(cosine, here, beyond):
    """Fresnel reflectances for s- and p-polarised light, from the angles on both sides."""
    one = math.acos(cosine)
    other = math.asin(here * math.sin(one) / beyond)
    if one < 1e-6:
        return (((here - beyond) / (here + beyond)) ** 2,) * 2
    s = math.sin(one - other) / math.sin(one + other)
    p = math.tan(one - other) / math.tan(one + other)
    return s**2, p**2


def slab(pane, cosine):
    """T and R of one clear pane for s- and p-polarised light: all orders as a geometric series."""
    return [((1 - r) / (1 + r), 2 * r / (1 + r)) for r in surface(cosine, 1, pane.index)]


def test_a_pane_of_ordinary_glass_reflects_about_eight_percent():
    shares = all_orders(Glazing(), exact(1))
    assert float(shares.reflected) == pytest.approx(0.08 / 1.04, rel=1e-9)
    assert float(shares.reflected) == pytest.approx(0.0769, abs=5e-5)
    assert float(shares.transmitted) == pytest.approx(0.96 / 1.04, rel=1e-9)


@pytest.mark.parametrize("index", [1.1, 1.5, 2.4])
def test_p_polarised_light_is_not_reflected_at_brewsters_angle(index):
    s, p = fresnel(exact(math.cos(math.atan(index))), index)
    assert float(p) == pytest.approx(0, abs=1e-12)
    assert float(s) == pytest.approx(((index**2 - 1) / (index**2 + 1)) ** 2, rel=1e-9)


@some
@given(st.floats(0.05, 0.999), st.floats(1.01, 2.5))
def test_a_surface_reflects_alike_from_both_sides(cosine, index):
    inside = float(refracted_cosine(exact(cosine), index))
    assert math.sqrt(1 - inside**2) * index == pytest.approx(math.sqrt(1 - cosine**2), abs=1e-9)
    outside = [float(r) for r in fresnel(exact(cosine), index)]
    assert outside == pytest.approx(surface(cosine, 1, index), rel=1e-6, abs=1e-9)
    assert outside == pytest.approx(surface(inside, index, 1), rel=1e-6, abs=1e-9)
    assert outside == pytest.approx(
        [float(r) for r in _reflectances(exact(inside), index, 1.0)], rel=1e-6, abs=1e-9
    )


def test_beyond_the_critical_angle_glass_reflects_all_from_inside():
    critical = math.sqrt(1 - 1 / 1.5**2)
    for cosine, is_total in ((critical - 0.01, True), (critical + 0.01, False)):
        s, p = _reflectances(exact(cosine), 1.5, 1.0)
        assert (float(s) == 1, float(p) == 1) == (is_total, is_total)


@some
@given(PANES, COSINES)
def test_clear_glass_loses_no_light(panes, cosine):
    clear = glazing(pane.model_copy(update={"absorption_per_m": (0.0, 0.0, 0.0)}) for pane in panes)
    shares = all_orders(clear, exact(cosine))
    assert float(shares.transmitted + shares.reflected) == pytest.approx(1, abs=1e-9)


@some
@given(PANES, COSINES)
def test_tinted_glass_only_loses_light(panes, cosine):
    shares = all_orders(glazing(panes), exact(cosine))
    assert (shares.transmitted >= 0).all()
    assert (shares.reflected >= 0).all()
    assert (shares.transmitted + shares.reflected <= 1 + 1e-9).all()


@some
@given(PANES, COSINES)
def test_a_stack_transmits_alike_from_both_sides(panes, cosine):
    one, other = (all_orders(glazing(order), exact(cosine)) for order in (panes, panes[::-1]))
    torch.testing.assert_close(one.transmitted, other.transmitted, rtol=1e-9, atol=1e-12)


@some
@given(COSINES, st.floats(1.01, 2.5), st.floats(1.01, 2.5))
def test_double_glazing_follows_the_adding_formula(cosine, first, second):
    panes = [Pane(index=first), Pane(index=second)]
    through = back = 0.0
    for (t1, r1), (t2, r2) in zip(slab(panes[0], cosine), slab(panes[1], cosine), strict=True):
        through += t1 * t2 / (1 - r1 * r2) / 2
        back += (r1 + t1**2 * r2 / (1 - r1 * r2)) / 2
    shares = all_orders(glazing(panes), exact(cosine))
    assert float(shares.transmitted) == pytest.approx(through, rel=1e-6)
    assert float(shares.reflected) == pytest.approx(back, rel=1e-6)


def test_glass_absorbs_as_beer_and_lambert_say():
    pane = Pane(thickness_mm=10, absorption_per_m=(40, 0, 10))
    left = np.exp([-0.4, 0, -0.1])
    np.testing.assert_allclose(internal_transmittance(pane, exact(1)), left, rtol=1e-9)
    np.testing.assert_allclose(paper_orders(glazing([pane]), exact(1)).transmitted, 0.96**2 * left, rtol=1e-9)
    np.testing.assert_allclose(
        all_orders(glazing([pane]), exact(1)).transmitted,
        0.96**2 * left / (1 - (0.04 * left) ** 2),
        rtol=1e-9,
    )
    slanted = math.cos(math.asin(math.sin(math.radians(60)) / 1.5))
    np.testing.assert_allclose(internal_transmittance(pane, exact(0.5)), left ** (1 / slanted), rtol=1e-9)


# --- orders, one by one


def table_of(panes, cosine):
    return enumerate_orders(tuple(float(sum(fresnel(exact(cosine), pane.index))) / 2 for pane in panes))


@settings(max_examples=40, phases=[Phase.generate], deadline=None, database=None)
@given(PANES.filter(lambda panes: len(panes) < 3), st.floats(0.4, 1))
def test_the_orders_shares_sum_to_the_closed_form(panes, cosine):
    table = table_of(panes, cosine)
    shares = order_throughputs(glazing(panes), exact(cosine), table)
    for closed, kept, error in (
        (all_orders(glazing(panes), exact(cosine)), lambda _: True, 1e-12),
        (paper_orders(glazing(panes), exact(cosine)), lambda order: order.in_paper, 6e-3),
    ):
        for behind, whole in ((True, closed.transmitted), (False, closed.reflected)):
            mine = sum(
                s for s, order in zip(shares, table, strict=True) if order.behind == behind and kept(order)
            )
            assert float((mine - whole).abs().max()) < error
    assert all((share >= -1e-9).all() for share in shares)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_light_added_to_the_last_order_is_little(count):
    """For ordinary glass, the enumerated orders alone hold all but a thousandth of the light."""
    panes = [Pane()] * count
    table = enumerate_orders((0.04,) * count)
    whole = all_orders(glazing(panes), exact(1))
    for behind, total in ((True, whole.transmitted), (False, whole.reflected)):
        found = sum(
            order.count * 0.04 ** sum(order.reflections) * 0.96 ** sum(order.transmissions)
            for order in table
            if order.behind == behind
        )
        assert found <= float(total)
        assert found == pytest.approx(float(total), abs=1e-3)


def test_one_pane_has_three_reflected_and_two_transmitted_orders():
    table = enumerate_orders((0.04,))
    assert [order.behind for order in table] == [True, False, False, True, False]
    assert [order.traversals for order in table] == [(1,), (0,), (2,), (3,), (4,)]
    assert [order.reflections for order in table] == [(0,), (1,), (1,), (2,), (3,)]
    assert [order.transmissions for order in table] == [(2,), (0,), (2,), (2,), (2,)]
    assert [order.count for order in table] == [1] * 5
    assert [order.in_paper for order in table] == [True, True, False, False, False]


def test_each_order_of_one_pane_is_a_term_of_the_geometric_series():
    pane = Pane(thickness_mm=10, absorption_per_m=(40, 0, 10))
    a = np.exp([-0.4, 0, -0.1])
    first, mirror, ghost, second, _ = order_throughputs(glazing([pane]), exact(1), enumerate_orders((0.04,)))
    np.testing.assert_allclose(first, 0.96**2 * a, rtol=1e-9)
    np.testing.assert_allclose(mirror, 0.04, rtol=1e-9)
    np.testing.assert_allclose(ghost, 0.96**2 * 0.04 * a**2, rtol=1e-9)
    np.testing.assert_allclose(second, 0.96**2 * 0.04**2 * a**3, rtol=5e-3)  # and all that come after


def test_in_double_glazing_the_papers_reflection_never_enters_the_last_pane():
    table = enumerate_orders((0.04, 0.04))
    assert sum(order.behind and order.in_paper for order in table) == 1
    mirrored = [order for order in table if not order.behind]
    brightest = [order.traversals for order in mirrored[:4]]
    assert brightest == [(0, 0, 0), (2, 0, 0), (2, 2, 0), (2, 2, 2)]
    assert [order.in_paper for order in mirrored[:4]] == [True, True, True, False]
    for order in mirrored:
        assert order.in_paper == (order.transmissions[1] == 0)


# --- ghosts


def test_the_ghost_distance_matches_the_textbook_formula():
    inside = math.asin(math.sin(math.radians(45)) / 1.5)
    expected = 2 * 6 * math.tan(inside) * math.cos(math.radians(45))
    assert ghost_distance_mm(Pane(thickness_mm=6), 45) == pytest.approx(expected, rel=1e-9)
    assert ghost_distance_mm(Pane(thickness_mm=6), 45) == pytest.approx(4.5356, abs=1e-4)
    assert ghost_distance_mm(Pane(), 0) == 0
    assert ghost_distance_mm(Pane(index=1.0), 60) == pytest.approx(8 * math.sin(math.radians(60)), rel=1e-9)


def test_lateral_shifts_follow_snells_law_in_glass_and_are_unrefracted_in_the_gap():
    first, gap, second = lateral_shifts_mm(
        Glazing(panes=(Pane(thickness_mm=3), Pane(thickness_mm=8, index=2)), gap_mm=16), exact(0.5)
    )
    sine = math.sin(math.radians(60))
    assert float(first) == pytest.approx(3 * math.tan(math.asin(sine / 1.5)), rel=1e-9)
    assert float(gap) == pytest.approx(16 * math.tan(math.radians(60)), rel=1e-9)
    assert float(second) == pytest.approx(8 * math.tan(math.asin(sine / 2)), rel=1e-9)


def line_mirrored(incidence_deg, thickness_mm):
    """The mean reflection per column of a thin line in front of the glass, and the size of a pixel there in mm."""
    before, away, slant = 600.0, 400.0, math.radians(incidence_deg)
    camera = camera_towards_glass(
        incidence_deg, distance_mm=before / math.cos(slant), fov_deg=0.6, width=48, height=16
    )
    line = plane_side(
        "line",
        distance_mm=away,
        width_mm=20 / math.cos(slant) ** 2,
        offset_mm=(away * math.tan(slant) + 10 / 64 / math.cos(slant) ** 2, 0),
    )
    scene = make_scene(camera=camera, panes=[{"thickness_mm": thickness_mm}], front=line, samples=25)
    columns = render(scene, ASSETS).reflection.mean((0, 1)).numpy()
    return columns, scene.camera.pixel_rad * (before + away) / math.cos(slant)


@pytest.mark.parametrize(("incidence_deg", "thickness_mm"), [(20, 6), (35, 5), (45, 4.5)])
def test_a_line_near_the_glass_is_mirrored_twice_as_far_apart_as_the_formula_says(
    incidence_deg, thickness_mm
):
    columns, pixel_mm = line_mirrored(incidence_deg, thickness_mm)
    apart = ghost_distance_mm(Pane(thickness_mm=thickness_mm), incidence_deg) / pixel_mm
    assert 7 < apart < 20
    places = np.arange(48) + 0.5
    main, ghost = (np.abs(places - place) < apart / 2 for place in (24, 24 - apart))
    found, other = (np.average(places[mine], weights=columns[mine]) for mine in (main, ghost))
    assert found == pytest.approx(24, abs=0.1)
    assert found - other == pytest.approx(apart, rel=0.02)
    r_s, r_p = surface(math.cos(math.radians(incidence_deg)), 1, 1.5)
    fainter = (r_s * (1 - r_s) ** 2 + r_p * (1 - r_p) ** 2) / (r_s + r_p)
    assert columns[ghost].sum() / columns[main].sum() == pytest.approx(fainter, rel=0.03)


def test_a_ghost_one_pixel_away_moves_the_lines_centroid_by_its_weight():
    """Orders have separate lookups unless their images are within a tenth of a pixel."""
    columns, pixel_mm = line_mirrored(40, 0.4)
    apart = ghost_distance_mm(Pane(thickness_mm=0.4), 40) / pixel_mm
    assert 0.5 < apart < 1.5
    table = enumerate_orders((0.04,))
    shares = order_throughputs(Glazing(), exact(math.cos(math.radians(40))), table)
    mirrored = [(float(s), o.traversals[0] / 2) for s, o in zip(shares, table, strict=True) if not o.behind]
    mean_order = sum(share * number for share, number in mirrored) / sum(share for share, _ in mirrored)
    found = np.average(np.arange(48) + 0.5, weights=columns)
    assert 24 - found == pytest.approx(apart * mean_order, abs=0.05)

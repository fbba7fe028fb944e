"""Layered glass, compared with independently written formulas."""

import math

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from brewster.render.analytic import render
from brewster.render.rays import layered_glass as glass
from brewster.render.rays.rough_glass import _reflectances
from brewster.render.scene.glass import Glazing, Pane
from synthetic_scenes import ASSETS, camera_towards_glass, make_scene, plane_side

examples_40 = settings(max_examples=40, deadline=None, database=None)
COSINES = st.floats(0.05, 1)
INDICES = st.floats(1, 2)
TINTS = st.tuples(*[st.floats(0, 100)] * 3)
PANES = st.lists(
    st.builds(
        Pane, refractive_index=INDICES, thickness_mm=st.floats(1, 50), absorption_per_m=TINTS
    ),
    min_size=1,
    max_size=3,
)


def glazing(panes):
    panes = list(panes)
    return Glazing(panes=tuple(panes), gap_mm=10.0 if len(panes) > 1 else 0.0)


def float64(number):
    return torch.tensor(float(number), dtype=torch.float64)


def surface_reflectances(cosine, index_in, index_out):
    """Fresnel reflectances for s- and p-polarised light, from the angles on both sides."""
    theta_in = math.acos(cosine)
    theta_out = math.asin(index_in * math.sin(theta_in) / index_out)
    if theta_in < 1e-6:
        return (((index_in - index_out) / (index_in + index_out)) ** 2,) * 2
    s = math.sin(theta_in - theta_out) / math.sin(theta_in + theta_out)
    p = math.tan(theta_in - theta_out) / math.tan(theta_in + theta_out)
    return s**2, p**2


def pane_throughputs(pane, cosine):
    """T and R of one clear pane for s- and p-polarised light: all orders as a geometric series."""
    reflectances = surface_reflectances(cosine, 1, pane.refractive_index)
    return [((1 - r) / (1 + r), 2 * r / (1 + r)) for r in reflectances]


def test_a_pane_of_ordinary_glass_reflects_about_eight_percent():
    throughput = glass.total_throughput(Glazing(), float64(1))
    assert float(throughput.reflectance) == pytest.approx(0.08 / 1.04, rel=1e-9)
    assert float(throughput.reflectance) == pytest.approx(0.0769, abs=5e-5)
    assert float(throughput.transmittance) == pytest.approx(0.96 / 1.04, rel=1e-9)


@pytest.mark.parametrize("index", [1.1, 1.5, 2.4])
def test_p_polarised_light_is_not_reflected_at_brewsters_angle(index):
    s, p = glass.fresnel(float64(math.cos(math.atan(index))), index)
    assert float(p) == pytest.approx(0, abs=1e-12)
    assert float(s) == pytest.approx(((index**2 - 1) / (index**2 + 1)) ** 2, rel=1e-9)


@examples_40
@given(st.floats(0.05, 0.999), st.floats(1.01, 2.5))
def test_a_surface_has_the_same_reflectance_from_both_sides(cosine, index):
    inside = float(glass.refracted_cosine(float64(cosine), index))
    assert math.sqrt(1 - inside**2) * index == pytest.approx(math.sqrt(1 - cosine**2), abs=1e-9)
    outside = [float(r) for r in glass.fresnel(float64(cosine), index)]
    assert outside == pytest.approx(surface_reflectances(cosine, 1, index), rel=1e-6, abs=1e-9)
    assert outside == pytest.approx(surface_reflectances(inside, index, 1), rel=1e-6, abs=1e-9)
    traced = [float(r) for r in _reflectances(float64(inside), index, 1.0)]
    assert outside == pytest.approx(traced, rel=1e-6, abs=1e-9)


def test_beyond_the_critical_angle_all_light_inside_the_glass_is_reflected():
    critical = math.sqrt(1 - 1 / 1.5**2)
    for cosine, is_total in ((critical - 0.01, True), (critical + 0.01, False)):
        s, p = _reflectances(float64(cosine), 1.5, 1.0)
        assert (float(s) == 1, float(p) == 1) == (is_total, is_total)


@examples_40
@given(PANES, COSINES)
def test_clear_glass_loses_no_light(panes, cosine):
    clear = glazing(pane.model_copy(update={"absorption_per_m": (0.0, 0.0, 0.0)}) for pane in panes)
    throughput = glass.total_throughput(clear, float64(cosine))
    assert float(throughput.transmittance + throughput.reflectance) == pytest.approx(1, abs=1e-9)


@examples_40
@given(PANES, COSINES)
def test_tinted_glass_adds_no_light(panes, cosine):
    throughput = glass.total_throughput(glazing(panes), float64(cosine))
    assert (throughput.transmittance >= 0).all()
    assert (throughput.reflectance >= 0).all()
    assert (throughput.transmittance + throughput.reflectance <= 1 + 1e-9).all()


@examples_40
@given(PANES, COSINES)
def test_a_stack_has_the_same_transmittance_from_both_sides(panes, cosine):
    stacks = glazing(panes), glazing(panes[::-1])
    from_front, from_behind = (glass.total_throughput(stack, float64(cosine)) for stack in stacks)
    torch.testing.assert_close(
        from_front.transmittance, from_behind.transmittance, rtol=1e-9, atol=1e-12
    )


@examples_40
@given(COSINES, st.floats(1.01, 2.5), st.floats(1.01, 2.5))
def test_double_glazing_follows_the_adding_formula(cosine, first, second):
    panes = [Pane(refractive_index=first), Pane(refractive_index=second)]
    transmittance = reflectance = 0.0
    for (t1, r1), (t2, r2) in zip(*(pane_throughputs(pane, cosine) for pane in panes), strict=True):
        transmittance += t1 * t2 / (1 - r1 * r2) / 2
        reflectance += (r1 + t1**2 * r2 / (1 - r1 * r2)) / 2
    throughput = glass.total_throughput(glazing(panes), float64(cosine))
    assert float(throughput.transmittance) == pytest.approx(transmittance, rel=1e-6)
    assert float(throughput.reflectance) == pytest.approx(reflectance, rel=1e-6)


def test_absorption_follows_the_beer_lambert_law():
    pane = Pane(thickness_mm=10, absorption_per_m=(40, 0, 10))
    internal = np.exp([-0.4, 0, -0.1])
    np.testing.assert_allclose(glass.internal_transmittance(pane, float64(1)), internal, rtol=1e-9)
    first = 0.96**2 * internal
    for throughput, expected in (
        (glass.truncated_throughput, first),
        (glass.total_throughput, first / (1 - (0.04 * internal) ** 2)),
    ):
        found = throughput(glazing([pane]), float64(1)).transmittance
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    refracted = math.cos(math.asin(math.sin(math.radians(60)) / 1.5))
    oblique = glass.internal_transmittance(pane, float64(0.5))
    np.testing.assert_allclose(oblique, internal ** (1 / refracted), rtol=1e-9)


def orders_of(panes, cosine):
    reflectances = (glass.fresnel(float64(cosine), pane.refractive_index) for pane in panes)
    return glass.enumerate_orders(tuple(float(sum(each)) / 2 for each in reflectances))


@settings(max_examples=40, phases=[Phase.generate], deadline=None, database=None)
@given(PANES.filter(lambda panes: len(panes) < 3), st.floats(0.4, 1))
def test_the_throughputs_of_the_orders_sum_to_the_closed_form(panes, cosine):
    table = orders_of(panes, cosine)
    throughputs = glass.order_throughputs(glazing(panes), float64(cosine), table)
    for throughput, is_included, max_error in (
        (glass.total_throughput, lambda _: True, 1e-12),
        (glass.truncated_throughput, lambda order: order.in_truncated_layers, 6e-3),
    ):
        closed = throughput(glazing(panes), float64(cosine))
        for behind, expected in ((True, closed.transmittance), (False, closed.reflectance)):
            total = sum(
                throughput
                for throughput, order in zip(throughputs, table, strict=True)
                if order.is_transmitted == behind and is_included(order)
            )
            assert float((total - expected).abs().max()) < max_error
    assert all((throughput >= -1e-9).all() for throughput in throughputs)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_little_light_is_added_to_the_last_order(count):
    """For ordinary glass, the enumerated orders contain all but 0.1 % of the incident light."""
    panes = [Pane()] * count
    table = glass.enumerate_orders((0.04,) * count)
    closed = glass.total_throughput(glazing(panes), float64(1))
    for behind, total in ((True, closed.transmittance), (False, closed.reflectance)):
        enumerated = sum(
            order.count * 0.04 ** sum(order.reflections) * 0.96 ** sum(order.transmissions)
            for order in table
            if order.is_transmitted == behind
        )
        assert enumerated <= float(total)
        assert enumerated == pytest.approx(float(total), abs=1e-3)


def test_one_pane_has_three_reflected_and_two_transmitted_orders():
    table = glass.enumerate_orders((0.04,))
    assert [order.is_transmitted for order in table] == [True, False, False, True, False]
    assert [order.traversals for order in table] == [(1,), (0,), (2,), (3,), (4,)]
    assert [order.reflections for order in table] == [(0,), (1,), (1,), (2,), (3,)]
    assert [order.transmissions for order in table] == [(2,), (0,), (2,), (2,), (2,)]
    assert [order.count for order in table] == [1] * 5
    assert [order.in_truncated_layers for order in table] == [True, True, False, False, False]


def test_each_order_of_one_pane_is_a_term_of_the_geometric_series():
    pane = Pane(thickness_mm=10, absorption_per_m=(40, 0, 10))
    a = np.exp([-0.4, 0, -0.1])
    orders = glass.enumerate_orders((0.04,))
    first, mirror, ghost, second, _ = glass.order_throughputs(glazing([pane]), float64(1), orders)
    np.testing.assert_allclose(first, 0.96**2 * a, rtol=1e-9)
    np.testing.assert_allclose(mirror, 0.04, rtol=1e-9)
    np.testing.assert_allclose(ghost, 0.96**2 * 0.04 * a**2, rtol=1e-9)
    np.testing.assert_allclose(
        second, 0.96**2 * 0.04**2 * a**3, rtol=5e-3
    )  # includes all later orders


def test_in_double_glazing_the_papers_reflection_never_enters_the_last_pane():
    table = glass.enumerate_orders((0.04, 0.04))
    assert sum(order.is_transmitted and order.in_truncated_layers for order in table) == 1
    reflected = [order for order in table if not order.is_transmitted]
    brightest = [order.traversals for order in reflected[:4]]
    assert brightest == [(0, 0, 0), (2, 0, 0), (2, 2, 0), (2, 2, 2)]
    assert [order.in_truncated_layers for order in reflected[:4]] == [True, True, True, False]
    for order in reflected:
        assert order.in_truncated_layers == (order.transmissions[1] == 0)


def test_the_ghost_distance_matches_the_textbook_formula():
    inside = math.asin(math.sin(math.radians(45)) / 1.5)
    expected = 2 * 6 * math.tan(inside) * math.cos(math.radians(45))
    assert glass.ghost_distance_mm(Pane(thickness_mm=6), 45) == pytest.approx(expected, rel=1e-9)
    assert glass.ghost_distance_mm(Pane(thickness_mm=6), 45) == pytest.approx(4.5356, abs=1e-4)
    assert glass.ghost_distance_mm(Pane(), 0) == 0
    without_refraction = glass.ghost_distance_mm(Pane(refractive_index=1.0), 60)
    assert without_refraction == pytest.approx(8 * math.sin(math.radians(60)), rel=1e-9)


def test_in_plane_shifts_follow_snells_law_in_glass_and_are_unrefracted_in_the_gap():
    panes = Pane(thickness_mm=3), Pane(thickness_mm=8, refractive_index=2)
    first, gap, second = glass.in_plane_shifts_mm(Glazing(panes=panes, gap_mm=16), float64(0.5))
    sine = math.sin(math.radians(60))
    assert float(first) == pytest.approx(3 * math.tan(math.asin(sine / 1.5)), rel=1e-9)
    assert float(gap) == pytest.approx(16 * math.tan(math.radians(60)), rel=1e-9)
    assert float(second) == pytest.approx(8 * math.tan(math.asin(sine / 2)), rel=1e-9)


def render_mirrored_line(incidence_deg, thickness_mm):
    """Renders the reflection of a thin line in front of the glass: its mean per column, and the
    pixel size in mm.
    """
    before = 600.0
    away = 400.0
    slant = math.radians(incidence_deg)
    distance_mm = before / math.cos(slant)
    camera = camera_towards_glass(
        incidence_deg, distance_mm=distance_mm, fov_deg=0.6, width=48, height=16
    )
    offset_mm = away * math.tan(slant) + 10 / 64 / math.cos(slant) ** 2, 0
    line = plane_side(
        "line", distance_mm=away, width_mm=20 / math.cos(slant) ** 2, offset_mm=offset_mm
    )
    panes = [{"thickness_mm": thickness_mm}]
    scene = make_scene(camera=camera, panes=panes, front=line, samples_per_pixel=25)
    columns = render(scene, ASSETS).reflection.mean((0, 1)).numpy()
    return columns, scene.camera.pixel_rad * (before + away) / math.cos(slant)


@pytest.mark.parametrize(("incidence_deg", "thickness_mm"), [(20, 6), (35, 5), (45, 4.5)])
def test_two_reflections_of_a_near_line_have_the_ghost_distance_of_the_formula(
    incidence_deg, thickness_mm
):
    columns, pixel_mm = render_mirrored_line(incidence_deg, thickness_mm)
    ghost_px = glass.ghost_distance_mm(Pane(thickness_mm=thickness_mm), incidence_deg) / pixel_mm
    assert 7 < ghost_px < 20
    x = np.arange(48) + 0.5
    main, ghost = (np.abs(x - centre) < ghost_px / 2 for centre in (24, 24 - ghost_px))
    main_x, ghost_x = (np.average(x[mask], weights=columns[mask]) for mask in (main, ghost))
    assert main_x == pytest.approx(24, abs=0.1)
    assert main_x - ghost_x == pytest.approx(ghost_px, rel=0.02)
    r_s, r_p = surface_reflectances(math.cos(math.radians(incidence_deg)), 1, 1.5)
    relative_brightness = (r_s * (1 - r_s) ** 2 + r_p * (1 - r_p) ** 2) / (r_s + r_p)
    assert columns[ghost].sum() / columns[main].sum() == pytest.approx(
        relative_brightness, rel=0.03
    )


def test_a_ghost_one_pixel_away_moves_the_lines_centroid_by_its_weight():
    """Orders have separate lookups unless their images are within a tenth of a pixel."""
    columns, pixel_mm = render_mirrored_line(40, 0.4)
    ghost_px = glass.ghost_distance_mm(Pane(thickness_mm=0.4), 40) / pixel_mm
    assert 0.5 < ghost_px < 1.5
    table = glass.enumerate_orders((0.04,))
    throughputs = glass.order_throughputs(Glazing(), float64(math.cos(math.radians(40))), table)
    reflected = [
        (float(weight), order.traversals[0] / 2)
        for weight, order in zip(throughputs, table, strict=True)
        if not order.is_transmitted
    ]
    mean_shift = sum(weight * shift for weight, shift in reflected) / sum(
        weight for weight, _ in reflected
    )
    centroid_x = np.average(np.arange(48) + 0.5, weights=columns)
    assert 24 - centroid_x == pytest.approx(ghost_px * mean_shift, abs=0.05)

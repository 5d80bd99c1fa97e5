"""Penalties along a trajectory: their integral, its derivatives, and GPU kernels for both."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from planner_jax.baselines.hit.common import motion_excess
from planner_jax.cost.along import Along, _greatest, greatest_along, integrate_along
from planner_jax.cost.along_kernel import MODES, along_kernel
from planner_jax.cost.peaks_kernel import peaks_kernel
from planner_jax.cost.penalty import greatest_by_tangents, peak_above, smooth_hinge
from planner_jax.lanes import over_lanes
from planner_jax.robot.quadrotor import QuadrotorLimits
from planner_jax.trajectory.proportional_minco import proportional_minco, sample_motion

LANES, SEGMENTS = 32, 2
SLOW_MODES = [pytest.param(mode, marks=pytest.mark.slow) for mode in MODES[2:]]
ALONG = Along(
    proportional_minco(2, (0.4, 1.0)),
    5,
    lambda motion, given: motion_excess(motion, *given[:2]),
    margins=(0.1, 0.1, 0.1, 0.05),
    hinge_width=0.2,
)


def cases(num=LANES, dtype=np.float32):
    """Draw coefficients, durations [s], gravity and limits of flights that exceed every limit."""
    random = np.random.default_rng(0)
    columns = random.standard_normal((num, SEGMENTS, 5, 3)) * 0.7
    durations = random.uniform(0.2, 0.5, (num, SEGMENTS))
    limit = lambda low, high: random.uniform(low, high, num).astype(dtype)  # noqa: E731
    bounds = {"speed": (2, 9), "acceleration": (5, 15), "body_rate": (3, 8), "min_height": (-1, 1)}
    limits = QuadrotorLimits(**{name: limit(*bound) for name, bound in bounds.items()})
    return columns.astype(dtype), durations.astype(dtype), (limit(9, 10), limits)


@jax.jit
def sample(columns, durations, given):
    motion = jax.vmap(functools.partial(sample_motion, ALONG.maps, ALONG.nodes))(columns, durations)
    excess = jnp.stack(jax.vmap(lambda segment: motion_excess(segment, *given))(motion), axis=1)
    return excess, smooth_hinge(excess + np.array(ALONG.margins)[None, :, None], ALONG.hinge_width)


@jax.jit
def along_a_line(t, x, direction):
    def value(t):
        columns, durations, given = jax.tree.map(lambda a, b: a + t * b, x, direction)
        return jnp.sum(integrate_along(ALONG, columns, durations, given)[0])

    return value(t), *jax.jvp(jax.grad(value), (t,), (jnp.ones_like(t),))


def test_it_is_the_trapezoid_sum_of_the_hinges(float64):
    columns, durations, given = jax.tree.map(lambda x: x[0], cases(dtype=np.float64))
    penalties, worst = jax.jit(functools.partial(integrate_along, ALONG))(columns, durations, given)
    for n, (excess, hinges) in enumerate(zip(*sample(columns, durations, given), strict=True)):
        excess, hinges = np.asarray(excess), np.asarray(hinges).sum(axis=0)
        times = np.concatenate([[0.0], np.cumsum(np.repeat(ALONG.maps.proportions, 5) / 5)])
        expected = durations[n] * np.trapezoid(hinges, times)
        np.testing.assert_allclose(penalties[n], expected, rtol=1e-12)
        np.testing.assert_allclose(worst[n], excess.max(), rtol=1e-12)


def test_slopes_and_curvature_are_those_of_finite_differences(float64):
    x = jax.tree.map(lambda x: x[1], cases(dtype=np.float64))
    waves = [np.cos(np.arange(leaf.size)).reshape(leaf.shape) for leaf in x[:2]]
    step = 1e-5
    for a, b in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):  # Move the flight, the parameters, both.
        parameters = jax.tree.map(lambda leaf, b=b: b * np.ones_like(leaf), x[2])
        direction = (*(a * wave for wave in waves), parameters)
        behind, here, ahead = (along_a_line(t, x, direction) for t in (-step, 0.0, step))
        for order, tolerance in ((0, 1e-7), (1, 1e-6)):
            expected = (ahead[order] - behind[order]) / (2.0 * step)
            np.testing.assert_allclose(here[order + 1], expected, rtol=tolerance, atol=1e-6)


def test_the_greatest_of_every_limit_is_the_peak_between_the_samples(float64):
    columns, durations, given = jax.tree.map(lambda x: x[0], cases(dtype=np.float64))
    along, finer = dataclasses.replace(ALONG, nodes=20), 100

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def first_limit(h):
        sample = functools.partial(sample_motion, along.maps, along.nodes * finer)
        fine = jax.vmap(lambda *segment: motion_excess(sample(*segment), *given))(columns, h)
        greatest = greatest_along(along, columns, h, given)
        return greatest[0][0], (greatest, fine)

    (_, (greatest, fine)), slope = first_limit(durations)
    for limit in (0, 3):
        samples = np.asarray(fine[limit])
        missed = samples.max(axis=1) - samples[:, ::finer].max(axis=1)
        off = np.abs(greatest[limit] - samples.max(axis=1))
        assert missed.max() > 1e-3 and off.max() < 0.15 * missed.max()
    assert slope[0] < 0.0 and slope[1] == 0.0  # A longer first segment has a smaller speed.


def test_the_crest_is_the_peak_of_a_parabola_between_three_samples(float64):
    before, after = 0.3, 0.5
    for peak, height in ((0.02, 1.0), (-0.29, 2.0), (0.49, 0.5), (-0.31, 3.0), (0.51, 1.0)):
        left, middle, right = (height - 7.0 * (t - peak) ** 2 for t in (-before, 0.0, after))
        expected = height - middle if -before < peak < after else 0.0
        np.testing.assert_allclose(
            peak_above(left, middle, right, before, after), expected, atol=1e-12
        )
    for values in ((1.0, 1.0, 1.0), (0.0, 1.0, 2.0), (1.0, 0.0, 1.0), (-np.inf,) * 3):
        slopes = jax.grad(lambda x: peak_above(*x, before, after))(jnp.array(values))
        assert peak_above(*map(jnp.array, values), before, after) == 0.0
        assert np.isfinite(slopes).all() or np.isinf(values).any()


def test_tangents_find_the_tip_of_a_tent_and_bound_a_concave_function(float64):
    times = np.linspace(0.0, 1.0, 11)
    tent, slopes = 1.0 - 2.0 * np.abs(times - 0.537), -2.0 * np.sign(times - 0.537)
    np.testing.assert_allclose(greatest_by_tangents(tent, slopes, 0.1), 1.0, rtol=1e-12)
    hill, slopes = -3.0 * (times - 0.537) ** 2, -6.0 * (times - 0.537)
    assert 0.0 < greatest_by_tangents(hill, slopes, 0.1) < 3.0 * 0.1**2 / 4.0
    assert greatest_by_tangents(-hill, -slopes, 0.1) == (-hill).max()


def test_worst_has_no_derivative():
    columns, durations, given = jax.tree.map(lambda x: x[1], cases())
    worst = lambda c: jnp.sum(integrate_along(ALONG, c, durations, given)[1])  # noqa: E731
    slope = jax.jit(jax.grad(worst))(columns)
    np.testing.assert_array_equal(slope, 0.0)


def reference(mode):
    def value(*x):
        penalties, worst = integrate_along(ALONG, *x)
        return jnp.sum(penalties), (penalties, worst)

    def slopes(*x):
        num = range(3 if mode != "slopes" else 2)

        def segment(c, h, given):
            both = jax.value_and_grad(value, argnums=num, has_aux=True)
            (_, aux), by = both(c[None], h[None], given)
            return jax.tree.map(lambda leaf: leaf[0], (*aux, by[0], by[1])), by[2:]

        return jax.vmap(segment, in_axes=(0, 0, None))(*x)

    def curvature(point, direction):
        return jax.jvp(slopes, point, direction)[1]

    return {
        "greatest": lambda *x: greatest_along(ALONG, *x),
        "values": lambda *x: value(*x)[1],
        "slopes": slopes,
        "slopes by all": slopes,
        "curvature": curvature,
    }[mode]


@pytest.mark.parametrize("mode", ["greatest", *MODES[:2], *SLOW_MODES])
def test_the_kernel_gives_the_same_numbers(mode):
    args = cases()
    if mode == "curvature":
        random = np.random.default_rng(1)
        args = (args, jax.tree.map(lambda x: random.standard_normal(x.shape).astype(x.dtype), args))
    expected = jax.tree.leaves(jax.jit(jax.vmap(reference(mode), out_axes=-1))(*args))
    lanes = jax.tree.map(lambda x: jnp.asarray(np.moveaxis(x, 0, -1)), args)
    make = peaks_kernel if mode == "greatest" else functools.partial(along_kernel, mode=mode)
    kernel = make(ALONG, interpret=True)
    found = kernel(jax.tree.structure(args), jax.tree.leaves(lanes))
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        scale = np.abs(theirs).max()
        np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-5 * scale)


@pytest.mark.slow
def test_derivatives_in_lanes_are_those_without_a_kernel(monkeypatch):
    used = []

    def in_lanes(along, mode):
        kernel = along_kernel(along, mode, interpret=True)

        def count(*args):
            used.append(mode)
            return kernel(*args)

        return count

    monkeypatch.setattr("planner_jax.cost.along_kernel.along_kernel", in_lanes)
    monkeypatch.setattr("planner_jax.lanes.kernels.has_gpu", lambda: True)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *x, cuda, default: cuda(*x))
    along = dataclasses.replace(ALONG, hinge_width=0.25)  # Other constants need other kernels.
    args = cases()
    lanes = jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), args)

    def value(c, h, given):
        return jnp.sum(integrate_along(along, c, h, given)[0])

    def by_all(c, h, given):
        return jax.grad(value, argnums=(0, 1, 2))(c, h, given)

    def along_columns(c, h, given):
        return jax.jvp(lambda c: by_all(c, h, given), (c,), (jnp.cos(c),))[1]

    def by_durations(c, h, given):
        return jax.jacfwd(lambda h: by_all(c, h, given))(h)

    def backward(c, h, given):
        total = lambda *x: sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(by_all(*x)))  # noqa: E731
        return jax.grad(total, argnums=(0, 1, 2))(c, h, given)

    by_kernels = {"slopes by all", "curvature"}
    for function, kernels in (
        (by_all, {"slopes by all"}),
        (along_columns, by_kernels),
        (by_durations, by_kernels),
        (backward, {"slopes by all"}),
    ):
        used.clear()
        expected = jax.vmap(function, out_axes=-1)(*args)
        found = over_lanes(function)(*lanes)
        assert set(used) == kernels
        for ours, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
            scale = np.abs(theirs).max()
            np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=5e-5 * scale)


@pytest.mark.parametrize("mode", ["values", "slopes"])
def test_the_kernel_takes_margins_and_width_at_run_time(mode):
    columns, durations, given = cases()
    share, width = (np.full(LANES, number, np.float32) for number in (1.5, 0.3))
    args = columns, durations, (*given, share, width)
    along = dataclasses.replace(ALONG, hinge_width=None)
    constant = dataclasses.replace(
        ALONG, margins=tuple(1.5 * each for each in ALONG.margins), hinge_width=0.3
    )
    expected, found = (
        along_kernel(each, mode, interpret=True)(
            jax.tree.structure(own),
            jax.tree.leaves(jax.tree.map(lambda x: jnp.moveaxis(jnp.asarray(x), 0, -1), own)),
        )
        for each, own in ((constant, (columns, durations, given)), (along, args))
    )
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)


def test_the_kernel_declines_types_and_sizes_that_it_does_not_support():
    kernel = along_kernel(ALONG, "values")
    for num, dtype in ((LANES, np.float16), (7, np.float32)):
        args = cases(num, dtype)
        lanes = jax.tree.leaves(jax.tree.map(lambda x: jnp.asarray(np.moveaxis(x, 0, -1)), args))
        assert kernel(jax.tree.structure(args), lanes) is None


def test_the_name_of_a_kernel_does_not_depend_on_earlier_kernels(monkeypatch):
    """Processes share a compiled program only if its GPU kernels have equal names in them."""
    lane = jax.tree.map(lambda leaf: leaf[0], cases())
    others = [dataclasses.replace(ALONG, margins=(0.1, 0.1, 0.1, margin)) for margin in (0.2, 0.3)]

    def names(alongs):
        known = {}
        monkeypatch.setattr("planner_jax.lanes.kernels._ENTRIES", known)
        for along in alongs:
            jax.make_jaxpr(_greatest.__wrapped__(along))(*lane)
        return list(known)

    assert names(others) == names(others[::-1])[::-1]
    assert len(set(names(others))) == 2

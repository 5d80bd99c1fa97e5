"""Adjoint gradients of plans: closed form, finite differences, independence within a batch."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

import planner_jax as pj
from planner_jax.optimise.implicit import implicit_point, newton_refine, optimal_plan
from planner_jax.optimise.inverse_kernel import inverse_kernel
from planner_jax.optimise.multistart import minimise
from planner_jax.optimise.near import Known, NearPlan
from planner_jax.optimise.preconditioner import positive_inverse
from planner_jax.optimise.sensitivity import gradient_at, part_of, replace_part
from planner_jax.planning.decided import first_choice
from planner_jax.task.hit.suites import generate_serves, to_cases
from tests.derivatives import double

CURVED = np.array([[3.0, 1.0, 0.2], [1.0, 2.0, 0.0], [0.2, 0.0, 1.0]])


@struct.dataclass
class Bowl:
    """A case (b, k) with the cost u^T A u / 2 - u^T b - k u_0 of a plan u, where A = `CURVED`."""

    b: jax.Array  # (3,)
    k: jax.Array  # ()
    kind: jax.Array  # () int32

    @property
    def batch_shape(self):
        return np.shape(self.k)


@struct.dataclass
class BowlPlan(pj.Plan):
    point: jax.Array


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class BowlProblem(pj.Problem):
    weight: float = 1.0
    attempts = (
        pj.Attempt(starts=2, solver=pj.LbfgsConfig(max_steps=40, tolerance=1e-14), settings=()),
        pj.Attempt(starts=1, solver=pj.LbfgsConfig(max_steps=5), settings=(("weight", 2.0),)),
    )

    def prepare(self, case):
        return {"force": self.weight * (case.b + case.k * jnp.eye(3)[0])}

    def guesses(self, context, num):
        return jnp.arange(float(num))[:, None] + 0.0 * context["force"][None]

    def objective(self, point, context):
        energy = 0.5 * self.weight * jnp.sum(point * (CURVED @ point))
        return energy - jnp.sum(point * context["force"]), -jnp.ones(())

    def decode(self, point, context):
        return BowlPlan(point=point, **pj.pending(-jnp.ones(())))


def square(plan):
    return jnp.sum(plan.point**2)


@pytest.fixture
def bowls(float64):
    random = np.random.default_rng(0)
    return Bowl(random.standard_normal((5, 3)), random.standard_normal(5), np.zeros(5, np.int32))


@pytest.mark.parametrize(
    "options",
    [{"steps": 3}, pytest.param({"steps": 1, "curvature": "whole"}, marks=pytest.mark.slow)],
)
def test_gradient_of_a_quadratic_is_the_closed_form(bowls, options):
    found = pj.gradient(BowlProblem.planner(), bowls, of=square, by=("b", "k"), **options)
    inverse = np.linalg.inv(CURVED)
    best = (bowls.b + bowls.k[:, None] * np.eye(3)[0]) @ inverse
    np.testing.assert_allclose(found.plans.point, best, atol=1e-6)
    np.testing.assert_allclose(found.value, np.sum(best**2, axis=1), atol=1e-6)
    np.testing.assert_allclose(found.by["b"], 2.0 * best @ inverse, atol=1e-5)
    np.testing.assert_allclose(found.by["k"], found.by["b"][:, 0], atol=1e-12)
    assert np.all(found.residual < 1e-6)


def test_the_gradient_is_nan_where_the_hessian_is_not_positive(bowls):
    planner = BowlProblem.planner(
        weight=-1.0, attempts=(pj.Attempt(1, pj.LbfgsConfig(max_steps=0)),)
    )
    found = pj.gradient(planner, bowls, of=lambda plan: plan.point[0], by="b")
    assert np.isnan(found.by["b"]).all() and np.isnan(found.residual).all()


def test_gradient_of_the_cost_needs_no_adjoint(bowls):
    found = pj.gradient(BowlProblem.planner(), bowls, of="cost", by=("b",), steps=0)
    np.testing.assert_allclose(found.by["b"], -found.plans.point, atol=1e-12)
    np.testing.assert_allclose(found.value, found.plans.cost, atol=1e-12)
    for by in ("b", ["b"]):  # one name, or a list
        again = pj.gradient(BowlProblem.planner(), bowls, of="cost", by=by, steps=0)
        np.testing.assert_array_equal(again.by["b"], found.by["b"])


def test_an_optimal_plan_has_the_same_gradient_forward_and_backward(bowls):
    with pytest.raises(ValueError, match=r"must be one case, got batch shape \(5,\)"):
        optimal_plan(BowlProblem.planner(), bowls)
    bowl = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), bowls)
    inverse = np.linalg.inv(CURVED)
    point_of = lambda bowl: optimal_plan(BowlProblem.planner(), bowl).point  # noqa: E731
    for jacobian in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jacobian(lambda b, k: point_of(bowl.replace(b=b, k=k)), argnums=(0, 1)))
        by_b, by_k = slopes(bowl.b, bowl.k)
        np.testing.assert_allclose(by_b, inverse, atol=1e-9)
        np.testing.assert_allclose(by_k, inverse[:, 0], atol=1e-9)


def minimum(bowl):
    return jnp.linalg.solve(CURVED, bowl.b + bowl.k * jnp.eye(3)[0])


@struct.dataclass
class KnownBowl(Bowl, Known):
    """A bowl, and the point (3,) of a known plan."""


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class NearBowl(NearPlan, BowlProblem):
    """The bowl's cost, which one Newton step minimises from any known plan."""

    case_type = KnownBowl

    def prepare(self, case):
        return {**super().prepare(case), "known": case.known}

    def known_of(self, cases, plans):
        return plans.point

    def find_minimum(self, context):
        slope = CURVED @ context["known"] - context["force"]
        return context["known"] - jnp.linalg.solve(CURVED, slope)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Beside(pj.Planner):
    """A planner whose plans are beside the minimum, at a distance that depends on the case."""

    case_type = Bowl

    def solve(self, case, attempt):
        plan = BowlPlan(point=minimum(case) + 1.0 + case.k, **pj.pending(-jnp.ones(())))
        return plan.replace(status=jnp.asarray(pj.Status.CONVERGED, jnp.int32))

    def smooth(self):
        return NearBowl()


def test_a_planner_with_a_smooth_problem_has_the_gradients_of_the_minima_near_its_plans(bowls):
    found = pj.gradient(Beside(), bowls, of=square, by=("b",), steps=3)
    best = np.asarray(jax.vmap(minimum)(bowls))
    np.testing.assert_allclose(found.plans.point, best, atol=1e-12)
    np.testing.assert_allclose(found.by["b"], 2.0 * best @ np.linalg.inv(CURVED), atol=1e-9)
    bowl = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), bowls)
    slopes = jax.jacrev(lambda b: optimal_plan(Beside(), bowl.replace(b=b)).point)(bowl.b)
    np.testing.assert_allclose(slopes, np.linalg.inv(CURVED), atol=1e-9)


def test_an_implicit_point_has_the_derivative_of_the_optimum(bowls):
    problem = BowlProblem()

    @jax.jit
    @jax.vmap
    def compare(b, k):
        def of_known_point(b, k):
            bowl = Bowl(b, k, jnp.zeros((), jnp.int32))
            point = jax.lax.stop_gradient(minimum(bowl))
            return jnp.sum(implicit_point(problem, bowl, point) ** 2)

        closed = lambda b, k: jnp.sum(minimum(Bowl(b, k, None)) ** 2)  # noqa: E731
        return [jax.value_and_grad(each, argnums=(0, 1))(b, k) for each in (of_known_point, closed)]

    found, expected = compare(bowls.b, bowls.k)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9), found, expected)


def test_the_optimum_of_one_problem_may_enter_the_case_of_another(bowls):
    bowl = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), bowls)
    inverse = np.linalg.inv(CURVED)

    def second(b, settle):
        first = settle(bowl.replace(b=b))
        return settle(bowl.replace(b=first))[1]

    def known(case):
        return implicit_point(BowlProblem(), case, jax.lax.stop_gradient(minimum(case)))

    slope = jax.grad(second)(bowl.b, known)
    np.testing.assert_allclose(slope, (inverse @ inverse)[1], rtol=1e-9)


def test_an_implicit_point_that_is_not_stationary_has_no_derivative_unless_it_is_unused(bowls):
    bowl = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), bowls)

    def value(b, meter, away, weight):
        case = bowl.replace(b=b)
        point = jax.lax.stop_gradient(minimum(case)) + away
        return weight * jnp.sum(implicit_point(BowlProblem(), case, point, meter, 3))

    differentiate = jax.jit(jax.grad(value, argnums=(0, 1)))
    by_b, meter = differentiate(bowl.b, jnp.zeros(2), 0.0, 1.0)
    np.testing.assert_allclose(by_b, np.linalg.inv(CURVED).sum(axis=0), rtol=1e-9)
    assert (meter < 1e-6).all()
    by_b, meter = differentiate(bowl.b, jnp.zeros(2), 0.3, 1.0)
    assert np.isnan(by_b).all() and meter[0] > 1e-6
    assert (differentiate(bowl.b, jnp.zeros(2), 0.3, 0.0)[0] == 0.0).all()


def test_a_batch_equals_its_lanes_and_a_broken_lane_affects_no_other(bowls):
    b = bowls.b.copy()
    b[2] = np.nan
    how = {"of": square, "by": ("b", "k"), "steps": 3}
    found = pj.gradient(BowlProblem.planner(), bowls.replace(b=b), **how)
    assert np.isnan(found.by["b"][2]).all() and found.plans.point.shape == (5, 3)
    for lane in (0, 1, 3, 4):
        one = jax.tree.map(lambda leaf, k=lane: leaf[k], bowls)
        alone = pj.gradient(BowlProblem.planner(), one, **how)
        np.testing.assert_allclose(found.by["b"][lane], alone.by["b"], rtol=1e-9)


def test_a_matrix_that_is_not_positive_has_a_finite_inverse(float64):
    inverse = jax.jit(positive_inverse)
    np.testing.assert_allclose(inverse(CURVED) @ CURVED, np.eye(3), atol=1e-12)
    assert np.isfinite(inverse(CURVED - 1.5 * np.eye(3))).all()


def test_the_kernel_gives_the_same_inverses():
    random = np.random.default_rng(3)
    roots = random.normal(size=(16, 5, 5))
    matrices = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(5)
    matrices[3] -= 2.0 * np.eye(5)  # not positive
    lanes = jnp.asarray(np.moveaxis(matrices, 0, -1), jnp.float32)
    (found,) = inverse_kernel(interpret=True)(jax.tree.structure([lanes]), [lanes])
    expected = jax.vmap(positive_inverse, in_axes=-1, out_axes=-1)(lanes)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "options, line",
    [
        ({"by": ("b.x",)}, "by must name a place in Bowl, got 'b.x'"),
        ({"by": ("kind",)}, "by must name floating numbers, got 'kind'"),
        ({"by": ()}, "by must name something"),
        ({"of": "speed"}, "of must name a place in BowlPlan, got 'speed'"),
        ({"of": "point"}, r"of must be one number, got shape \(3,\)"),
        ({"curvature": "none"}, "curvature must be one of products, whole, got 'none'"),
    ],
)
def test_invalid_arguments_are_named(bowls, options, line):
    with pytest.raises(ValueError, match=line):
        pj.gradient(BowlProblem.planner(), bowls, **{"of": "cost", "by": ("b",), **options})


def late_serve():
    return to_cases(generate_serves(8, 3)[1:2], delay=0.4, limit_scale=0.7, dtype=jnp.float64)


def easy_serve():
    return to_cases(generate_serves(8, 5)[1:2], dtype=jnp.float64)


def throw():
    return first_choice(pj.catch.Greedy(), pj.catch.draw(1, "throws", 3))


HIT = pj.hit.HitProblem(proportions=(0.2, 0.5, 1.0, 1.0, 1.0, 1.0))
TIMES = {
    HIT: lambda plan: plan.stroke.time,
    pj.catch.CatchProblem(): lambda plan: plan.times[-1],
}
HEIGHT, RATE, DRAG = {"racket_height": 1e-3}, {"limits.body_rate": 1e-3}, {"drag": 1e-4}
THROW = {"net.height": 1e-3, "gravity": 1e-3, "limits.speed": 1e-3}
CASES = {  # problem, case, steps of the differences by places in the case, options
    "hit": (HIT, late_serve, HEIGHT | DRAG | RATE, {"curvature": "whole"}),
    "hit by products": (HIT, late_serve, HEIGHT | RATE, {}),
    "hit without active limits": (HIT, easy_serve, HEIGHT | DRAG, {}),
    "catch": (pj.catch.CatchProblem(), throw, THROW, {"curvature": "whole"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_gradient_at_an_optimum_matches_differences_of_optima(name, float64):
    problem, make, steps, options = CASES[name]
    case, quantity = double(pj.take(make(), 0)), TIMES[problem]
    config = pj.LbfgsConfig(max_steps=200, tolerance=1e-7, patience=6)

    def objective_of(case):
        context = problem.prepare(case)
        return context, lambda x: problem.objective(x, context)

    @jax.jit
    def refine(case, point):
        context, objective = objective_of(case)
        point, _ = newton_refine(objective, point, max_steps=60, stationarity=1e-15)
        return point, quantity(problem.decode(point, context))

    @jax.jit
    def search(case):
        context, objective = objective_of(case)
        return minimise(objective, problem.guesses(context, 1)[0], config).point

    point, value = refine(case, search(case))
    take = functools.partial(gradient_at, problem, quantity=quantity, by=tuple(steps), **options)
    found = jax.jit(take)(case, point)
    np.testing.assert_allclose(found.value, value, rtol=1e-12)
    for place, step in steps.items():
        here = part_of(case, place)
        ahead, behind = (
            refine(replace_part(case, place, here + sign * step), point)[1] for sign in (1.0, -1.0)
        )
        numeric = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(found.by[place], numeric, rtol=5e-3, atol=2e-4, err_msg=place)

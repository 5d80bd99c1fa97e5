"""Planning, once a quadrotor sees a ball, of the catches of this ball and the next ball."""

import dataclasses
import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from planner_jax.ball.flight import BallState
from planner_jax.ball.target import BallPath
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.core.planner import Kind, Planner
from planner_jax.core.protocol import BaseAttempt, is_solved
from planner_jax.host.threads import as_here
from planner_jax.planning.plan import Driver, Watch
from planner_jax.planning.plan import plan as plan_all
from planner_jax.sims.loop import predict_balls
from planner_jax.sims.loop_state import FlightState, Loop
from planner_jax.sims.tasks.catch_pilot import BORNE, CatchPilot, tables
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.case import case as catch_case
from planner_jax.task.catch.plan import CatchPlan

# Fraction of the net's radius within which plans catch; the remainder is a margin for errors.
_AIM = 0.4
# Limits of plans, from tight limits to the robot's own limits. Each pair has a margin above the
# robot's least thrust, as a fraction of the range up to hover thrust, and a fraction of the robot's
# body rate limit. Weak thrusts and fast rotations leave little control authority. Plans of the
# first catch use the first pair, so that the next plan can start within its limits. Plans of later
# catches use the second pair. If no plan satisfies a pair, the next pair is used.
LIMITS = ((2.0 / 7.0, 0.6), (1.0 / 7.0, 0.9), (0.0, 1.0))
# Fraction of the robot's speed limit for plans of a single catch, if there is such a plan. The
# earliest catch of a high ball is often at full speed upwards, out of reach of the next ball.
_GENTLE = 0.5


@functools.partial(jax.jit, static_argnames="loop", compiler_options=QUICK_OPTIONS)
def predict_case(loop: Loop, flights: FlightState, new: Array, horizon: Array) -> CatchCase:
    """Return the cases for planning the catches of a newly seen ball and of the next ball.

    A plan starts at the last catch of an earlier ball, or now if no such catch is left. Times of
    the case count from the start of the plan.

    Args:
        loop: settings of the flights' loop.
        flights: states of B flights of N balls, leaves (B, ...).
        new: (N,) bool, the balls whose catches are to be planned.
        horizon: (B, N) [s] from now, last time at which each ball may be caught.
    """
    robot = loop.world.carrier
    # These targets are placeholders that the function `one` replaces by predicted balls.
    zeros = jnp.zeros((*horizon.shape, 3), horizon.dtype)
    nowhere = BallPath(BallState(zeros, zeros), drag=zeros, gravity=zeros[..., 0])
    empty = catch_case(
        nowhere,
        np.zeros(horizon.shape),
        robot=robot.model,
        gravity=loop.world.gravity,
        net_radius=_AIM * robot.tool.radius,
        wind=robot.wind if robot.model.drag else None,
        **bounds(loop, LIMITS[0 if flights.plan is None else 1]),
    )

    def one(case: CatchCase, flight: FlightState, horizon: Array) -> CatchCase:
        head, after = case.head_state, jnp.zeros_like(flight.time)
        if flight.plan is None:
            head = head.at[0].set(robot.state(flight.physics).pos)
        else:
            after = until_last_catch(flight, new)
            head = robot.head_state(flight.plan, flight.time - flight.began + after)
        balls = predict_balls(loop, flight.earlier, loop.period + after)
        horizon = horizon - after
        return dataclasses.replace(
            case,
            targets=tables(balls, flight.earlier.path_drag, horizon, case.gravity),
            present=new,
            horizon=horizon,
            head_state=head,
        )

    return jax.vmap(one)(empty, flights, horizon)


def until_last_catch(flight: FlightState, new: Array) -> Array:
    """Return the time [s] until the last planned catch of the balls that are not newly seen.

    `new` (N,) is true for newly seen balls. The time is 0 if no catch of another ball is left.
    """
    planned = CatchPilot().times(flight.plan) - (flight.time - flight.began)
    return jnp.maximum(jnp.max(jnp.where(flight.present & ~new, planned, 0.0)), 0.0)


@jax.jit
def with_catch(flights: FlightState, found: CatchPlan, new: Array) -> FlightState:
    """Return B flights whose plans continue with catches of newly seen balls.

    If an earlier ball is still to be caught, its catch is kept, and `found` is flown after it.
    Otherwise `found` replaces the flight's current plan at once.

    Args:
        flights: the flights that were passed to `predict_case`.
        found: plans of the B cases that `predict_case` returned.
        new: (B, N) bool, which of the N balls `found` catches.
    """

    def one(flight: FlightState, found: CatchPlan, new: Array) -> FlightState:
        present = flight.present | new
        alone = dataclasses.replace(flight, plan=found, began=flight.time, present=present)
        if flight.plan is None:
            return alone
        old, number = flight.plan, new.size
        each = found.trajectory.durations.size // number
        used = jnp.sum(old.trajectory.durations.reshape(number, each), axis=1) > 0.0
        # Number of catches that are kept from the old plan, including past catches. The found plan
        # replaces the old plan's last catch, which was planned for a ball that was not yet seen.
        num_kept = jnp.sum(used & ~new[old.order])
        place = jnp.arange(number)
        kept = place < num_kept

        def behind(old: Array, found: Array) -> Array:
            rows = jnp.where(kept, 0, place - num_kept)
            shape = (number, *(1,) * (old.ndim - 1))
            return jnp.where(kept.reshape(shape), old, found[rows])

        split = lambda leaf: leaf.reshape(number, each, *leaf.shape[1:])  # noqa: E731
        flat = lambda leaf: leaf.reshape(-1, *leaf.shape[2:])  # noqa: E731
        trajectory = jax.tree.map(
            lambda a, b: flat(behind(split(a), split(b))), old.trajectory, found.trajectory
        )
        end = old.times[num_kept - 1]
        rank = jnp.zeros_like(place).at[old.order].set(jnp.where(kept, place, 2 * number))
        behind_rank = jnp.zeros_like(place).at[found.order].set(number + place)
        order = jnp.argsort(jnp.where(new, behind_rank, rank), stable=True)
        joined = dataclasses.replace(
            found,
            trajectory=trajectory,
            order=order.astype(old.order.dtype),
            decided_times=behind(old.decided_times, end + found.decided_times),
            times=behind(old.times, end + found.times),
        )
        joined = dataclasses.replace(flight, plan=joined, present=present)
        busy = until_last_catch(flight, new) > 0.0  # whether an earlier ball is still to be caught
        return jax.tree.map(lambda a, b: jnp.where(busy, a, b), joined, alone)

    return jax.vmap(one)(flights, found, new)


@dataclasses.dataclass(frozen=True)
class _EveryAttempt(Driver):
    """A function that runs all attempts (searches) of a planner at once, so that they compile."""

    watch: Watch = dataclasses.field(default_factory=lambda: Watch(0.0))

    def __call__(
        self, planner: Planner, cases: Any, attempts: Sequence[BaseAttempt] | None = None
    ) -> tuple[Any, Any]:
        if planner.kind is not Kind.COMPILED:
            return super().__call__(planner, cases, attempts)
        make = functools.partial(super().__call__, planner, cases)
        tried = [[attempt] for attempt in attempts or planner.attempts]
        with ThreadPoolExecutor(len(tried)) as pool:
            first, *_ = pool.map(as_here(make), tried)
        return first


def compile_attempts(planner: Planner, cases: Any) -> None:
    """Compile the programs of all attempts of a planner concurrently, one thread per attempt.

    An attempt is a search with settings of its own. `plan` compiles an attempt only when the
    previous attempt has left cases unsolved. Some throws need all attempts, and compiling them one
    after another would take several times as long.
    """
    _EveryAttempt()(planner, cases)


def plan_ahead(
    planner: Planner[CatchCase, CatchPlan],
    known: CatchCase,
    ball: int,
    limits: Sequence[dict[str, Any]],
) -> tuple[CatchCase, CatchPlan]:
    """Plan to catch a ball and, if possible, also the next ball, without an earlier plan.

    If no plan for both balls is solved, both balls are planned again with wider limits of thrust
    and body rate, since after a plan for the first ball alone the next ball may be out of reach. If
    a plan still violates a limit by more than 10 %, the first ball is planned alone, at first
    with half of the speed limit. If no plan for this ball is solved, the plan with the least
    violation is returned.

    Args:
        planner: planner of catches, which also decides their order.
        known: cases with both balls, or with the last ball; a batch with NumPy leaves.
        ball: index of the ball among the targets.
        limits: increasingly wide limits, as returned by `bounds`. `known` has the first limits if
            this is the first ball, and the second limits for later balls.

    Returns:
        The cases and their plans; `present` marks the balls that each plan catches.
    """
    alone = np.arange(known.num_targets) == ball
    both = np.ones_like(alone)
    wider = limits[1 if ball == 0 else 2 :]
    tries: list[tuple[np.ndarray, dict[str, Any] | None]] = [(both, each) for each in wider]
    if ball < known.num_targets - 1:
        slow = {"speed": _GENTLE * known.limits.speed[0].item()}
        tries += [(alone, each) for each in (slow, None, *wider)]
    cases, plans = known, plan_all(planner, known)
    for balls, wide in tries:
        tried = known.present & balls
        same = (tried == cases.present).all(axis=1)
        unsolved = ~is_solved(np.asarray(plans.status))
        lanes = np.flatnonzero(unsolved & (same | ~(plans.violation <= BORNE)))
        if not lanes.size:
            continue
        part = dataclasses.replace(known, present=tried)
        part = jax.tree.map(lambda leaf, lanes=lanes: np.asarray(leaf)[lanes], part)
        part = within(part, wide)
        found = plan_all(planner, part)
        before = np.where(same, plans.violation, np.inf)[lanes]
        better = is_solved(np.asarray(found.status)) | (found.violation < before)
        to, chosen = lanes[better], np.flatnonzero(better)

        def merge(old: Any, new: Any, to: np.ndarray = to, chosen: np.ndarray = chosen) -> Any:
            old = np.array(old)
            old[to] = np.asarray(new)[chosen]
            return old

        cases, plans = jax.tree.map(merge, (cases, plans), (part, found))
    return cases, plans


def within(cases: CatchCase, limits: dict[str, Any] | None) -> CatchCase:
    """Replace limits of the cases by `limits`, numbers by name, unless it is None."""
    if limits is None:
        return cases
    leaves = {
        name: np.full_like(getattr(cases.limits, name), value) for name, value in limits.items()
    }
    return dataclasses.replace(cases, limits=dataclasses.replace(cases.limits, **leaves))


def bounds(loop: Loop, distance: tuple[float, float]) -> dict[str, Any]:
    """Return limits of least thrust [m/s^2] and body rate [rad/s] by name, for use in plans.

    `distance` is an entry of `LIMITS`. Its numbers are the margin of the thrust above the robot's
    least thrust, as a fraction of the range up to hover, and a fraction of the body rate limit.
    """
    model, gravity = loop.world.carrier.model, loop.world.gravity
    least, _ = model.thrust_bounds
    above, share = distance
    return {
        "min_thrust": least + above * (gravity - least),
        "body_rate": share * model.limits.body_rate,
    }

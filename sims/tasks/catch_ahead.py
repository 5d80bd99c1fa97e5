"""Catches planned ahead: of a ball that comes into sight and of the next one."""

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
from planner_jax.core.planner import Kind, Planner
from planner_jax.core.protocol import Attempt, is_solved
from planner_jax.host.machine import as_here
from planner_jax.planning.batch import Watch
from planner_jax.planning.drive import Driver
from planner_jax.planning.plan import plan as plan_all
from planner_jax.sims.loop import predict_balls
from planner_jax.sims.loop_state import FlightState, Loop
from planner_jax.sims.tasks.catch_pilot import BORNE, CatchPilot, tables
from planner_jax.task.catch.case import CatchCase
from planner_jax.task.catch.case import case as catch_case
from planner_jax.task.catch.plan import CatchPlan

_AIM = 0.4  # share of the net's radius that plans are made for; the rest is left for errors
# How far plans stay from the robot's least thrust, of the way from there to hover, and their share
# of its body rate. A weak thrust and a fast turn leave control little; the first catch stays away
# from them, so that the next can begin within bounds. Plans of later catches begin with the second
# limits. Where no plan keeps them, the next ones count; the last are as wide as the robot's own.
LIMITS = ((2.0 / 7.0, 0.6), (1.0 / 7.0, 0.9), (0.0, 1.0))


@functools.partial(jax.jit, static_argnames="loop")
def predict_case(loop: Loop, flights: FlightState, new: Array, horizon: Array) -> CatchCase:
    """What is believed of a ball that has come into sight and of the next one, to be planned.

    The plans begin where and when the last catch of a ball seen before will have been made, or
    now where no such catch is left; times count from there.

    Args:
        loop: of the flights.
        flights: leaves (B, ...).
        new: (N,) bool, the balls that are to be planned.
        horizon: (B, N) [s] from now, until when each may be caught.
    """
    robot = loop.world.carrier
    # Their targets are those that are seen, filled in below.
    zeros = jnp.zeros((*horizon.shape, 3), horizon.dtype)
    nowhere = BallPath(BallState(zeros, zeros), drag=zeros, gravity=zeros[..., 0])
    empty = catch_case(
        nowhere,
        np.zeros(horizon.shape),
        robot=robot.model,
        gravity=loop.world.gravity,
        net_radius=_AIM * robot.tool.radius,
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
            targets=tables(balls, flight.earlier.drag, horizon, case.gravity),
            present=new,
            horizon=horizon,
            head_state=head,
        )

    return jax.vmap(one)(empty, flights, horizon)


def until_last_catch(flight: FlightState, new: Array) -> Array:
    """Time () [s] to the last catch that is planned of balls not `new` (N,); 0 if none is left."""
    planned = CatchPilot().times(flight.plan) - (flight.time - flight.began)
    return jnp.maximum(jnp.max(jnp.where(flight.present & ~new, planned, 0.0)), 0.0)


@jax.jit
def with_catch(flights: FlightState, found: CatchPlan, new: Array) -> FlightState:
    """Flights (B, ...) whose plans go on with new catches after those of the balls seen before.

    Where a ball seen before is still to be caught, the new plan is appended to the one that is
    flown, after its last such catch. Elsewhere the new plan is flown alone, from now on.

    Args:
        flights: the ones for which `predict_case` was called.
        found: plans (B, ...) of the cases that it returned.
        new: (B, N) bool, the balls that `found` catches.
    """

    def one(flight: FlightState, found: CatchPlan, new: Array) -> FlightState:
        present = flight.present | new
        alone = dataclasses.replace(flight, plan=found, began=flight.time, present=present)
        if flight.plan is None:
            return alone
        old, number = flight.plan, new.size
        each = found.trajectory.durations.size // number
        used = jnp.sum(old.trajectory.durations.reshape(number, each), axis=1) > 0.0
        # How many catches of the old plan are kept, those already made included. The catch that
        # was only awaited comes last in the old plan; the found plan replaces it.
        num_kept = jnp.sum(used & ~new[old.order])
        place = jnp.arange(number)
        kept = place < num_kept

        def behind(old: Array, found: Array) -> Array:
            """Rows (N, ...), one a catch: those kept of the old plan, then the found plan's."""
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
        busy = until_last_catch(flight, new) > 0.0  # a ball seen before is still to be caught
        return jax.tree.map(lambda a, b: jnp.where(busy, a, b), joined, alone)

    return jax.vmap(one)(flights, found, new)


@dataclasses.dataclass(frozen=True)
class _EveryAttempt(Driver):
    """The driver that makes all attempts of a planner at the same time, needed or not."""

    watch: Watch = dataclasses.field(default_factory=lambda: Watch(0.0))  # no more is started

    def __call__(
        self, planner: Planner, cases: Any, attempts: Sequence[Attempt] | None = None
    ) -> tuple[Any, Any]:
        """Return the plans of the first attempt."""
        if planner.kind is not Kind.COMPILED:
            return super().__call__(planner, cases, attempts)
        make = functools.partial(super().__call__, planner, cases)
        tried = [[attempt] for attempt in attempts or planner.attempts]
        with ThreadPoolExecutor(len(tried)) as pool:
            first, *_ = pool.map(as_here(make), tried)
        return first


def compile_attempts(planner: Planner, cases: Any) -> None:
    """Compile all that plans of a batch may need, with a thread for each attempt.

    `plan` compiles an attempt as soon as the one before has left something unsolved. Some throws
    need all attempts, and to compile one after another would take several times as long.
    """
    _EveryAttempt()(planner, cases)


def plan_ahead(
    planner: Planner[CatchCase, CatchPlan],
    known: CatchCase,
    ball: int,
    limits: Sequence[dict[str, Any]],
) -> tuple[CatchCase, CatchPlan]:
    """Plans from scratch that catch a ball and, where that is possible too, the next one.

    Where no plan of both is found within the limits, both are planned for within wider ones:
    what catches the ball alone leaves the quadrotor where the next may be out of reach. Where that
    breaks a limit by more than is flown in the loop, the ball is planned for alone, and if nothing
    is solved, the plan of it that breaks its limits least is left.

    Args:
        planner: of catches, which also decides about their order.
        known: of both balls, or of the last one, a batch with NumPy leaves.
        ball: its place among the targets.
        limits: ever wider ones, as `bounds` has them, of which the first are those of `known` for
            the first ball and the second those for the others.

    Returns:
        The cases and their plans; `present` says which catches each has.
    """
    alone = np.arange(known.num_targets) == ball
    both = np.ones_like(alone)
    wider = limits[1 if ball == 0 else 2 :]
    tries: list[tuple[np.ndarray, dict[str, Any] | None]] = [(both, each) for each in wider]
    if ball < known.num_targets - 1:
        tries += [(alone, each) for each in (None, *wider)]
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
    """Cases with NumPy leaves with other limits, as `bounds` has them."""
    if limits is None:
        return cases
    leaves = {
        name: np.full_like(getattr(cases.limits, name), value) for name, value in limits.items()
    }
    return dataclasses.replace(cases, limits=dataclasses.replace(cases.limits, **leaves))


def bounds(loop: Loop, distance: tuple[float, float]) -> dict[str, Any]:
    """Least thrust [m/s^2] and greatest body rate [rad/s] of plans, as `LIMITS` has them."""
    model, gravity = loop.world.carrier.model, loop.world.gravity
    least, _ = model.thrust_bounds
    above, share = distance
    return {
        "min_thrust": least + above * (gravity - least),
        "body_rate": share * model.limits.body_rate,
    }

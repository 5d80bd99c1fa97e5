"""A fast planner of groups with many targets, without a search of grid cells.

A leg, the drive to one target, is a least-squares problem (`task.intercept.problem`) with a few
starting points, tried in sequence until a plan keeps every limit. The first is a direct motion that
meets the target in a direction between the directions of this leg and of the next one. The others
are pursuits: motions that steer towards the target, some of them slowly or with a detour. If all
fail, the previous leg is planned again from its next starting point. After every leg, the order of
the remaining targets is improved from the car's state (`order`).
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.core.planner import Planner
from planner_jax.core.protocol import BaseAttempt, Status, is_solved
from planner_jax.optimise.levenberg import LevenbergConfig
from planner_jax.plane.obstacles import place
from planner_jax.robot.car import pose_at
from planner_jax.task.group.case import CarState, InterceptGroup
from planner_jax.task.group.order import Departure, improve, make_table, meet
from planner_jax.task.group.plan import GroupPlan
from planner_jax.task.intercept.case import InterceptCase
from planner_jax.task.intercept.plan import InterceptPlan, make_plan, make_straight_plan
from planner_jax.task.intercept.problem.clearance import wrap
from planner_jax.task.intercept.problem.motion_problem import MotionProblem
from planner_jax.task.intercept.problem.terms import HORIZON
from planner_jax.task.intercept.searches import Search, make_field, make_grid
from planner_jax.task.intercept.units import enter_units, leave_units, units_of

if TYPE_CHECKING:
    from planner_jax.task.group.smooth import SmoothGroup

# The pursuits that starting points 1 to 7 of a leg follow, and the direct motion 0: the greatest
# speed divided by the car's, and the side of a detour, 1 to the left. The heading at the meeting is
# prescribed for the first two.
_SPEEDS = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.6, 0.3, 0.6])
_SIDES = np.array([0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 1.0])
_HEADED = 2
_LONGEST, _STEPS = 14.0, 96  # time and number of steps of a pursuit, in units of the case
_SEARCH = Search(1, LevenbergConfig(40), following=0, settling=12)
_PROBLEM = MotionProblem("early", pieces=12)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class DirectGroup(Planner[InterceptGroup, GroupPlan]):
    """Planner by which a car meets up to 40 targets, each as early as possible, in about 1 s.

    The order stored in a case is a proposal. With `moves` > 0 the planner changes it after every
    leg (drive to one target) by so many moves of a local search.

    Attributes:
        moves: number of moves of the local search of the order after every leg; 0: the order is
            kept.
        trials: greatest number of least-squares problems of a case.
        movers: number of moving obstacles in least squares; every plan is checked with all of them.
        turn: [rad], greatest deviation from the prescribed heading at a meeting.
        early: weight of a leg's duration, divided by the time up to which it may last.
    """

    case_type: ClassVar[type] = InterceptGroup
    is_sequential: ClassVar[bool] = True
    attempts: ClassVar[tuple[BaseAttempt, ...]] = (BaseAttempt(),)  # pyright: ignore[reportIncompatibleMethodOverride]
    moves: int = 3
    trials: int = 150
    movers: int = 8
    turn: float = 0.3
    early: float = 100.0

    def solve(self, case: InterceptGroup, attempt: BaseAttempt, /) -> GroupPlan:
        """Plan one case leg by leg; if a leg has no plan, plan the leg before it again."""
        shared, num = case.shared, case.num_targets
        table, count = make_table(case), jnp.sum(case.present)
        car = CarState(shared.start, shared.speed, shared.curvature)

        def repeat(tree: PyTree, size: int) -> PyTree:
            return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size, *jnp.shape(leaf))), tree)

        def try_next(state: tuple) -> tuple:
            k, number, tries, order, cars, begins, legs, steps = state
            car, begin = jax.tree.map(lambda leaf: leaf[k], cars), begins[k]
            following = jnp.where(k + 1 < count, order[jnp.minimum(k + 1, num - 1)], -1)
            plan = self._try_leg(case, order[k], following, begin, car, tries[k])
            is_good, is_last = is_solved(plan.status), tries[k] + 1 >= len(_SPEEDS)
            # A failed trial is stored, too, so that an unsolved leg has a plan to explain it.
            legs = jax.tree.map(lambda all_, one: all_.at[k].set(one), legs, plan)
            pose = pose_at(plan.start, plan.time, plan.speed, plan.curvature, plan.time)
            new = CarState(pose, plan.speed[-1], plan.curvature[-1])
            cars = jax.tree.map(lambda all_, one: all_.at[k + 1].set(one), cars, new)
            begins = begins.at[k + 1].set(begin + plan.time)
            tries = tries.at[k].add(1).at[k + 1].set(0)
            toward = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
            start = Departure(shared.body.middle_at(pose), toward, begins[k + 1])
            order = lax.cond(
                is_good & (self.moves > 0),
                lambda: improve(case, table, start, order, k + 1, self.moves),
                lambda: order,
            )
            k = jnp.where(is_good, k + 1, jnp.where(is_last, k - 1, k))
            return k, number + 1, tries, order, cars, begins, legs, steps + plan.iterations

        def is_open(state: tuple) -> Array:
            return (state[0] < count) & (state[0] >= 0) & (state[1] < self.trials)

        zero = jnp.zeros((), jnp.int32)
        empty = make_straight_plan(case.leg(case.order[0], shared.time, car), _PROBLEM.pieces)
        none = jnp.zeros_like(shared.time)
        nothing = dataclasses.replace(empty, time=none, violation=none, status=zero)
        state = (zero, zero, jnp.zeros(num + 1, jnp.int32), case.order, repeat(car, num + 1))
        state += (repeat(none, num + 1), repeat(nothing, num), zero)
        k, _, _, order, _, begins, legs, steps = lax.while_loop(is_open, try_next, state)
        # The leg `last` is the first unsolved leg. The legs behind it have no duration. After the
        # greatest number of trials it may hold no plan, or one that the next trial would replace.
        last, is_whole = jnp.clip(k, 0, num - 1), k >= count
        is_cut = ~is_whole & is_solved(legs.status[last])
        status = jnp.where(is_cut, Status.MAX_STEPS, legs.status[last])
        violation = jnp.where(is_cut, jnp.inf, legs.violation[last])
        is_planned = np.arange(num) <= last
        legs = dataclasses.replace(legs, time=jnp.where(is_planned, legs.time, 0.0))
        return GroupPlan(
            cost=begins[jnp.minimum(last + 1, count)],
            violation=jnp.where(is_whole, jnp.max(legs.violation), violation),
            iterations=steps,
            status=jnp.where(is_whole, Status.CONVERGED, status).astype(jnp.int32),
            order=order,
            begins=jnp.where(is_planned, begins[:num], begins[last]),
            legs=legs,
        )

    def smooth(self) -> "SmoothGroup":
        """Return the problem whose minima are near this planner's plans.

        Its legs know all movers, and may meet their targets in any direction.
        """
        from planner_jax.task.group.smooth import smooth_legs  # only gradients need it

        return smooth_legs(_PROBLEM)

    def _try_leg(
        self,
        group: InterceptGroup,
        target: Array,
        following: Array,
        begin: Array,
        car: CarState,
        trial: Array,
    ) -> InterceptPlan:
        """Plan the leg to `target` from starting point `trial`; `following` is -1 at the end."""
        shared, leg = group.shared, group.leg(target, begin, car)
        here = leg.body.middle_at(car.pose)
        path, later = (
            jax.tree.map(lambda x, k=k: x[k], shared.target) for k in (target, following)
        )
        at, goal = meet(path, here, begin, shared.limits.speed)
        ahead, after = goal - here, meet(later, goal, at, shared.limits.speed)[1] - goal
        # The car turns mostly on the longer leg.
        mean = ahead / jnp.sum(ahead**2) + after / jnp.maximum(jnp.sum(after**2), 1e-6)
        is_headed = (trial < _HEADED) & (following >= 0)
        # Least squares know only the movers that come nearest to a straight drive.
        share = jnp.linspace(0.0, 1.0, 5)
        placed = place(leg.movers, share * (at - begin))
        line = here[None] + share[:, None] * ahead[None]
        far = jnp.hypot(placed.x - line[None, :, 0], placed.y - line[None, :, 1]) - placed.radius
        far = jnp.min(jnp.where(placed.present, far, jnp.inf), axis=1)
        far -= jnp.sqrt(jnp.max(jnp.sum(leg.movers.corners**2, axis=2), axis=1))
        nearest = lax.top_k(-far, min(self.movers, far.size))[1]
        few = dataclasses.replace(
            leg,
            movers=jax.tree.map(lambda leaf: leaf[nearest], leg.movers),
            time=jnp.minimum(1.5 * (at - begin) + 2.0 * units_of(leg).time, leg.time),
            end_heading=jnp.where(is_headed, jnp.arctan2(mean[1], mean[0]), shared.end_heading),
            heading_tolerance=jnp.where(is_headed, self.turn, shared.heading_tolerance),
        )
        units = units_of(few)
        local = enter_units(few, units)
        first = trial == 0
        hold = jnp.where(is_headed, 0.6, 0.0)
        speed, side = (jnp.asarray(each, begin.dtype)[trial] for each in (_SPEEDS, _SIDES))
        pursuit = _pursue(local, speed, side, hold)
        longer = jnp.minimum(1.3 * pursuit[-1] + 1.0, leg.time / units.time)
        local = dataclasses.replace(local, time=jnp.where(first, local.time, longer))
        guess = _PROBLEM.guess_directly(local, False)
        guess = dataclasses.replace(guess, point=jnp.where(first, guess.point, pursuit))
        keep, hurry = _PROBLEM.list_last_stages(_SEARCH)
        early = self.early * (HORIZON / local.time) ** 2
        weights = [dataclasses.replace(keep.weights, early=w) for w in (0.0, early)]
        stages = [
            dataclasses.replace(keep, weights=weights[0], tolerance=1.0, settled=1),
            dataclasses.replace(hurry, weights=weights[1], tolerance=3e-3, settled=2),
        ]
        field = make_field(local, make_grid(local, _SEARCH.lattice, is_time_free=True))
        plan = _PROBLEM.refine(local, field, guess, _SEARCH, stages)
        plan = leave_units(plan, few, units, is_early=True)
        motion = plan.time, plan.speed, plan.curvature
        checks = {"samples": _PROBLEM.checked, "points": 32, "steps": plan.iterations}
        return dataclasses.replace(make_plan(leg, *motion, **checks), cost=plan.time)


def _pursue(case: InterceptCase, speed: Array, side: Array, hold: Array) -> Array:
    """Return the unknowns (n,) of a motion that steers along arcs towards the target.

    Args:
        case: the leg, in its units.
        speed: (), greatest speed divided by the car's.
        side: (), 1 or -1 for a detour to the left or right at first, 0 for none.
        hold: (), distance behind the target, divided by the car's distance from it, of the point
            that the car steers to. Thereby it meets the target at the case's `end_heading`.
    """
    limits, step = case.limits, _LONGEST / _STEPS
    end = jnp.stack([jnp.cos(case.end_heading), jnp.sin(case.end_heading)])
    slow = jnp.sqrt(limits.lateral_acceleration / limits.curvature)
    bend = 0.95 * limits.curvature

    def drive(state: tuple, k: Array) -> tuple[tuple, tuple[Array, Array]]:
        pose, v, c, is_met, time, nearest = state
        now = k * step
        far = jnp.sqrt(jnp.sum((case.target.at(now).pos - case.body.middle_at(pose)) ** 2) + 1e-6)
        ahead = now + far / jnp.maximum(v, 0.5 * limits.speed * speed)
        goal = case.target.at(ahead).pos - (case.body.middle + hold * far) * end
        x, y = goal - pose[:2]
        angle = wrap(jnp.arctan2(y, x) - pose[2]) + 0.8 * side * jnp.exp(-now)
        apart = jnp.sqrt(x**2 + y**2 + 1e-6)
        is_behind = jnp.abs(angle) > 0.5 * np.pi
        need = jnp.where(is_behind, jnp.sign(angle) * limits.curvature, 2 * jnp.sin(angle) / apart)
        # A goal inside the smallest circle is left behind first.
        is_inside = (jnp.abs(need) > bend) & (apart < 2.0 / limits.curvature)
        fast = jnp.sqrt(0.9 * limits.lateral_acceleration / jnp.maximum(jnp.abs(need), 1e-3))
        wanted = jnp.maximum(jnp.minimum(speed * limits.speed, fast), 0.4 * slow)
        gain = 0.9 * limits.acceleration * step
        v1 = v + jnp.clip(wanted - v, -gain, gain)
        most = jnp.minimum(bend, 0.95 * limits.lateral_acceleration / jnp.maximum(v1, 1e-3) ** 2)
        c1 = jnp.clip(jnp.where(is_inside, 0.0, need), -most, most)
        rate = limits.steering_rate / case.body.wheelbase * step
        c1 = c + jnp.clip(c1 - c, -rate, rate)
        heading = pose[2] + 0.5 * (v * c + v1 * c1) * step
        between, length = 0.5 * (pose[2] + heading), 0.5 * (v + v1) * step
        move = [length * jnp.cos(between), length * jnp.sin(between), heading - pose[2]]
        pose = pose + jnp.stack(move)
        gap = case.target.at(now + step).pos - case.body.middle_at(pose)
        miss = jnp.sqrt(jnp.sum(gap**2))
        is_nearer = ~is_met & (miss < nearest)
        is_met |= ~is_nearer & (nearest < length)
        time = jnp.where(is_nearer, now + step, time)
        return (pose, v1, c1, is_met, time, jnp.minimum(miss, nearest)), (v1, c1)

    like = case.time
    state = (case.start, case.speed, case.curvature, jnp.asarray(False), 0.0 * like + _LONGEST)
    numbers = jnp.arange(_STEPS, dtype=like.dtype)
    end_state, knots = lax.scan(drive, (*state, 0.0 * like + 1e6), numbers)
    time, grid = end_state[4], step * jnp.arange(1, _STEPS + 1, dtype=like.dtype)
    at = time * jnp.arange(1, _PROBLEM.pieces + 1, dtype=like.dtype) / _PROBLEM.pieces
    speeds, curvatures = (jnp.interp(at, grid, values) for values in knots)
    return _PROBLEM.pack(speeds, curvatures, time)

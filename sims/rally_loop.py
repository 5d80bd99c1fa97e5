"""The closed loop of rallies: robots hit one ball again and again, without an end.

As in `sims.loop`, the robot is controlled in every physics step, the ball is observed at a lower
rate, and the next hits are planned anew at a still lower rate. In addition the racket reflects the
ball in the physics. The robot feels the impact at once, but sees the ball's new flight one latency
later. The estimate of the ball therefore crosses an impact by the library's impact map. After every
impact the robot estimates the coefficient of restitution from the ball's velocities before and
after the impact. During every flight the robot estimates the drag.

One robot hits alone, or two robots hit in turn. Each of two robots has an MJX world of its own with
a copy of the ball, as robots and ball touch only at impacts. The robot that does not hit next plans
for the ball that its partner's plan will return.

The state of a trial has a fixed size, so that the number of hits does not change the memory.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.ball.estimation import EkfState, congruence
from planner_jax.ball.flight import BallState, fly
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.planning.replan import Replanning
from planner_jax.planning.replanner import Replanner
from planner_jax.robot.attitude import tilt_quaternion
from planner_jax.sims import sensing as sight
from planner_jax.sims.launch import watch_ball
from planner_jax.sims.loop import track
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import at_rest, ball_states, place_balls
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact, Moment, moment, passage, racket_impact
from planner_jax.sims.sensing import Estimate, RlsState, rls_update
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.default_planner import RallyProblem
from planner_jax.task.rally.plan import RallyPlan
from planner_jax.task.rally.replan import REMAINDER, count_done
from planner_jax.task.rally.suites import Course

LOWEST = 0.3  # [m], height below which a ball is lost
_LEARNING = 0.25  # [s], after an impact, when the restitution is estimated from the new flight
_RESTITUTION_SPREAD = 0.1  # standard deviation of the first estimate of the restitution
# Standard deviation [m/s] of the difference of the ball's velocities before and after an impact, by
# errors of the estimates and of the racket's velocity.
_JUMP_STD = 0.15
_IMPACT_STD = (0.01, 0.1)  # [m], [m/s], additional deviations of a ball's estimate by an impact
_FLIGHT_STEPS = 4  # number of integration steps of a prediction


@struct.dataclass
class Bounce:
    """The last impact as the robot felt it."""

    time: Array  # () [s]; -inf before the first impact
    tool_vel: Array  # (3,) [m/s], velocity of the racket at the ball
    normal: Array  # (3,), unit normal of the racket
    ball_vel: Array  # (3,) [m/s], estimated velocity of the ball before the impact
    is_due: Array  # () bool, whether the estimate of the ball belongs to a time before the impact
    is_learned: Array  # () bool, whether the restitution was estimated from this impact


@struct.dataclass
class Passage:
    """The ball's last passage through the racket's plane, which was a hit or a miss."""

    offset: Array  # () [m], distance of the ball from the racket's centre in the racket's plane
    tracking: Array  # () [m], distance of the robot from its plan then
    late: Array  # () [s], time of that passage after the planned time
    violation: Array  # (), greatest relative excess of the plan over a limit
    restitution: Array  # (), error of the estimated restitution
    drag: Array  # (), relative error of the estimated drag


@struct.dataclass
class Trial:
    """The variables of one trial of N robots: physics, estimates, plans and scores."""

    physics: Physics  # leaves (N, ...), of each robot's world
    shown: Array  # (L, 3) [m], true positions of the ball that are still to be observed
    estimate: Estimate  # of the ball, one latency ago
    bounce: Bounce
    restitution: RlsState  # estimate of 1 + (coefficient of restitution)
    plan: RallyPlan  # leaves (N, ...), of each robot
    began: Array  # (N,) [s], start times of the plans
    planned: Array  # (N,) int32, number of each robot's hits before its plan's start
    hits: Array  # () int32, number of hits of all robots so far
    lost: Array  # () bool, whether the trial has ended by a rule of `RallyPilot.course`
    aimed: Array  # () int32, number of hits so far whose ball had to come to the circle
    inside: Array  # () int32, number of these balls that were met in the circle
    last: Passage
    worst_offset: Array  # () [m], greatest offset of a hit so far
    sum_offset: Array  # () [m], sum of the offsets of all hits
    worst_tracking: Array  # () [m], greatest distance from the plan so far
    squared_tracking: Array  # () [m^2 s], integral of the squared distance
    tracked: Array  # () [s], duration over which the squared distance is integrated
    time: Array  # () [s]
    key: Array


@struct.dataclass
class Frames:
    """The states of B trials at O observations in each of P planning periods."""

    qpos: Array  # (P, B, O, N, R + 3), joint positions of each robot and the ball
    wanted: Array  # (P, B, O, N, 3) [m], planned positions of the robots


@dataclasses.dataclass(frozen=True)
class RallyPilot:
    """The part of the loop that plans the next hits in every planning period."""

    planner: Replanner = REMAINDER.planner_of(RallyProblem())
    course: Course = Course()
    # A plan does not change in the last `shortest` [s] before a planned impact, as the tracking
    # error that a change causes would not decay before it, and not until `settled` [s] after it.
    shortest: float = 0.4
    settled: float = 0.04
    excess: float = 0.1  # greatest relative violation of a limit by a plan that is always flown
    # [m], distance of the next contact from the old plan's contact, from which on a plan that
    # violates limits by up to `desperate` is flown, too
    astray: float = 0.08
    desperate: float = 1.0


def _pick(condition: Array, new: PyTree, old: PyTree) -> PyTree:
    """Return `new` where a condition () or (N,) holds, else `old`, for leaves (...) or (N, ...)."""
    shaped = lambda leaf: condition.reshape(condition.shape + (1,) * (leaf.ndim - condition.ndim))  # noqa: E731
    return jax.tree.map(lambda a, b: jnp.where(shaped(a), a, b), new, old)


def _at(tree: PyTree, index: Array | int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _own_hits(trial: Trial, robots: Array) -> Array:
    """Return how many hits each robot (N,) has had; the robots hit in turn, robot 0 first."""
    return (trial.hits - robots + robots.size - 1) // robots.size


def _sides(num: int, dtype: DTypeLike) -> Array:
    """Return factors (N, 3) that convert the first robot's positions to those of each robot."""
    return jnp.ones((num, 3), dtype).at[1:, 0].set(-1.0)


def _predict(trial: Trial, loop: Loop, ahead: float) -> BallState:
    """Return the ball `ahead` [s] from now, across an impact that it has not been seen to pass."""
    gravity = jnp.asarray(loop.world.gravity, trial.time.dtype)
    span = jnp.asarray(loop.sensing.latency + ahead, trial.time.dtype)
    since = trial.time - loop.sensing.latency
    is_due = trial.bounce.is_due
    first = jnp.where(is_due, jnp.clip(trial.bounce.time - since, 0.0, span), 0.0)
    go = functools.partial(fly, drag=trial.estimate.drag, gravity=gravity, num_steps=_FLIGHT_STEPS)
    ball = go(trial.estimate.belief.ball, first)[0]
    vel = jnp.where(is_due, _reflect(trial, ball.vel), ball.vel)
    return go(BallState(ball.pos, vel), span - first)[0]


def _reflect(trial: Trial, vel: Array) -> Array:
    bounce, restitution = trial.bounce, trial.restitution.estimate - 1.0
    return racket_impact(vel, bounce.tool_vel, bounce.normal, restitution)


def _reflect_belief(trial: Trial, belief: EkfState) -> EkfState:
    """Return the belief about a ball just after the impact that the robot has felt."""
    bounce, restitution = trial.bounce, trial.restitution
    normal = bounce.normal
    turn = jnp.eye(3) - restitution.estimate * normal[:, None] * normal[None]
    P = congruence(jnp.eye(6).at[3:, 3:].set(turn), belief.covariance)
    approach = jnp.sum((belief.mean[3:] - bounce.tool_vel) * normal)
    along = restitution.variance * approach**2 * normal[:, None] * normal[None]
    stds = jnp.repeat(jnp.asarray(_IMPACT_STD, P.dtype), 3)
    P = P + jnp.diag(stds**2) + jnp.zeros_like(P).at[3:, 3:].set(along)
    mean = jnp.concatenate([belief.mean[:3], _reflect(trial, belief.mean[3:])])
    return EkfState(mean=mean, covariance=P)


def _observe(trial: Trial, loop: Loop, seen: Array) -> Trial:
    """Return a trial after one observation (3,) [m], which may be missing (NaN)."""
    sensing, dtype = loop.sensing, trial.time.dtype
    gravity = jnp.asarray(loop.world.gravity, dtype)
    period = jnp.asarray(1.0 / sensing.rate, dtype)
    until = trial.time - sensing.latency  # time of the estimate after the observation
    bounce, estimate = trial.bounce, trial.estimate
    crosses = bounce.is_due & (bounce.time <= until)
    first = jnp.where(crosses, jnp.clip(bounce.time - until + period, 0.0, period), 0.0)

    before = sight.advance_belief(estimate, first, sensing, gravity)
    after = _reflect_belief(trial, before)
    settled = dataclasses.replace(sight.settle_drag(estimate, gravity), belief=after)
    started = dataclasses.replace(estimate, belief=before)
    estimate = _pick(crosses, settled, started)
    bounce = dataclasses.replace(
        bounce,
        ball_vel=jnp.where(crosses, before.mean[3:], bounce.ball_vel),
        is_due=bounce.is_due & ~crosses,
    )
    estimate = sight.update_estimate(estimate, seen, sensing, gravity, period - first)

    age = until - bounce.time
    learns = (age >= _LEARNING) & ~bounce.is_learned
    ago = jnp.where(learns, -age, 0.0)
    then = fly(estimate.belief.ball, ago, estimate.drag, gravity, num_steps=_FLIGHT_STEPS)[0]
    jump = jnp.sum((then.vel - bounce.ball_vel) * bounce.normal)
    approach = jnp.sum((bounce.tool_vel - bounce.ball_vel) * bounce.normal)
    learned = rls_update(trial.restitution, approach / _JUMP_STD, jump / _JUMP_STD)
    known = bounce.is_learned | learns
    anchored, usual = sight.anchor_energy(estimate, gravity), sight.with_drag(estimate, gravity)
    return dataclasses.replace(
        trial,
        estimate=_pick(learns, anchored, _pick(known, usual, estimate)),
        restitution=_pick(learns, learned, trial.restitution),
        bounce=dataclasses.replace(bounce, is_learned=known),
    )


def _fly_to_observation(loop: Loop, pilot: RallyPilot, trial: Trial, case: RallyCase) -> Trial:
    world, robot, dtype = loop.world, loop.world.robot, trial.time.dtype
    num, course = trial.began.size, pilot.course
    key, noise_key, look_key = jax.random.split(trial.key, 3)
    noise = jax.random.normal(noise_key, (num, *robot.noise_shape), dtype)
    times = trial.time + world.timestep * jnp.arange(loop.steps_per_observation, dtype=dtype)
    refer = lambda plan, began: robot.references(plan, times - began, world)  # noqa: E731
    references = jax.vmap(refer, out_axes=1)(trial.plan, trial.began)
    drag = case.drag[None]
    stands = trial.began[:, None] + trial.plan.strokes.time
    moments = jax.vmap(functools.partial(moment, world))

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        trial, before = carry
        reference, time = now
        track_one = lambda at, to, noise: track(loop, at, to, noise, drag)  # noqa: E731
        states, physics = jax.vmap(track_one)(trial.physics, reference, noise)
        after = moments(physics)
        due = jax.vmap(lambda own: own[jnp.argmin(jnp.abs(own - time))])(stands)
        pass_one = lambda a, b, due, pos: passage(world, a, b, time, due[None], pos)  # noqa: E731
        passes, contacts = jax.vmap(pass_one)(before, after, due, reference.pos)
        passes, contacts = jax.tree.map(lambda leaf: leaf[:, 0], (passes, contacts))
        met, turn = passes & contacts.met, trial.hits % num
        striker = jnp.argmax(met)
        contact, hit = _at(contacts, striker), jnp.any(met)
        lost = trial.lost | (hit & (striker != turn)) | _breaks_rule(course, before, after)
        trial = dataclasses.replace(trial, lost=lost)
        trial = _score(trial, case, course, passes[turn], _at(contacts, turn))
        vel = racket_impact(contact.ball_vel, contact.tool_vel, contact.normal, case.restitution)
        left = time + world.timestep - contact.time
        ball = BallState((contact.ball_pos + left * vel)[None], vel[None])
        place = lambda physics: place_balls(world, physics, ball, drag, hit[None])  # noqa: E731
        physics = jax.vmap(place)(physics)
        felt = world.carrier.tool_motion(_at(states, striker))
        feel = Bounce(
            time=time + world.timestep,
            tool_vel=felt[1] + jnp.cross(felt[2], world.carrier.tool.height * felt[3]),
            normal=felt[3],
            ball_vel=trial.bounce.ball_vel,
            is_due=jnp.ones((), bool),
            is_learned=jnp.zeros((), bool),
        )
        squared = jnp.sum((before.robot_pos - reference.pos) ** 2, axis=1)
        lasts = jnp.where(trial.lost, 0.0, world.timestep)
        away = jnp.where(trial.lost, 0.0, jnp.sqrt(jnp.max(squared)))
        trial = dataclasses.replace(
            trial,
            physics=physics,
            bounce=_pick(hit, feel, trial.bounce),
            worst_tracking=jnp.maximum(trial.worst_tracking, away),
            squared_tracking=trial.squared_tracking + lasts * jnp.mean(squared),
            tracked=trial.tracked + lasts,
        )
        return (trial, moments(physics)), None

    plan = trial.plan
    start = dataclasses.replace(trial, plan=None)
    (trial, _), _ = lax.scan(advance, (start, moments(trial.physics)), (references, times))
    at = ball_states(world, _at(trial.physics, 0))[0][0]
    shown = jnp.concatenate([trial.shown, at[None]])
    trial = dataclasses.replace(
        trial,
        plan=plan,
        shown=shown[1:],
        lost=trial.lost | (at[2] < LOWEST),
        time=trial.time + 1.0 / loop.sensing.rate,
        key=key,
    )
    return _observe(trial, loop, sight.observe(look_key, shown[:1], loop.sensing)[0])


def _breaks_rule(course: Course, before: Moment, after: Moment) -> Array:
    """Return whether a robot is too low or high, or the ball flies into the net, () bool."""
    breaks = jnp.zeros((), bool)
    if course.heights != Course.heights:
        height, (low, high) = after.robot_pos[:, 2], course.heights
        breaks |= jnp.any((height < low) | (height > high))
    if course.net:
        ball, there = before.ball_pos[0, 0], after.ball_pos[0, 0]
        breaks |= (ball[0] * there[0] <= 0.0) & (ball[2] < course.net)
    return breaks


def _score(trial: Trial, case: RallyCase, course: Course, passes: Array, contact: Contact) -> Trial:
    """Return a trial after a step, in which the ball may pass the plane of the next racket."""
    counts = passes & ~trial.lost
    hit = counts & contact.met
    last = Passage(
        offset=contact.offset,
        tracking=contact.tracking,
        late=contact.time - contact.planned_time,
        violation=trial.last.violation,
        restitution=trial.restitution.estimate - 1.0 - case.restitution,
        drag=trial.estimate.drag / jnp.where(case.drag > 0.0, case.drag, 1.0) - (case.drag > 0.0),
    )
    offset = jnp.where(hit, contact.offset, 0.0)
    num = case.places.shape[0]
    comes = counts & (trial.hits > 0) & (trial.hits % num == 0) & math.isfinite(course.circle)
    aside = jnp.sum((contact.ball_pos - case.places[-1])[:2] ** 2)
    return dataclasses.replace(
        trial,
        hits=trial.hits + hit,
        last=_pick(counts, last, trial.last),
        worst_offset=jnp.maximum(trial.worst_offset, offset),
        sum_offset=trial.sum_offset + offset,
        aimed=trial.aimed + comes,
        inside=trial.inside + (comes & (aside <= course.circle**2)),
    )


def _plan(
    loop: Loop, pilot: RallyPilot, trial: Trial, case: RallyCase
) -> tuple[RallyPlan, Array, Array]:
    """Return plans that may start at the period's end, whether they do, and their hits before.

    All leaves are (N, ...). A robot that does not hit next plans for the ball after its partner's
    next planned hit.
    """
    num = trial.began.size
    robots, now = jnp.arange(num), trial.time + loop.period
    ahead = trial.plan.strokes.time.shape[-1]
    turn, own = trial.hits % num, _own_hits(trial, robots)
    balls: PyTree = (_predict(trial, loop, loop.period), jnp.zeros_like(now))
    balls = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), balls)
    if num > 1:
        index = jnp.clip(own[turn] - trial.planned[turn], 0, ahead - 1)
        stroke = _at(_at(trial.plan.strokes, turn), index)
        struck = BallState(stroke.ball_pos, stroke.ball_vel_after)
        returned = struck, trial.began[turn] + stroke.time - now
        balls = _pick(robots == turn, balls, jax.tree.map(lambda leaf: leaf[None], returned))
    tell = dataclasses.replace(
        case, drag=trial.estimate.drag, restitution=trial.restitution.estimate - 1.0
    )

    def plan_one(
        ball: tuple, plan: RallyPlan, began: Array, before: Array, own: Array, side: Array
    ) -> tuple[RallyPlan, Array, Array]:
        elapsed = now - began
        done = count_done(plan, elapsed)
        planned = before + done
        boxes = (planned + jnp.arange(ahead)) % case.places.shape[0]
        own_case = dataclasses.replace(
            tell,
            ball=ball[0],
            ball_time=ball[1],
            head_state=loop.world.carrier.head_state(plan, elapsed),
            places=case.places[boxes] * side,
            place_range=case.place_range[boxes],
            home=None if case.home is None else case.home * side,
        )
        task = Replanning(case=own_case, previous=plan, elapsed=elapsed)
        new = pilot.planner.solve(task, pilot.planner.attempts[0])
        left = plan.strokes.time - elapsed
        is_free = ~jnp.any((left > -pilot.settled) & (left < pilot.shortest))
        is_free &= (own == planned) & (new.strokes.time[0] >= pilot.shortest)
        # A plan that misses the ball is worse than one that exceeds a limit for a while.
        next_hit = jnp.minimum(done, ahead - 1)
        aside = jnp.sum((new.strokes.ball_pos[0] - plan.strokes.ball_pos[next_hit]) ** 2)
        is_astray = (aside > pilot.astray**2) | (done == ahead)
        most = jnp.where(is_astray, pilot.desperate, pilot.excess)
        good = new.violation <= jnp.maximum(most, plan.violation)
        return new, is_free & good, planned

    each = balls, trial.plan, trial.began, trial.planned, own, _sides(num, now.dtype)
    return jax.vmap(plan_one)(*each)


@functools.partial(
    jax.jit, static_argnames=("loop", "pilot", "num_periods"), compiler_options=QUICK_OPTIONS
)
def fly_on(
    loop: Loop,
    pilot: RallyPilot,
    trials: Trial,
    cases: RallyCase,
    num_periods: int,
) -> tuple[Trial, Frames]:
    """Simulate `num_periods` planning periods of a batch of B trials, leaves (B, ...).

    `cases` have the true numbers of ball and racket, and the boxes of the places of all hits.
    Times of the result count from its end, so that they stay exact in float32 for any duration.
    """

    def observe_once(trial: Trial, case: RallyCase) -> tuple[Trial, Frames]:
        trial = _fly_to_observation(loop, pilot, trial, case)
        state = jax.vmap(loop.world.carrier.head_state)(trial.plan, trial.time - trial.began)
        return trial, Frames(trial.physics.qpos, state[:, 0])

    def one_period(trial: Trial, case: RallyCase) -> tuple[Trial, Frames]:
        plan, good, planned = _plan(loop, pilot, trial, case)
        body = lambda trial, _: observe_once(trial, case)  # noqa: E731
        trial, frames = lax.scan(body, trial, None, length=loop.observations_per_plan)
        began = jnp.broadcast_to(trial.time, planned.shape)
        old = trial.plan, trial.began, trial.planned
        plan, began, planned = _pick(good, (plan, began, planned), old)
        violation = plan.violation[trial.hits % began.size]
        last = dataclasses.replace(trial.last, violation=violation)
        trial = dataclasses.replace(trial, plan=plan, began=began, planned=planned, last=last)
        return trial, frames

    every = jax.vmap(one_period)
    body = lambda now, _: every(now, cases)  # noqa: E731
    trials, frames = lax.scan(body, trials, None, length=num_periods)
    trials = dataclasses.replace(
        trials,
        time=jnp.zeros_like(trials.time),
        began=trials.began - trials.time[:, None],
        bounce=dataclasses.replace(trials.bounce, time=trials.bounce.time - trials.time),
    )
    return trials, frames


@functools.partial(jax.jit, static_argnames=("loop", "seen"))
def begin_trials(
    loop: Loop,
    cases: RallyCase,
    believed_drag: Array,
    believed_restitution: Array,
    keys: Array,
    seen: float,
) -> Trial:
    """Return B trials at the start: a hovering robot, and a ball seen for `seen` [s]; no plan."""
    num = 1 if cases.home is None else 2

    def stand(case: RallyCase, side: Array) -> Physics:
        """Return a robot's world at the start, in the attitude that its acceleration needs."""
        robot = at_rest(loop.world, case.head_state[0] * side)
        acc = case.head_state[2] * side
        tilted = tilt_quaternion(acc, jnp.asarray(loop.world.gravity, acc.dtype))
        turned = jnp.where(jnp.any(acc != 0.0), tilted, robot.qpos[3:7])
        robot = dataclasses.replace(robot, qpos=robot.qpos.at[3:7].set(turned))
        ball = jax.tree.map(lambda leaf: leaf[None], case.ball)
        return place_balls(loop.world, robot, ball, case.drag[None], jnp.ones(1, bool))

    def one(case: RallyCase, drag: Array, restitution: Array, key: Array) -> Trial:
        key, look_key = jax.random.split(key)
        zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        shown, _, estimate = watch_ball(loop, case.ball, case.drag, drag, look_key, seen)
        vector = jnp.zeros(3)
        return Trial(
            physics=jax.vmap(stand, (None, 0))(case, _sides(num, zero.dtype)),
            shown=shown,
            estimate=estimate,
            bounce=Bounce(
                -jnp.inf + zero, vector, vector, vector, ~jnp.ones((), bool), jnp.ones((), bool)
            ),
            restitution=RlsState(1.0 + restitution, _RESTITUTION_SPREAD**2 + zero),
            plan=None,  # type: ignore[arg-type]
            began=jnp.zeros(num),
            planned=jnp.zeros(num, jnp.int32),
            hits=none,
            lost=jnp.zeros((), bool),
            aimed=none,
            inside=none,
            last=Passage(zero, zero, zero, zero, zero, zero),
            worst_offset=zero,
            sum_offset=zero,
            worst_tracking=zero,
            squared_tracking=zero,
            tracked=zero,
            time=zero,
            key=key,
        )

    return jax.vmap(one)(cases, believed_drag, believed_restitution, keys)


def first_cases(loop: Loop, trials: Trial, cases: RallyCase, ahead: int) -> RallyCase:
    """Return the first planning problems, of `ahead` hits, of first robots, as they know them."""
    balls = jax.jit(jax.vmap(lambda trial: _predict(trial, loop, 0.0)))(trials)
    return dataclasses.replace(
        cases,
        ball=balls,
        drag=trials.estimate.drag,
        restitution=trials.restitution.estimate - 1.0,
        places=cases.places[:, :ahead],
        place_range=cases.place_range[:, :ahead],
    )


@jax.jit
def partner_cases(cases: RallyCase, plans: RallyPlan) -> RallyCase:
    """Return the second robots' first planning problems, from the first robots' plans."""

    def one(case: RallyCase, plan: RallyPlan) -> RallyCase:
        assert case.home is not None
        side, stroke = _sides(2, case.gravity.dtype)[1], _at(plan.strokes, 0)
        return dataclasses.replace(
            case,
            ball=BallState(stroke.ball_pos, stroke.ball_vel_after),
            ball_time=stroke.time,
            head_state=case.head_state * side,
            places=case.places * side,
            home=case.home * side,
        )

    return jax.vmap(one)(cases, plans)

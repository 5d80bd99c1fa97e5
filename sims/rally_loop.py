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
from jax import Array, lax
from jax.typing import DTypeLike
from jaxtyping import PyTree

from planner_jax.ball.flight import BallState
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.perception.drag import RlsState
from planner_jax.planning.replan import Replanning
from planner_jax.planning.replanner import Replanner
from planner_jax.robot.attitude import tilt_quaternion
from planner_jax.sims import sensing as sight
from planner_jax.sims.launch import watch_ball
from planner_jax.sims.loop import track
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import at_rest, ball_states, place_balls
from planner_jax.sims.rally_ball import observe, predict
from planner_jax.sims.rally_state import Bounce, Frames, Passage, Trial, pick
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact, Moment, moment, passage, racket_impact
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.default_planner import RallyProblem
from planner_jax.task.rally.plan import RallyPlan
from planner_jax.task.rally.replan import REMAINDER, count_done
from planner_jax.task.rally.suites import Course

LOWEST = 0.3  # [m], height below which a ball is lost
_RESTITUTION_SPREAD = 0.1  # standard deviation of the first estimate of the restitution


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


def _at(tree: PyTree, index: Array | int) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[index], tree)


def _own_hits(trial: Trial, robots: Array) -> Array:
    """Return how many hits each robot (N,) has had; the robots hit in turn, robot 0 first."""
    return (trial.hits - robots + robots.size - 1) // robots.size


def _sides(num: int, dtype: DTypeLike) -> Array:
    """Return factors (N, 3) that convert the first robot's positions to those of each robot."""
    return jnp.ones((num, 3), dtype).at[1:, 0].set(-1.0)


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
            bounce=pick(hit, feel, trial.bounce),
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
    return observe(trial, loop, sight.observe(look_key, shown[:1], loop.sensing)[0])


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
        last=pick(counts, last, trial.last),
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
    balls: PyTree = (predict(trial, loop, loop.period), jnp.zeros_like(now))
    balls = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), balls)
    if num > 1:
        index = jnp.clip(own[turn] - trial.planned[turn], 0, ahead - 1)
        stroke = _at(_at(trial.plan.strokes, turn), index)
        struck = BallState(stroke.ball_pos, stroke.ball_vel_after)
        returned = struck, trial.began[turn] + stroke.time - now
        balls = pick(robots == turn, balls, jax.tree.map(lambda leaf: leaf[None], returned))
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
        plan, began, planned = pick(good, (plan, began, planned), old)
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
    balls = jax.jit(jax.vmap(lambda trial: predict(trial, loop, 0.0)))(trials)
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

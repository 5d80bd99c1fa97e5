"""The closed loop of rallies: a robot hits one ball again and again, without an end.

As in `sims.loop`, the robot is controlled in every physics step, the ball is observed at a lower
rate, and the next hits are planned anew at a still lower rate. In addition the racket reflects the
ball in the physics. The robot feels the impact at once, but sees the ball's new flight one latency
later. The estimate of the ball therefore crosses an impact by the library's impact map. After every
impact the robot estimates the coefficient of restitution from the ball's velocities before and
after the impact. During every flight the robot estimates the drag.

The state of a trial has a fixed size, so that the number of hits does not change the memory.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax
from jaxtyping import PyTree

from planner_jax.ball.estimation import EkfState, congruence
from planner_jax.ball.flight import BallState, fly
from planner_jax.core.compiled import QUICK_OPTIONS
from planner_jax.planning.replan import Replanning
from planner_jax.sims import sensing as sight
from planner_jax.sims.launch import watch_ball
from planner_jax.sims.loop import track
from planner_jax.sims.loop_state import Loop
from planner_jax.sims.model import at_rest, ball_states, place_balls
from planner_jax.sims.robot import Physics
from planner_jax.sims.scoring import Contact, moment, passage, racket_impact
from planner_jax.sims.sensing import Estimate, RlsState, rls_update
from planner_jax.task.rally.case import RallyCase
from planner_jax.task.rally.plan import RallyPlan
from planner_jax.task.rally.replan import ReplanRally, count_done

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
    """The variables of one trial: physics, estimates, plan and scores."""

    physics: Physics
    shown: Array  # (L, 3) [m], true positions of the ball that are still to be observed
    estimate: Estimate  # of the ball, one latency ago
    bounce: Bounce
    restitution: RlsState  # estimate of 1 + (coefficient of restitution)
    plan: RallyPlan
    began: Array  # () [s], start time of the plan
    planned: Array  # () int32, number of hits before the plan's start
    hits: Array  # () int32, number of hits so far
    lost: Array  # () bool, whether the ball fell below `LOWEST`
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

    qpos: Array  # (P, B, O, R + 3), joint positions of robot and ball
    wanted: Array  # (P, B, O, 3) [m], planned position of the robot


@dataclasses.dataclass(frozen=True)
class RallyPilot:
    """The part of the loop that plans the next hits in every planning period."""

    planner: ReplanRally = ReplanRally()
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
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


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


def _fly_to_observation(loop: Loop, trial: Trial, case: RallyCase) -> Trial:
    world, robot, dtype = loop.world, loop.world.robot, trial.time.dtype
    key, noise_key, look_key = jax.random.split(trial.key, 3)
    noise = jax.random.normal(noise_key, robot.noise_shape, dtype)
    times = trial.time + world.timestep * jnp.arange(loop.steps_per_observation, dtype=dtype)
    references = robot.references(trial.plan, times - trial.began, world)
    drag = case.drag[None]
    stands = trial.began + trial.plan.strokes.time

    def advance(carry: tuple, now: tuple) -> tuple[tuple, None]:
        trial, before = carry
        reference, time = now
        state, physics = track(loop, trial.physics, reference, noise, drag)
        after = moment(world, physics)
        due = stands[jnp.argmin(jnp.abs(stands - time))]
        passes, contact = passage(world, before, after, time, due[None], reference.pos)
        contact = jax.tree.map(lambda leaf: leaf[0], contact)
        trial = _score(trial, case, passes[0], contact)
        hit = passes[0] & contact.met
        vel = racket_impact(contact.ball_vel, contact.tool_vel, contact.normal, case.restitution)
        left = time + world.timestep - contact.time
        ball = BallState((contact.ball_pos + left * vel)[None], vel[None])
        physics = place_balls(world, physics, ball, drag, hit[None])
        felt = world.carrier.tool_motion(state)
        feel = Bounce(
            time=time + world.timestep,
            tool_vel=felt[1] + jnp.cross(felt[2], world.carrier.tool.height * felt[3]),
            normal=felt[3],
            ball_vel=trial.bounce.ball_vel,
            is_due=jnp.ones((), bool),
            is_learned=jnp.zeros((), bool),
        )
        squared = jnp.sum((before.robot_pos - reference.pos) ** 2)
        lasts = jnp.where(trial.lost, 0.0, world.timestep)
        away = jnp.where(trial.lost, 0.0, jnp.sqrt(squared))
        trial = dataclasses.replace(
            trial,
            physics=physics,
            bounce=_pick(hit, feel, trial.bounce),
            worst_tracking=jnp.maximum(trial.worst_tracking, away),
            squared_tracking=trial.squared_tracking + lasts * squared,
            tracked=trial.tracked + lasts,
        )
        return (trial, moment(world, physics)), None

    plan = trial.plan
    start = dataclasses.replace(trial, plan=None)
    (trial, _), _ = lax.scan(advance, (start, moment(world, trial.physics)), (references, times))
    at = ball_states(world, trial.physics)[0][0]
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


def _score(trial: Trial, case: RallyCase, passes: Array, contact: Contact) -> Trial:
    """Return a trial after a step, in which the ball may pass the racket's plane."""
    counts = passes & ~trial.lost
    hit = counts & contact.met
    last = Passage(
        offset=contact.offset,
        tracking=contact.tracking,
        late=contact.time - contact.planned_time,
        violation=trial.last.violation,
        restitution=trial.restitution.estimate - 1.0 - case.restitution,
        drag=trial.estimate.drag / case.drag - 1.0,
    )
    offset = jnp.where(hit, contact.offset, 0.0)
    return dataclasses.replace(
        trial,
        hits=trial.hits + hit,
        last=_pick(counts, last, trial.last),
        worst_offset=jnp.maximum(trial.worst_offset, offset),
        sum_offset=trial.sum_offset + offset,
    )


def _plan(
    loop: Loop, pilot: RallyPilot, trial: Trial, case: RallyCase
) -> tuple[RallyPlan, Array, Array]:
    """Return a plan that may start at the period's end, whether it does, and its number of hits."""
    elapsed = trial.time + loop.period - trial.began
    done = count_done(trial.plan, elapsed)
    planned = trial.planned + done
    case = dataclasses.replace(
        case,
        ball=_predict(trial, loop, loop.period),
        drag=trial.estimate.drag,
        restitution=trial.restitution.estimate - 1.0,
        head_state=loop.world.carrier.head_state(trial.plan, elapsed),
    )
    task = Replanning(case=case, previous=trial.plan, elapsed=elapsed)
    plan = pilot.planner.solve(task, pilot.planner.rounds[0])
    ahead = trial.plan.strokes.time - elapsed
    is_free = ~jnp.any((ahead > -pilot.settled) & (ahead < pilot.shortest))
    is_free &= (trial.hits == planned) & (plan.strokes.time[0] >= pilot.shortest)
    # A plan that misses the ball is worse than one that exceeds a limit for a while.
    next_hit = jnp.minimum(done, case.places.shape[0] - 1)
    aside = jnp.sum((plan.strokes.ball_pos[0] - trial.plan.strokes.ball_pos[next_hit]) ** 2)
    is_astray = (aside > pilot.astray**2) | (done == case.places.shape[0])
    most = jnp.where(is_astray, pilot.desperate, pilot.excess)
    good = plan.violation <= jnp.maximum(most, trial.plan.violation)
    return plan, is_free & good, planned


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
        trial = _fly_to_observation(loop, trial, case)
        wanted = loop.world.carrier.head_state(trial.plan, trial.time - trial.began)[0]
        return trial, Frames(trial.physics.qpos, wanted)

    def one_period(trial: Trial, case: RallyCase) -> tuple[Trial, Frames]:
        plan, good, planned = _plan(loop, pilot, trial, case)
        body = lambda trial, _: observe_once(trial, case)  # noqa: E731
        trial, frames = lax.scan(body, trial, None, length=loop.observations_per_plan)
        last = dataclasses.replace(trial.last, violation=plan.violation)
        taken = dataclasses.replace(trial, plan=plan, began=trial.time, planned=planned, last=last)
        return _pick(good, taken, trial), frames

    every = jax.vmap(one_period)
    body = lambda now, _: every(now, cases)  # noqa: E731
    trials, frames = lax.scan(body, trials, None, length=num_periods)
    trials = dataclasses.replace(
        trials,
        time=jnp.zeros_like(trials.time),
        began=trials.began - trials.time,
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

    def one(case: RallyCase, drag: Array, restitution: Array, key: Array) -> Trial:
        key, look_key = jax.random.split(key)
        zero, none = jnp.zeros(()), jnp.zeros((), jnp.int32)
        shown, _, estimate = watch_ball(loop, case.ball, case.drag, drag, look_key, seen)
        robot = at_rest(loop.world, case.head_state[0])
        ball = jax.tree.map(lambda leaf: leaf[None], case.ball)
        vector = jnp.zeros(3)
        return Trial(
            physics=place_balls(loop.world, robot, ball, case.drag[None], jnp.ones(1, bool)),
            shown=shown,
            estimate=estimate,
            bounce=Bounce(
                -jnp.inf + zero, vector, vector, vector, ~jnp.ones((), bool), jnp.ones((), bool)
            ),
            restitution=RlsState(1.0 + restitution, _RESTITUTION_SPREAD**2 + zero),
            plan=None,  # type: ignore[arg-type]
            began=zero,
            planned=none,
            hits=none,
            lost=jnp.zeros((), bool),
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


def believed_cases(loop: Loop, trials: Trial, cases: RallyCase) -> RallyCase:
    """Return the first planning problems of B trials, as the robots know ball and racket."""
    balls = jax.jit(jax.vmap(lambda trial: _predict(trial, loop, 0.0)))(trials)
    return dataclasses.replace(
        cases,
        ball=balls,
        drag=trials.estimate.drag,
        restitution=trials.restitution.estimate - 1.0,
    )

"""Float64 NumPy referee of hit plans: the physics alone decides whether a plan succeeds.

It shares no code with the planner: it samples the returned polynomial, recomputes attitude
and body rate from flatness, integrates the ball, applies the impact and follows the ball to
the ground. A plan's own claims (status, cost, stroke) are not trusted; only the impact time
that it claims is compared. World frame, z up, ground at z = 0, SI units.

Paper 002 is "Bat Planner": eq. 2 drag, eq. 3 impact (with 1 + beta), eq. 18 limits. Body
rates are those of the Hopf fibration at zero heading (Watterson and Kumar).
"""

import dataclasses
import math

import numpy as np

# Limit -> what is said when it fails. In the order in which they are tested: a failed plan is
# named after its first failure.
_SENTENCES = {
    "not finite": "the plan or its scenario is not finite",
    "contact time": "off by {excess:.3g} s; it must be positive, the end of the trajectory "
    "({time:.3f} s), and before the ball lands",
    "head state": "the trajectory starts {excess:.3g} m off the head state",
    "continuity": "the trajectory jumps by {excess:.3g} m at {time:.3f} s",
    "speed": "{excess:.2%} above its limit at {time:.3f} s",
    "acceleration": "{excess:.2%} above its limit at {time:.3f} s",
    "body rate": "{excess:.2%} above its limit at {time:.3f} s",
    "ground": "{excess:.2%} below the least height at {time:.3f} s",
    "hitting speed x": "{excess:.2%} above its limit at {time:.3f} s",
    "hitting speed y": "{excess:.2%} above its limit at {time:.3f} s",
    "hitting speed z": "{excess:.2%} above its limit at {time:.3f} s",
    "contact": "the racket centre is {excess:.3g} m from the ball at {time:.3f} s",
    "wrong face": "the ball leaves the racket's face at {excess:.3g} m/s at {time:.3f} s",
    "apex low": "{excess:.2%} below the least apex at {time:.3f} s",
    "apex high": "{excess:.2%} above the greatest apex at {time:.3f} s",
    "landing": "the ball lands {excess:.3g} m from the target at {time:.3f} s",
}
_UNBOUNDED = {
    "body rate": "no thrust or upside down, so without attitude, at {time:.3f} s",
    "landing": "the ball never comes down to the target's height; its apex is at {time:.3f} s",
}
LIMITS = tuple(_SENTENCES)

# Largest difference [s] between the claimed impact time and the end of the trajectory.
CONTACT_TIME_TOLERANCE = 1e-4
# Limits smaller than this (in their own unit) are compared as if relative to it.
SMALLEST_LIMIT = 1e-3
# Jumps of derivatives count as displacement over one piece, or over this time [s] if longer.
SHORTEST_PIECE = 0.1
# Runge-Kutta: steps up to the impact; step and longest flight [s] after it.
_INCOMING_STEPS = 60
_OUTGOING_STEP = 0.01
_LONGEST_FLIGHT = 20.0
# Fewest intervals between the samples of one piece.
_FEWEST_INTERVALS = 16


@dataclasses.dataclass(frozen=True)
class HitVerdict:
    """What the referee found, one entry a lane. What is measured may be NaN if inputs are."""

    success: np.ndarray  # (B,) bool
    failed_limit: np.ndarray  # (B,) str, the first of `LIMITS` that fails; "" for a success
    failed_time: np.ndarray  # (B,) [s], where that limit is worst; NaN for a success
    # (B,) relative to the limit for speed, acceleration, body rate, ground, hitting speed and
    # apex; [m] for head state, continuity, contact, landing; [m/s] for wrong face; [s] for
    # contact time; NaN for a success. It is the whole error, the tolerance not taken off.
    failed_excess: np.ndarray
    max_speed: np.ndarray  # (B,) [m/s]
    max_acceleration: np.ndarray  # (B,) [m/s^2]
    max_body_rate: np.ndarray  # (B,) [rad/s], infinite where the attitude is not defined
    min_height: np.ndarray  # (B,) [m]
    min_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    max_thrust: np.ndarray  # (B,) [m/s^2], per unit mass
    hitting_velocity: np.ndarray  # (B, 3) [m/s], of the quadrotor at the impact
    apex: np.ndarray  # (B,) [m], of the ball after the impact
    landing_point: np.ndarray  # (B, 3) [m], NaN where the ball does not come down to the target
    landing_error: np.ndarray  # (B,) [m], horizontal; infinite where it does not come down
    contact_error: np.ndarray  # (B,) [m], racket centre to ball at the impact
    continuity_error: np.ndarray  # (B,) [m], worst jump between pieces, as displacement
    head_error: np.ndarray  # (B,) [m], error at time 0, likewise

    def sentence(self, lane: int) -> str:
        """One line for a human: which limit failed, when, and by how much."""
        name = str(self.failed_limit[lane])
        if not name:
            return f"success: the ball lands {self.landing_error[lane]:.2g} m from the target"
        time, excess = self.failed_time[lane], self.failed_excess[lane]
        text = _UNBOUNDED.get(name) if np.isinf(excess) else None
        return f"{name}: " + (text or _SENTENCES[name]).format(time=time, excess=excess)


def referee_hits(
    scenarios,
    plans,
    *,
    drag_after_impact: bool = False,
    tolerance: float = 1e-3,
    landing_tolerance: float = 0.01,
    contact_tolerance: float = 5e-3,
    continuity_tolerance: float = 1e-4,
    samples: int = 400,
    chunk: int = 512,
) -> HitVerdict:
    """The verdict on every plan of a batch.

    Speed, acceleration, body rate and height are sampled at both ends and inside of every
    piece; the likeliest peak by parabolas through three samples is then searched on the
    polynomial itself, so that what is reported is reached. The impact is the end of the
    trajectory. Errors e_n of the n-th derivative (n = 0..3) at time 0 and between pieces
    count as the displacement |e_n| h^n / n! that they make over one mean piece h (at least
    `SHORTEST_PIECE`). Eight minimum-snap pieces computed in float32 with coordinates up to
    4.5 m have at most 1.3e-4 m of it, under a third of the default tolerance.

    Args:
        scenarios: object with the fields of `HitScenario`, leaves with leading axis B.
        plans: object with the fields of `HitPlan`, leaves with leading axis B; coefficients
            (B, M, D + 1, 3), durations (B, M).
        drag_after_impact: let the drag act on the returned ball too.
        tolerance: relative, of every limit of the scenario.
        landing_tolerance: [m], horizontal distance of the landing from the target.
        contact_tolerance: [m], distance of the racket centre from the ball at the impact.
        continuity_tolerance: times the largest coordinate [m] at the piece ends (at least
            1 m), allowed displacement of head state and joints.
        samples: fewest samples of a trajectory, >= 200.
        chunk: lanes judged at once; it bounds the memory.

    Returns:
        A `HitVerdict` of float64 arrays. A lane that is not finite fails as "not finite"
        and leaves the others alone. A limit may be infinite.

    Raises:
        ValueError: a leaf has the wrong shape, `samples` < 200 or `chunk` < 1.
    """
    if samples < 200:
        raise ValueError(f"samples must be >= 200, got {samples}")
    if chunk < 1:
        raise ValueError(f"chunk must be >= 1, got {chunk}")
    leaves = _leaves(scenarios, plans)
    num_lanes, num_pieces = leaves["durations"].shape
    intervals = max(math.ceil(samples / num_pieces), _FEWEST_INTERVALS)
    tolerances = {
        "relative": tolerance,
        "landing": landing_tolerance,
        "contact": contact_tolerance,
        "continuity": continuity_tolerance,
    }
    parts = []
    # A broken or absurd lane may overflow; its verdict says so, not a warning.
    with np.errstate(all="ignore"):
        for start in range(0, max(num_lanes, 1), chunk):
            case = {
                name: leaf[start : start + chunk].astype(np.float64)
                for name, leaf in leaves.items()
            }
            parts.append(_judge(case, intervals, drag_after_impact, tolerances))
    return HitVerdict(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def _leaves(scenarios, plans) -> dict[str, np.ndarray]:
    """Every array that the referee reads, by name, its shape checked."""
    limits, stroke_limits = scenarios.limits, scenarios.hit_limits
    path = plans.trajectory
    coeffs, durations = np.asarray(path.coeffs), np.asarray(path.durations)
    if coeffs.ndim != 4 or coeffs.shape[-1] != 3 or 0 in coeffs.shape[1:]:
        raise ValueError(f"coeffs must be (B, M, D + 1, 3), got {coeffs.shape}")
    trailing = {
        "durations": (durations, coeffs.shape[1:2]),
        "stroke.time": (plans.stroke.time, ()),
        "ball.pos": (scenarios.ball.pos, (3,)),
        "ball.vel": (scenarios.ball.vel, (3,)),
        "head_state": (scenarios.head_state, (4, 3)),
        "target": (scenarios.target, (3,)),
        "drag": (scenarios.drag, ()),
        "gravity": (scenarios.gravity, ()),
        "restitution": (scenarios.restitution, ()),
        "racket_height": (scenarios.racket_height, ()),
        "limits.speed": (limits.speed, ()),
        "limits.acceleration": (limits.acceleration, ()),
        "limits.body_rate": (limits.body_rate, ()),
        "limits.min_height": (limits.min_height, ()),
        "hit_limits.hitting_speed": (stroke_limits.hitting_speed, (3,)),
        "hit_limits.min_apex": (stroke_limits.min_apex, ()),
        "hit_limits.max_apex": (stroke_limits.max_apex, ()),
    }
    leaves = {"coeffs": coeffs}
    for name, (value, shape) in trailing.items():
        leaf = np.asarray(value)
        if leaf.shape != coeffs.shape[:1] + shape:
            raise ValueError(f"{name} must be {coeffs.shape[:1] + shape}, got {leaf.shape}")
        leaves[name] = leaf
    return leaves


def _finite(case: dict) -> np.ndarray:
    """Lanes (B,) whose inputs are finite; limits may be infinite, but not NaN."""
    finite = np.ones(len(case["coeffs"]), bool)
    for name, leaf in case.items():
        good = ~np.isnan(leaf) if "limits." in name else np.isfinite(leaf)
        finite &= _flat(good).all(axis=1)
    return finite


def _judge(case: dict, intervals: int, drag_after_impact: bool, tolerances: dict) -> dict:
    """The fields of `HitVerdict` for one chunk of lanes."""
    measured, tests = _judge_motion(case, intervals, tolerances)
    at_impact, impact_tests = _judge_impact(case, drag_after_impact, tolerances)
    measured.update(at_impact)
    tests.update(impact_tests)
    failed = np.stack([tests[name][0] for name in LIMITS[1:]], axis=1)
    excess = np.stack([tests[name][1] for name in LIMITS[1:]], axis=1)
    time = np.stack([tests[name][2] for name in LIMITS[1:]], axis=1)
    finite = _finite(case) & ~np.isnan(excess).any(axis=1)
    success = finite & ~failed.any(axis=1)
    first = failed.argmax(axis=1)
    lanes = np.arange(len(first))
    names = np.where(success, "", np.where(finite, np.array(LIMITS)[1 + first], LIMITS[0]))
    broken = finite & ~success
    return {
        "success": success,
        "failed_limit": names,
        "failed_time": np.where(broken, time[lanes, first], np.nan),
        "failed_excess": np.where(broken, excess[lanes, first], np.nan),
    } | measured


def _above(value, limit, tolerance: float, time) -> tuple:
    """Test of value <= limit: failed, relative excess, time."""
    scale = np.where(np.isinf(limit), 1.0, np.maximum(np.abs(limit), SMALLEST_LIMIT))
    excess = (value - limit) / scale
    return excess > tolerance, excess, time


def _motion(coeffs: np.ndarray, durations: np.ndarray, u: np.ndarray, orders) -> list:
    """Derivatives of polynomial pieces at the fractions u of their durations.

    coeffs (3, ..., D + 1), durations (...), u (S,) or (..., S): one (3, ..., S) an order.
    """
    out = []
    for order in orders:
        powers = np.arange(coeffs.shape[-1] - order)
        factors = np.array([math.perm(int(k) + order, order) for k in powers], float)
        scaled = coeffs[..., order:] * factors * durations[..., None] ** powers
        # Not a matrix product: threads of a BLAS on a busy machine cost more than they save.
        out.append(np.einsum("...k,...ks->...s", scaled, u[..., None, :] ** powers[:, None]))
    return out


def _squared(vector: np.ndarray) -> np.ndarray:
    """Squared length of vectors (3, ...)."""
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2


def _thrust_squared(gravity, acc: np.ndarray) -> np.ndarray:
    """|a + g e_3|^2 of accelerations (3, ...)."""
    return acc[0] ** 2 + acc[1] ** 2 + (acc[2] + gravity) ** 2


def _body_rate_squared(gravity, acc: np.ndarray, jerk: np.ndarray) -> np.ndarray:
    """|omega|^2 of the Hopf fibration at zero heading, from c = tau x jerk.

    z' = (c / |tau|^2) x z, so |z'| = |c| / |tau|^2, and the yaw rate
    (z_y z_x' - z_x z_y') / (1 + z_z) is -c_z / (|tau| (|tau| + tau_z)).
    Infinite without thrust and upside down, where there is no attitude.
    """
    tau_x, tau_y, tau_z = acc[0], acc[1], acc[2] + gravity
    c_x = tau_y * jerk[2] - tau_z * jerk[1]
    c_y = tau_z * jerk[0] - tau_x * jerk[2]
    c_z = tau_x * jerk[1] - tau_y * jerk[0]
    size_squared = tau_x**2 + tau_y**2 + tau_z**2
    upright = np.sqrt(size_squared) + tau_z
    rate = ((c_x**2 + c_y**2 + c_z**2) / size_squared + (c_z / upright) ** 2) / size_squared
    return np.where(upright > 0.0, rate, np.inf)


# Name -> orders of the derivatives it needs, and the measure whose maximum is sought.
_MEASURES = {
    "speed": ((1,), lambda gravity, vel: _squared(vel)),
    "acceleration": ((2,), lambda gravity, acc: _squared(acc)),
    "body rate": ((2, 3), _body_rate_squared),
    "depth": ((0,), lambda gravity, pos: -pos[2]),
    "thrust": ((2,), _thrust_squared),
    "weakness": ((2,), lambda gravity, acc: -_thrust_squared(gravity, acc)),
}


def _likeliest_peak(values: np.ndarray) -> np.ndarray:
    """Index (B,) next to the greatest parabola through three samples (B, M, S) of a piece."""
    left, middle, right = values[..., :-2], values[..., 1:-1], values[..., 2:]
    crest = (middle >= left) & (middle > right)
    gain = (right - left) ** 2 / (8.0 * (2.0 * middle - left - right))
    vertex = values.copy()
    vertex[..., 1:-1] += np.where(crest, gain, 0.0)
    return _flat(vertex).argmax(axis=1)


def _flat(values: np.ndarray) -> np.ndarray:
    """(B, ...) as (B, N); the empty batch too."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _peaks(case: dict, intervals: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Greatest value (B,) of every measure along the trajectory, and its time (B,) [s]."""
    durations, gravity = case["durations"], case["gravity"]
    coeffs = np.ascontiguousarray(np.moveaxis(case["coeffs"], -1, 0))
    u = np.linspace(0.0, 1.0, intervals + 1)
    motion = _motion(coeffs, durations, u, range(4))
    starts, lanes = np.cumsum(durations, axis=1) - durations, np.arange(len(durations))
    times = starts[:, :, None] + durations[:, :, None] * u
    peaks = {}
    for name, (orders, measure) in _MEASURES.items():
        values = measure(gravity[:, None, None], *[motion[order] for order in orders])
        piece, sample = np.divmod(_likeliest_peak(values), intervals + 1)
        around, span = coeffs[:, lanes, piece], durations[lanes, piece]
        centre, half = u[sample], 1.0 / intervals
        for _ in range(3):
            near = np.clip(centre[:, None] + half * np.linspace(-1.0, 1.0, 9), 0.0, 1.0)
            found = measure(gravity[:, None], *_motion(around, span, near, orders))
            best = found.argmax(axis=1)
            centre, half = near[lanes, best], half / 4.0
        top = _flat(values).argmax(axis=1)
        peaks[name] = _greater(
            (found[lanes, best], starts[lanes, piece] + centre * span),
            (_flat(values)[lanes, top], _flat(times)[lanes, top]),
        )
    turn = _fastest_turn(motion[2], gravity, times)
    peaks["body rate"] = _greater(peaks["body rate"], turn)
    return peaks


def _greater(first: tuple, second: tuple) -> tuple[np.ndarray, np.ndarray]:
    """The greater of two values, lane by lane, with its time."""
    better = second[0] > first[0]
    return np.where(better, second[0], first[0]), np.where(better, second[1], first[1])


def _fastest_turn(acc, gravity, times) -> tuple[np.ndarray, np.ndarray]:
    """Squared body rate (B,) that turns the thrust from one sample to the next; its time.

    The mean over a step, so never above the true maximum. It is what betrays a thrust that
    passes through zero between two samples and turns the quadrotor over at once.
    """
    tau_x, tau_y, tau_z = acc[0], acc[1], acc[2] + gravity[:, None, None]
    size = np.sqrt(tau_x**2 + tau_y**2 + tau_z**2)
    along = tau_x[..., 1:] * tau_x[..., :-1] + tau_y[..., 1:] * tau_y[..., :-1]
    cosine = (along + tau_z[..., 1:] * tau_z[..., :-1]) / (size[..., 1:] * size[..., :-1])
    sharpest = np.where(np.isnan(cosine), 1.0, cosine).min(axis=2)
    step = np.maximum(times[..., 1] - times[..., 0], np.finfo(float).tiny)
    rate = np.arccos(np.clip(sharpest, -1.0, 1.0)) / step
    piece, lanes = rate.argmax(axis=1), np.arange(len(rate))
    sample = cosine[lanes, piece].argmin(axis=1)
    return rate[lanes, piece] ** 2, times[lanes, piece, sample]


def _joint_errors(case: dict) -> tuple:
    """Errors of head state and joints as displacement [m], time of the worst joint, scale [m]."""
    coeffs, durations = np.moveaxis(case["coeffs"], -1, 0), case["durations"]
    ends = np.stack(_motion(coeffs, durations, np.array([0.0, 1.0]), range(4)))
    period = np.maximum(durations.mean(axis=1), SHORTEST_PIECE)
    weights = np.stack([period**n / math.factorial(n) for n in range(4)])
    head = np.moveaxis(case["head_state"], 0, -1)
    head_error = np.linalg.norm(ends[..., 0, 0] - head, axis=1) * weights
    jumps = np.linalg.norm(ends[..., 1:, 0] - ends[..., :-1, 1], axis=1)
    jump = np.zeros_like(durations)
    jump[:, 1:] = (jumps * weights[:, :, None]).max(axis=0)
    worst = jump.argmax(axis=1)
    starts = np.cumsum(durations, axis=1) - durations
    scale = np.maximum(np.abs(ends[0]).max(axis=(0, 2, 3)), 1.0)
    return head_error.max(axis=0), jump.max(axis=1), starts[np.arange(len(worst)), worst], scale


def _judge_motion(case: dict, intervals: int, tolerances: dict) -> tuple[dict, dict]:
    """What the trajectory does, and the tests of it: name -> failed, excess, time."""
    peaks = _peaks(case, intervals)
    head, jump, jump_time, scale = _joint_errors(case)
    measured = {
        "max_speed": np.sqrt(peaks["speed"][0]),
        "max_acceleration": np.sqrt(peaks["acceleration"][0]),
        "max_body_rate": np.sqrt(peaks["body rate"][0]),
        "min_height": -peaks["depth"][0],
        "min_thrust": np.sqrt(-peaks["weakness"][0]),
        "max_thrust": np.sqrt(peaks["thrust"][0]),
        "continuity_error": jump,
        "head_error": head,
    }
    relative, allowed = tolerances["relative"], tolerances["continuity"] * scale
    tests = {
        "head state": (head > allowed, head, np.zeros_like(head)),
        "continuity": (jump > allowed, jump, jump_time),
        "ground": _above(
            -measured["min_height"], -case["limits.min_height"], relative, peaks["depth"][1]
        ),
    }
    for name in ("speed", "acceleration", "body rate"):
        field = name.replace(" ", "_")
        value, limit = measured[f"max_{field}"], case[f"limits.{field}"]
        tests[name] = _above(value, limit, relative, peaks[name][1])
    return measured, tests


def _ball_rate(state: np.ndarray, drag: np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """d/dt of position and velocity (B, 6):  v' = g - K_D |v| v."""
    vel = state[:, 3:]
    speed = np.sqrt((vel**2).sum(axis=1))
    rate = np.concatenate([vel, -(drag * speed)[:, None] * vel], axis=1)
    rate[:, 5] -= gravity
    return rate


def _ball_step(state, step: np.ndarray, drag, gravity) -> np.ndarray:
    """One Runge-Kutta step of order 4, its length (B,) [s]."""
    step = step[:, None]
    k1 = _ball_rate(state, drag, gravity)
    k2 = _ball_rate(state + 0.5 * step * k1, drag, gravity)
    k3 = _ball_rate(state + 0.5 * step * k2, drag, gravity)
    k4 = _ball_rate(state + step * k3, drag, gravity)
    return state + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


def _step_down_to(state, entry: int, level, drag, gravity) -> tuple[np.ndarray, np.ndarray]:
    """Time (B,) within one outgoing step at which an entry has fallen to a level; the ball then.

    Newton from the far end of the step: height and vertical speed are concave or falling
    there, so that it comes to the later crossing.
    """
    step = np.full(len(state), _OUTGOING_STEP)
    for _ in range(6):
        ahead = _ball_step(state, step, drag, gravity)
        slope = _ball_rate(ahead, drag, gravity)[:, entry]
        step = np.clip(step - (ahead[:, entry] - level) / slope, 0.0, _OUTGOING_STEP)
    return step, _ball_step(state, step, drag, gravity)


def _return_in_air(state, height, drag, gravity) -> tuple:
    """Apex, its time, landing point and flight time of the ball with quadratic drag."""
    before_top, before_end, state = state.copy(), state.copy(), state.copy()
    top_time, end_time = np.zeros(len(state)), np.zeros(len(state))
    flying = np.arange(len(state))
    for i in range(round(_LONGEST_FLIGHT / _OUTGOING_STEP)):
        now = state[flying]
        step = np.full(len(flying), _OUTGOING_STEP)
        ahead = _ball_step(now, step, drag[flying], gravity[flying])
        rising = now[:, 5] > 0.0
        before_top[flying[rising]], top_time[flying[rising]] = now[rising], i * _OUTGOING_STEP
        before_end[flying], end_time[flying] = now, i * _OUTGOING_STEP
        state[flying] = ahead
        aloft = (ahead[:, 5] >= 0.0) | (ahead[:, 2] >= height[flying])
        flying = flying[aloft & np.isfinite(ahead[:, 2])]
        if not flying.size:
            break
    step, top = _step_down_to(before_top, 5, 0.0, drag, gravity)
    rises = before_top[:, 5] > 0.0
    apex = np.where(rises, top[:, 2], before_top[:, 2])
    apex_time = np.where(rises, top_time + step, 0.0)
    step, end = _step_down_to(before_end, 2, height, drag, gravity)
    down = apex >= height
    down[flying] = False
    landing = np.where(down[:, None], end[:, :3], np.nan)
    return apex, apex_time, landing, np.where(down, end_time + step, np.nan)


def _return_in_vacuum(state, height, gravity) -> tuple:
    """Apex, its time, landing point and flight time of the ball under gravity alone."""
    pos, vel = state[:, :3], state[:, 3:]
    apex_time = np.maximum(vel[:, 2], 0.0) / gravity
    apex = pos[:, 2] + 0.5 * gravity * apex_time**2
    time = (vel[:, 2] + np.sqrt(vel[:, 2] ** 2 + 2.0 * gravity * (pos[:, 2] - height))) / gravity
    time = np.where(apex >= height, time, np.nan)
    landing = pos + vel * time[:, None]
    landing[:, 2] -= 0.5 * gravity * time**2
    return apex, apex_time, landing, time


def _judge_impact(case: dict, drag_after_impact: bool, tolerances: dict) -> tuple[dict, dict]:
    """The ball up to the landing, and the tests of it: name -> failed, excess, time."""
    durations, drag, gravity = case["durations"], case["drag"], case["gravity"]
    end = durations.sum(axis=1)
    state = np.concatenate([case["ball.pos"], case["ball.vel"]], axis=1)
    for _ in range(_INCOMING_STEPS):
        state = _ball_step(state, end / _INCOMING_STEPS, drag, gravity)
    tail = np.moveaxis(case["coeffs"][:, -1:], -1, 0)
    pos, vel, acc = (
        derivative[:, :, 0, 0].T
        for derivative in _motion(tail, durations[:, -1:], np.ones(1), range(3))
    )
    normal = acc.copy()
    normal[:, 2] += gravity
    # Without thrust there is no face: the normal stays zero, and "wrong face" fails.
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    racket = pos + case["racket_height"][:, None] * normal
    approach = ((state[:, 3:] - vel) * normal).sum(axis=1)
    after = state.copy()
    after[:, 3:] -= ((1.0 + case["restitution"]) * approach)[:, None] * normal
    target = case["target"]
    if drag_after_impact:
        returned = _return_in_air(after, target[:, 2], drag, gravity)
    else:
        returned = _return_in_vacuum(after, target[:, 2], gravity)
    apex, apex_time, landing, flight_time = returned
    miss = np.linalg.norm(landing[:, :2] - target[:, :2], axis=1)
    measured = {
        "hitting_velocity": vel,
        "apex": apex,
        "landing_point": landing,
        "landing_error": np.where(np.isnan(miss), np.inf, miss),
        "contact_error": np.linalg.norm(racket - state[:, :3], axis=1),
    }
    apex_at = end + apex_time
    landing_at = np.where(np.isnan(flight_time), apex_at, end + flight_time)
    tests = _impact_tests(case, measured, tolerances, end, apex_at, landing_at)
    tests["wrong face"] = (approach >= 0.0, approach, end)
    tests["contact time"] = _contact_time(case, end, state)
    return measured, tests


def _impact_tests(case, measured, tolerances, end, apex_at, landing_at) -> dict:
    """Tests of contact, hitting speed, apex and landing: name -> failed, excess, time."""
    relative = tolerances["relative"]
    contact, landing = measured["contact_error"], measured["landing_error"]
    lowest, highest = case["hit_limits.min_apex"], case["hit_limits.max_apex"]
    tests = {
        "contact": (~(contact <= tolerances["contact"]), contact, end),
        "landing": (~(landing <= tolerances["landing"]), landing, landing_at),
        "apex low": _above(-measured["apex"], -lowest, relative, apex_at),
        "apex high": _above(measured["apex"], highest, relative, apex_at),
    }
    for axis, name in enumerate("xyz"):
        speed = np.abs(measured["hitting_velocity"][:, axis])
        limit = case["hit_limits.hitting_speed"][:, axis]
        tests[f"hitting speed {name}"] = _above(speed, limit, relative, end)
    return tests


def _contact_time(case: dict, end: np.ndarray, ball: np.ndarray) -> tuple:
    """Test of the impact time: positive, the trajectory's end, before the ball lands.

    The height of a ball in flight has no minimum inside, so that both ends are enough; a ball
    below the ground came there about its depth over its vertical speed ago.
    """
    shortest = case["durations"].min(axis=1)
    claim = np.abs(case["stroke.time"] - end)
    height = np.minimum(case["ball.pos"][:, 2], ball[:, 2])
    grounded = np.maximum(-height, 0.0) / np.maximum(np.abs(ball[:, 5]), 1e-3)
    excess = np.maximum(np.maximum(claim, -shortest), grounded)
    failed = (claim > CONTACT_TIME_TOLERANCE) | (shortest <= 0.0) | (height <= 0.0)
    return failed, excess, end

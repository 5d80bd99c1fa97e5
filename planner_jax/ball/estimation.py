"""What a ball does, from where it was seen: its state by a Kalman filter, its drag by two fits.

Paper 002, Section III (and paper 000, Section V-A, from which it comes): the extended Kalman
filter of eq. 5, the drag K_i of the linear model on each axis by nonlinear least squares, and
K_D of the quadratic model by the loss of energy, eqs 6 and 7. World frame, z up, SI units, one
ball; `jax.vmap` makes many. Something not seen is NaN here, and passes without a trace.
"""

import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array, lax

from planner_jax.ball.flight import BallState, linear_drag_flight

# (ball, duration, drag, gravity) -> ball: `linear_drag_flight` or `rk4_step`.
Flight = Callable[[BallState, Array, Array, Array], BallState]


@struct.dataclass
class EkfModel:
    """What the filter believes about the flight and about the sensor."""

    drag: Array  # (3,) K_i [1/s] for `linear_drag_flight`, () K_D [1/m] for `rk4_step`
    gravity: Array  # () [m/s^2], magnitude
    acceleration_density: Array  # () [m^2/s^3], of a white acceleration that the flight leaves out
    observation_std: Array  # () or (3,) [m], of an observed position


@struct.dataclass
class EkfState:
    """A Gaussian belief about position (first three) and velocity (last three) of the ball."""

    mean: Array  # (6,) [m, m/s]
    covariance: Array  # (6, 6)

    @property
    def ball(self) -> BallState:
        """The mean as a ball, leaves (..., 3)."""
        return BallState(pos=self.mean[..., :3], vel=self.mean[..., 3:])


@struct.dataclass
class Innovation:
    """An observation less its prediction; the residual is 0 where nothing was observed."""

    residual: Array  # (3,) [m]
    covariance: Array  # (3, 3) [m^2], that the filter expects of the residual
    observed: Array  # () bool


def _congruence(A: Array, P: Array) -> Array:
    """A P A'  at full precision on every device, symmetric to the last bit."""
    full = jnp.einsum("ij,jk,lk->il", A, P, A, precision=lax.Precision.HIGHEST)
    return 0.5 * (full + full.T)


def _solve_definite(A: Array, B: Array) -> tuple[Array, Array]:
    """The X (3, n) of  A X = B  and the pivots (3,), for a symmetric positive definite A (3, 3).

    Elimination without exchanges, written out: plain arithmetic on every device, at full
    precision, without a library call a lane.
    """
    U, X = list(A), list(B)
    for i in range(3):
        for j in range(i + 1, 3):
            factor = U[j][i] / U[i][i]
            U[j], X[j] = U[j] - factor * U[i], X[j] - factor * X[i]
    for i in (2, 1, 0):
        X[i] = (X[i] - sum(U[i][k] * X[k] for k in range(i + 1, 3))) / U[i][i]
    return jnp.stack(X), jnp.stack([U[i][i] for i in range(3)])


def ekf_init(pos: Array, vel: Array, *, pos_std: Array, vel_std: Array) -> EkfState:
    """The belief before the first observation.

    Args:
        pos: (3,) [m].
        vel: (3,) [m/s].
        pos_std: () or (3,) [m], standard deviation of each coordinate; it may be wide.
        vel_std: () or (3,) [m/s]. In float32 keep vel_std times the time between two
            observations below 1000 times their standard deviation: at 3000 the covariance
            after the second observation is lost in rounding.
    """
    chex.assert_shape([pos, vel], (3,))
    std = jnp.concatenate([jnp.ones_like(pos) * pos_std, jnp.ones_like(vel) * vel_std])
    return EkfState(mean=jnp.concatenate([pos, vel]), covariance=jnp.diag(std**2))


def ekf_predict(
    state: EkfState, duration: Array, model: EkfModel, *, flight: Flight = linear_drag_flight
) -> EkfState:
    """The belief after `duration` [s] >= 0 of flight with nothing observed.

    The mean flies, and the covariance becomes F P F' + Q, F the Jacobian of the flight. With
    `linear_drag_flight` this is paper 000, eq. 10, but exact in the duration (the print moves
    the position by v dt alone). With `rk4_step` the duration is one Runge-Kutta step. Q is the
    integral of a white acceleration over the duration.
    """

    def transition(mean: Array) -> Array:
        before = BallState(pos=mean[:3], vel=mean[3:])
        after = flight(before, duration, model.drag, model.gravity)
        return jnp.concatenate([after.pos, after.vel])

    F = jax.jacfwd(transition)(state.mean)
    t = jnp.asarray(duration, state.mean.dtype)
    per_axis = jnp.stack([jnp.stack([t**3 / 3.0, t**2 / 2.0]), jnp.stack([t**2 / 2.0, t])])
    Q = model.acceleration_density * jnp.kron(per_axis, jnp.eye(3, dtype=t.dtype))
    return EkfState(mean=transition(state.mean), covariance=_congruence(F, state.covariance) + Q)


def ekf_update(state: EkfState, observation: Array, model: EkfModel) -> tuple[EkfState, Innovation]:
    """The belief after one observed position, s + K_a (Z - H s)  (paper 002, eq. 5).

    H = [I 0]. The covariance takes Joseph's form, which stays positive definite in float32
    also when a wide prior meets a sharp observation.

    Args:
        state: the belief at the time of the observation.
        observation: (3,) Z [m]. Where any coordinate is not finite, the belief stays as it is.
        model: only the sensor is used.
    """
    chex.assert_shape(observation, (3,))
    observed = jnp.all(jnp.isfinite(observation))
    dtype = state.mean.dtype
    R = jnp.diag(jnp.ones(3, dtype) * model.observation_std**2)
    P = state.covariance
    residual = jnp.where(observed, observation, state.mean[:3]) - state.mean[:3]
    S = P[:3, :3] + R
    K = _solve_definite(S, P[:3])[0].T
    kept = jnp.eye(6, dtype=dtype) - jnp.pad(K, ((0, 0), (0, 3)))  # I - K H
    after = EkfState(
        mean=state.mean + jnp.matmul(K, residual, precision=lax.Precision.HIGHEST),
        covariance=jnp.where(observed, _congruence(kept, P) + _congruence(K, R), P),
    )
    return after, Innovation(residual=residual, covariance=S, observed=observed)


def filter_path(
    initial: EkfState,
    times: Array,
    observations: Array,
    model: EkfModel,
    *,
    flight: Flight = linear_drag_flight,
) -> tuple[EkfState, Innovation]:
    """The belief after each of a row of observations.

    Args:
        initial: the belief at `times[0]`, before the first observation is used.
        times: (N,) [s], not descending.
        observations: (N, 3) [m]; a row with a NaN is passed over.
        model: flight and sensor.
        flight: the process model that `model.drag` belongs to (static).

    Returns:
        The beliefs after each observation, and the innovations, leaves (N, ...).
    """
    chex.assert_shape(observations, (times.shape[0], 3))
    durations = jnp.diff(times, prepend=times[:1])

    def advance(state: EkfState, seen: tuple[Array, Array]):
        duration, observation = seen
        predicted = ekf_predict(state, duration, model, flight=flight)
        after, innovation = ekf_update(predicted, observation, model)
        return after, (after, innovation)

    return lax.scan(advance, initial, (durations, observations))[1]


@struct.dataclass
class LinearDragFit:
    """Linear-drag flight nearest to a row of positions; each axis is a fit of its own."""

    drag: Array  # (3,) K_i [1/s]; noise may make it negative
    ball: BallState  # at the first time
    residual: Array  # (3,) [m], root mean square
    drag_std: Array  # (3,) [1/s], large where the ball hardly moves; carries no gradient
    converged: Array  # (3,) bool: stationary, with three positions at least


# Parameters (3, axis), with rows position, velocity and drag, to residuals (N, axis).
Residuals = Callable[[Array], Array]


def _directions(dtype: jnp.dtype) -> Array:
    """One direction a parameter (3, 3, 3): it serves all axes, which share no parameter."""
    return jnp.eye(3, dtype=dtype)[:, :, None] * jnp.ones((1, 1, 3), dtype)


def _normal_equations(residuals: Residuals, params: Array) -> tuple[Array, Array, Array]:
    """J'J (3, 3, axis), J'r (3, axis) and r'r (axis,)."""
    error, push = jax.linearize(residuals, params)
    J = jax.vmap(push)(_directions(params.dtype))
    gram = jnp.einsum("pni,qni->pqi", J, J, precision=lax.Precision.HIGHEST)
    slope = jnp.einsum("pni,ni->pi", J, error, precision=lax.Precision.HIGHEST)
    return gram, slope, jnp.sum(error**2, axis=0)


@functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
def _damped_solve(A: Array, b: Array, damping: Array) -> tuple[Array, Array]:
    """The x of  (A + damping diag A) x = b  and the last diagonal element of A's inverse.

    A is scaled to a unit diagonal first, so that a damping above rounding keeps it positive
    definite, also where a parameter has no influence at all (zero row and column: x = 0).
    """
    diagonal = jnp.diagonal(A)
    active = diagonal > 0.0
    scale = jnp.where(active, 1.0 / jnp.sqrt(jnp.where(active, diagonal, 1.0)), 0.0)
    scaled = scale[:, None] * A * scale[None, :] + damping * jnp.eye(3, dtype=A.dtype)
    solution, pivots = _solve_definite(scaled, (scale * b)[:, None])
    return scale * solution[:, 0], jnp.where(active[2], scale[2] ** 2 / pivots[2], jnp.inf)


def _levenberg_marquardt(
    residuals: Residuals, params: Array, bound: Array, num_iterations: int
) -> Array:
    """The parameters after damped steps that each axis takes only downhill.

    Drag, in which alone the residuals are not linear, is held in a first extra step, and stays
    within +-bound, lest exp(-K t) overflow on the way.
    """
    floor = 100.0 * jnp.finfo(params.dtype).eps

    def iterate(carry: tuple[Array, Array], free: Array) -> tuple[tuple[Array, Array], None]:
        params, damping = carry
        gram, slope, cost = _normal_equations(residuals, params)
        gram = gram * (free[:, None] * free[None, :])[:, :, None]
        trial = params - _damped_solve(gram, slope * free[:, None], damping)[0]
        trial = trial.at[2].set(jnp.clip(trial[2], -bound, bound))
        # At the bottom steps still mend the parameters when the cost shows only rounding.
        better = jnp.sum(residuals(trial) ** 2, axis=0) <= (1.0 + 10.0 * floor) * cost
        damping = jnp.clip(damping * jnp.where(better, 0.1, 10.0), floor, 1e6)
        return (jnp.where(better[None, :], trial, params), damping), None

    start = params, jnp.full((3,), 1e-3, params.dtype)
    free = jnp.ones((1 + num_iterations, 3), params.dtype).at[0, 2].set(0.0)
    return lax.scan(iterate, start, free)[0][0]


def fit_linear_drag(
    times: Array, positions: Array, gravity: Array, *, num_iterations: int = 10
) -> LinearDragFit:
    """K_i, position and velocity that make a linear-drag flight fit the positions best.

    Minimises  sum_k |s(t_k) - s_k|^2  (paper 002, below eq. 5; paper 000, eq. 12) by
    Levenberg-Marquardt from the fit without drag, within |K_i| <= 10 / (t_N - t_1). Gradients
    are those of the optimum, by the implicit function theorem.

    Args:
        times: (N,) [s], ascending.
        positions: (N, 3) [m], filtered or observed; a row with a NaN is passed over.
        gravity: () [m/s^2], magnitude.
        num_iterations: how many damped steps (static).
    """
    chex.assert_shape(positions, (times.shape[0], 3))
    dtype = positions.dtype
    seen = jnp.all(jnp.isfinite(positions), axis=1)
    positions = jnp.where(seen[:, None], positions, 0.0)
    t = times - times[0]
    bound = 10.0 / jnp.where(t[-1] > 0.0, t[-1], 1.0)
    eps = jnp.finfo(dtype).eps
    damping = jnp.full((3,), 100.0 * eps, dtype)

    def residuals(params: Array) -> Array:
        ball = BallState(pos=params[0], vel=params[1])
        path = jax.vmap(lambda s: linear_drag_flight(ball, s, params[2], gravity).pos)(t)
        return jnp.where(seen[:, None], path - positions, 0.0)

    def tangent_solve(hessian: Callable[[Array], Array], change: Array) -> Array:
        return _damped_solve(jax.vmap(hessian)(_directions(dtype)), change, damping)[0]

    params = lax.custom_root(
        lambda params: _normal_equations(residuals, params)[1],
        jnp.zeros((3, 3), dtype),
        lambda _, start: _levenberg_marquardt(residuals, start, bound, num_iterations),
        tangent_solve,
    )
    gram, slope, cost = _normal_equations(residuals, params)
    step, drag_variance = _damped_solve(gram, slope, damping)
    count = jnp.sum(seen).astype(dtype)
    noise = count * (100.0 * eps * jnp.max(jnp.abs(positions), axis=0)) ** 2
    # Never 0, so that an axis without influence (infinite variance) stays infinite.
    variance = jnp.maximum(cost / jnp.maximum(count - 3.0, 1.0), jnp.finfo(dtype).tiny)
    return LinearDragFit(
        drag=params[2],
        ball=BallState(pos=params[0], vel=params[1]),
        residual=_safe_sqrt(cost / jnp.maximum(count, 1.0)),
        drag_std=lax.stop_gradient(jnp.sqrt(drag_variance * variance)),
        # One more full step would take slope . step off the cost.
        converged=(jnp.sum(slope * step, axis=0) <= 1e-4 * cost + noise) & (count >= 3.0),
    )


def _safe_sqrt(value: Array) -> Array:
    """Square root of value >= 0, with gradient 0 at 0."""
    positive = value > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, value, 1.0)), 0.0)


def specific_energy(ball: BallState, gravity: Array) -> Array:
    """Mechanical energy per unit mass  |v|^2 / 2 + g z  [m^2/s^2], g > 0 the magnitude.

    Paper 002 prints  + g' s  above eq. 6; with its own g, which points down, that sum would
    not be conserved in free flight.
    """
    return 0.5 * jnp.sum(ball.vel**2) + gravity * ball.pos[2]


def drag_measurement(before: BallState, after: BallState, duration: Array, gravity: Array) -> Array:
    """K_D [1/m] from the energy lost between two instants (paper 002, eq. 7).

    -(E[k] - E[k-1]) / (zeta ((|v[k]| + |v[k-1]|) / 2)^3) , shape (). NaN where it is not
    defined: a ball at rest, a duration zeta [s] of zero, or a state that is not finite.
    """
    speed = 0.5 * sum(_safe_sqrt(jnp.sum(ball.vel**2)) for ball in (before, after))
    lost = specific_energy(before, gravity) - specific_energy(after, gravity)
    lever = duration * speed**3
    defined = (lever > 0.0) & jnp.isfinite(lost)
    return jnp.where(defined, lost / jnp.where(defined, lever, 1.0), jnp.nan)


@struct.dataclass
class RlsState:
    """Recursive least squares for one unknown x in  y = h x + noise of unit variance."""

    estimate: Array  # () x
    variance: Array  # () of the estimate; 1/variance of the start counts as that many y, h = 1


def rls_update(
    state: RlsState, regressor: Array, measurement: Array, forgetting: Array | float
) -> RlsState:
    """The estimate with one measurement more.

    Args:
        state: the estimate so far.
        regressor: () h.
        measurement: () y; where it is not finite the estimate stays as it is.
        forgetting: () in (0, 1]: the weight of all that came before shrinks by this factor.
    """
    usable = jnp.isfinite(measurement)
    y = jnp.where(usable, measurement, 0.0)
    # P / (lambda + h^2 P) is the textbook's (1 - K h) P / lambda without its cancellation.
    variance = state.variance / (forgetting + regressor**2 * state.variance)
    error = y - regressor * state.estimate
    after = RlsState(estimate=state.estimate + variance * regressor * error, variance=variance)
    return jax.tree.map(lambda new, old: jnp.where(usable, new, old), after, state)


def estimate_drag(
    times: Array,
    path: BallState,
    gravity: Array,
    initial: RlsState,
    *,
    forgetting: Array | float = 1.0,
) -> tuple[RlsState, Array]:
    """K_D of the quadratic model from a row of ball states (paper 002, eqs 6 and 7, and RLS).

    As in the paper every K_D measured counts alike, and none is clipped: with noisy
    velocities single ones may well be negative.

    Args:
        times: (N,) [s], ascending.
        path: the ball at those times, leaves (N, 3), for instance `EkfState.ball`.
        gravity: () [m/s^2], magnitude.
        initial: K_D [1/m] assumed at first, and its variance.
        forgetting: () in (0, 1].

    Returns:
        The estimate after all measurements, and those after each, (N - 1,) [1/m].
    """
    chex.assert_shape([path.pos, path.vel], (times.shape[0], 3))
    before, after = (jax.tree.map(lambda x, s=s: x[s], path) for s in (slice(-1), slice(1, None)))
    measured = jax.vmap(drag_measurement, in_axes=(0, 0, 0, None))(
        before, after, jnp.diff(times), gravity
    )

    def advance(state: RlsState, measurement: Array) -> tuple[RlsState, Array]:
        state = rls_update(state, jnp.ones_like(measurement), measurement, forgetting)
        return state, state.estimate

    return lax.scan(advance, initial, measured)

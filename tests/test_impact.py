import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient_matches_differences

from planner_jax.ball.flight import solve_impact
from planner_jax.sims.scoring import no_contact, racket_impact
from planner_jax.sims.tasks.hit import reflect_ball

RESTITUTION = 0.7
BALL_VEL = np.array([-5.0, -0.4, -5.5])
RACKET_VEL = np.array([1.0, -2.0, 0.5])
NORMAL = np.array([2.0, 1.0, 2.0]) / 3.0
STILL = np.zeros(3)

float64 = pytest.mark.usefixtures("float64")

bounce = jax.jit(racket_impact)
required = jax.jit(solve_impact)


def split(vel):
    along = vel @ NORMAL
    return along, vel - along * NORMAL


@float64
@pytest.mark.parametrize("restitution", [0.0, 0.7, 1.0])
def test_a_still_racket_sends_a_ball_back_at_the_restitution_times_its_normal_speed(restitution):
    after = bounce(np.array([3.0, 0.0, -2.0]), STILL, np.array([0.0, 0.0, 1.0]), restitution)
    np.testing.assert_allclose(after, [3.0, 0.0, 2.0 * restitution], atol=1e-15)
    before, after = split(BALL_VEL), split(bounce(BALL_VEL, STILL, NORMAL, restitution))
    np.testing.assert_allclose(after[0], -restitution * before[0], atol=1e-14)
    np.testing.assert_allclose(after[1], before[1], atol=1e-14)


@float64
def test_a_simulated_hit_reverses_the_normal_speed_relative_to_the_racket_alone():
    one = jax.tree.map(lambda leaf: leaf[0], no_contact(1, float))
    contact = dataclasses.replace(
        one,
        ball_pos=np.array([0.1, 0.2, 1.3]),
        ball_vel=np.array([4.0, 5.0, -6.0]),
        tool_vel=np.array([1.0, 2.0, 3.0]),
        normal=np.array([0.0, 0.0, 1.0]),
    )
    after = reflect_ball(contact, np.float64(0.5))
    np.testing.assert_array_equal(after.pos, contact.ball_pos)
    # The ball approaches the racket at 9 m/s, and leaves it at half of this speed.
    np.testing.assert_allclose(after.vel, [4.0, 5.0, 3.0 + 0.5 * 9.0], atol=1e-15)


@float64
def test_a_bounce_looks_the_same_from_a_moving_frame_and_with_the_normal_reversed():
    after = bounce(BALL_VEL, STILL, NORMAL, RESTITUTION) + RACKET_VEL
    moving = bounce(BALL_VEL + RACKET_VEL, RACKET_VEL, NORMAL, RESTITUTION)
    np.testing.assert_allclose(moving, after, atol=1e-14)
    turned = bounce(BALL_VEL + RACKET_VEL, RACKET_VEL, -NORMAL, RESTITUTION)
    np.testing.assert_array_equal(turned, moving)


@float64
@pytest.mark.parametrize("restitution", [0.0, 0.47, 0.7, 1.0])
def test_the_solved_impact_inverts_the_bounce(restitution):
    after_hit = np.array([4.0, 1.5, 6.0])
    normal, normal_speed = required(BALL_VEL, after_hit, restitution)
    np.testing.assert_allclose(np.linalg.norm(normal), 1.0, rtol=1e-15)
    assert normal @ (after_hit - BALL_VEL) > 0.0
    across = np.cross(normal, [0.3, -4.0, 1.0])
    after = bounce(BALL_VEL, normal_speed * normal + across, normal, restitution)
    np.testing.assert_allclose(after, after_hit, atol=1e-13)


@float64
def test_impact_gradients_match_finite_differences():
    def everything(args):
        ball_vel, racket_vel, normal, restitution = args
        after = racket_impact(ball_vel, racket_vel, normal, restitution)
        back, normal_speed = solve_impact(after, racket_vel, restitution)
        return jnp.sum(after**3) + back @ jnp.arange(3.0) + normal_speed

    assert_gradient_matches_differences(everything, (BALL_VEL, RACKET_VEL, NORMAL, RESTITUTION))


def test_no_change_of_velocity_needs_no_normal_and_has_a_finite_gradient():
    vel = BALL_VEL.astype(np.float32)

    def require(after):
        impact = solve_impact(vel, after, RESTITUTION)
        return impact, impact

    jacobian, (normal, normal_speed) = jax.jit(jax.jacfwd(require, has_aux=True))(vel)
    assert not np.any(normal) and normal_speed == 0.0
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(jacobian))

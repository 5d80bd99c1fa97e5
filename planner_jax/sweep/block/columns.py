"""Columns of stored cases of an arm that blocks a ball: ball, arm, plan, referee's verdict."""

from planner_jax.runs import columns as known
from planner_jax.runs.columns import LIST, NUMBER, VECTOR, leaves_of

FRAME = "base of the robot, z up; times from the first observation of the ball"
_TILT = "greatest angle between shield's normal and ball's path"
_DURATIONS = "of the pieces; the first starts at the delay"

COLUMNS = [
    known.INDEX,
    *leaves_of(
        "cases",
        ("ball_pos", "m", "of the ball at its first observation", VECTOR, "ball.pos"),
        ("ball_vel", "m/s", "of the ball at its first observation", VECTOR, "ball.vel"),
        ("delay", "s", "until the arm may start"),
        ("start_angles", "rad", "of the six joints until the delay", LIST, "angles"),
        ("start_rates", "rad/s", "of the joints until the delay", LIST, "rates"),
        ("ends_at_rest", "", "whether the arm must be at rest at the contact", known.BOOL),
        ("offset", "m", "greatest distance of the ball from the shield's middle at contact"),
        ("tilt_limit", "rad", _TILT, NUMBER, "tilt"),
    ),
    *leaves_of(
        "plans",
        ("planned_contact_time", "s", "of the plan", NUMBER, "contact_time"),
        ("motion_coeffs", "rad/s^k", "(pieces, powers, 6) of the joints", LIST, "motion.coeffs"),
        ("motion_durations", "s", _DURATIONS, LIST, "motion.durations"),
    ),
    *known.SOLVER,
    *leaves_of(
        "verdict",
        ("execution_time", "s", "duration of the motion"),
        ("contact_time", "s", "of the ball with the shield"),
        ("miss", "m", "of the ball from the shield's middle at contact"),
        ("tilt", "rad", "of the shield's normal from the ball's path at contact"),
        ("velocity_share", "1", "greatest rate over its limit"),
        ("acceleration_share", "1", "greatest acceleration over its limit"),
        ("obstacle_clearance", "m", "least"),
        ("floor_clearance", "m", "least"),
        ("rig_clearance", "m", "least"),
        ("base_clearance", "m", "least"),
        ("self_clearance", "m", "least between parts of the arm and the shield"),
        ("failed_part", "", "joint or links of the first limit that fails, or empty", known.TEXT),
    ),
    *known.OUTCOME,
]

"""What the numbers of a hit must be."""

from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE, Field, Table, below, within
from planner_jax.task.quadrotor import FLIGHT_RULES

RULES: Table = (
    Field("ball.pos", (3,)),
    Field("ball.vel", (3,)),
    Field("head_state", (4, 3)),
    Field("target", (3,)),
    Field("drag", (), NOT_NEGATIVE),
    Field("gravity", (), POSITIVE),
    Field("restitution", (), within(0.0, 1.0, "in [0, 1]")),
    Field("racket_height", ()),
    Field("racket_radius", (), POSITIVE),
    *FLIGHT_RULES,
    Field("limits.min_height", (), NOT_NEGATIVE),
    Field("hit_limits.hitting_speed", (3,), POSITIVE),
    Field("hit_limits.min_apex", (), NOT_NEGATIVE),
    Field("hit_limits.min_apex", (), below("hit_limits.max_apex")),
    Field("hit_limits.max_apex", ()),
)

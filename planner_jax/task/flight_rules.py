"""What the numbers of a quadrotor's limits must be, in the cases of all its tasks."""

from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE, POSITIVE_OR_NONE, Field, Table, below

FLIGHT_RULES: Table = (
    Field("limits.speed", (), POSITIVE),
    Field("limits.body_rate", (), POSITIVE),
    Field("limits.acceleration", (), POSITIVE),
    Field("limits.min_thrust", (), NOT_NEGATIVE),
    Field("limits.min_thrust", (), below("limits.max_thrust")),
    Field("limits.max_thrust", (), POSITIVE_OR_NONE),
    Field("limits.rotors.mass", (), POSITIVE),
    Field("limits.rotors.inertia", (3,), POSITIVE),
    Field("limits.rotors.mixer", (4, 4)),
    Field("limits.rotors.min_thrust", (), NOT_NEGATIVE),
    Field("limits.rotors.min_thrust", (), below("limits.rotors.max_thrust")),
    Field("limits.rotors.max_thrust", ()),
)

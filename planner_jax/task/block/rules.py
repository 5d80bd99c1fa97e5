"""What the numbers of a block must be."""

import numpy as np

from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE, Field, Table, below, within

RULES: Table = (
    Field("ball.pos", (3,)),
    Field("ball.vel", (3,)),
    Field("gravity", (), POSITIVE),
    Field("delay", (), NOT_NEGATIVE),
    Field("angles", (6,)),
    Field("rates", (6,)),
    Field("arm.lower", (6,), below("arm.upper")),
    Field("arm.upper", (6,)),
    Field("arm.mass", (6,), POSITIVE),
    Field("arm.capsule_radius", ("C",), NOT_NEGATIVE),
    Field("arm.shield_half", (), POSITIVE),
    Field("limits.velocity", (6,), POSITIVE),
    Field("limits.acceleration", (6,), POSITIVE),
    Field("ends_at_rest", (), kind=np.bool_),
    Field("offset", (), POSITIVE),
    Field("tilt", (), within(0.0, np.pi, "in [0, pi]")),
    Field("scene.inner.lower", (3,), below("scene.inner.upper")),
    Field("scene.inner.upper", (3,)),
    Field("scene.outer.lower", (3,), below("scene.outer.upper")),
    Field("scene.outer.upper", (3,)),
    Field("scene.pole", (2,)),
    Field("scene.pole_radius", (), NOT_NEGATIVE),
    Field("scene.has_pole", (), kind=np.bool_),
    Field("scene.floor", ()),
    Field("scene.beam_ends", ("N", 2, 3)),
    Field("scene.beam_radius", ("N",), NOT_NEGATIVE),
)

"""What the numbers of an interception must be."""

import numpy as np

from planner_jax.core.rules import (
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_NONE,
    Field,
    Table,
    below,
)

RULES: Table = (
    Field("start", (3,)),
    Field("speed", (), NOT_NEGATIVE),
    Field("curvature", ()),
    Field("time", (), POSITIVE),
    Field("tolerance", (), POSITIVE),
    Field("end_heading", ()),
    Field("heading_tolerance", (), POSITIVE),
    *(
        Field(f"{group}.{name}", (letter, *shape), kind=kind)
        for group, letter in (("walls", "W"), ("movers", "M"))
        for name, shape, kind in (
            ("centre", (2,), np.floating),
            ("corners", (f"corners of {group}", 2), np.floating),
            ("velocity", (2,), np.floating),
            ("present", (), np.bool_),
        )
    ),
    Field("lower", (2,), below("upper")),
    Field("upper", (2,)),
    Field("body.length", (), POSITIVE),
    Field("body.width", (), POSITIVE),
    Field("body.wheelbase", (), POSITIVE),
    Field("body.rear_overhang", ()),
    Field("limits.speed", (), POSITIVE_OR_NONE),
    Field("limits.acceleration", (), POSITIVE_OR_NONE),
    Field("limits.lateral_acceleration", (), POSITIVE_OR_NONE),
    Field("limits.curvature", (), POSITIVE_OR_NONE),
    Field("limits.steering_rate", (), POSITIVE_OR_NONE),
)

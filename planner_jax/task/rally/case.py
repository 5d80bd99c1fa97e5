"""Cases of the task `rally`: the ball, the quadrotor, and the places to which it sends the ball."""

import dataclasses
import functools
from typing import ClassVar

import jax.numpy as jnp
from flax import struct
from jax import Array

from planner_jax.core import rules
from planner_jax.core.arithmetic import to_host
from planner_jax.core.checks import floating, numbers_of, shape_of
from planner_jax.core.errors import ArgumentError
from planner_jax.core.origin import find_origin, move
from planner_jax.core.rules import Field, Table, require_sound
from planner_jax.task.arguments import array_of, batch_of
from planner_jax.task.hit.case import RULES as HIT_RULES
from planner_jax.task.hit.case import HitLimits, RacketCase
from planner_jax.task.hit.case import case as hit_case
from planner_jax.task.hit.spec import START

_ROUNDING = 1e-5  # [m], by which rounding may move a box beyond the heights of contacts
# Shapes and ranges that `pj.require_sound` checks for the arrays of a `RallyCase`.
RULES: Table = (
    *(field for field in HIT_RULES if field.name != "target"),
    Field("places", ("K", 3)),
    Field("place_range", ("K", 3), rules.NOT_NEGATIVE),
    Field("ball_time"),
    Field("home", (3,)),
    Field("hit_limits.min_contact", (), rules.POSITIVE),
    Field("hit_limits.min_contact", (), rules.below("hit_limits.max_contact")),
    Field("hit_limits.max_contact", (), rules.below("hit_limits.max_apex")),
)


@struct.dataclass
class RallyLimits(HitLimits):
    """Limits at every contact: speed, apex of the ball after it, and height of the contact.

    Attributes:
        min_contact: () [m], least height of a contact.
        max_contact: () [m], greatest height of a contact.
    """

    min_contact: Array
    max_contact: Array


@struct.dataclass
class RallyCase(RacketCase):
    """K >= 1 hits to plan, or a batch: a quadrotor has to hit one ball again and again.

    Hit k sends the ball to a place that the planner chooses in a box, and hit k + 1 happens there.

    Attributes:
        hit_limits: limits at every contact.
        places: (K, 3) [m], centre of the box in which the place after each hit is chosen.
        place_range: (K, 3) [m], half the box's width; zeros for a fixed place.
        ball_time: () [s], time at which the ball has the state `ball`, such as a partner's planned
            hit.
        home: (3,) [m], position at which the racket waits after the last hit until a partner has
            returned the ball; None: the robot itself hits the ball at the last place.
    """

    rules: ClassVar[Table] = RULES
    positions: ClassVar[dict] = {**RacketCase.positions, "places": (), "home": ()}

    hit_limits: RallyLimits  # pyright: ignore[reportIncompatibleVariableOverride]
    places: Array = struct.field(kw_only=True)
    place_range: Array = struct.field(kw_only=True)
    ball_time: Array = struct.field(kw_only=True)
    home: Array | None = struct.field(kw_only=True, default=None)


def case(
    ball_pos,
    ball_vel,
    places,
    *,
    place_range=(0.5, 0.5, 0.2),
    min_contact=1.0,
    max_contact=2.0,
    ball_time=0.0,
    home=None,
    start=START,
    origin=None,
    dtype=jnp.float32,
    **options,
) -> RallyCase:
    """Make one case of K hits in a row, or a batch.

    Inside compiled functions every number may be a traced array. Values are then not checked: an
    invalid one leads to the status `BAD_INPUT` of the plan. Shapes and types are checked, and a
    traced `start` has the origin (0, 0) by default.

    Args:
        ball_pos: (..., 3) [m], position of the ball at `ball_time`, above the ground at z = 0.
        ball_vel: (..., 3) [m/s], velocity of the ball at `ball_time`.
        places: (K, 3) or (..., K, 3) [m], centre of the box to which each hit sends the ball. The
            next hit happens at the place in the box that the planner chooses.
        place_range: (3,), (K, 3) or (..., K, 3) [m], half the width of the boxes; zeros fix the
            places.
        min_contact: [m], least height of the contacts.
        max_contact: [m], greatest height of the contacts.
        ball_time: [s], time after the start of the plan, such as a partner's planned hit.
        home: (3,) or (..., 3) [m], where the racket waits after the last hit while a partner
            returns the ball. By default the quadrotor itself hits the ball at the last place.
        start: (3,) or (..., 3) [m], position of the quadrotor at time 0.
        origin: (2,) x, y [m], world position that is subtracted from all positions, as in hits.
        dtype: type of every floating leaf.
        **options: further arguments of `pj.hit.case`, such as `robot`, `drag` or `max_apex`. The
            `heading` may not follow the ball, and balls have no `spin`.

    Returns:
        A case whose leaves have the batch shape of `ball_pos`.

    Raises:
        CaseError: a number breaks a rule, such as a box that is not between the contact heights.
        ValueError: an argument has a wrong shape.
        TypeError: an argument does not hold numbers, or `dtype` is not a floating type.
    """
    dtype, batch = floating(dtype), batch_of("ball_pos", ball_pos, 3)
    shape = shape_of("places", places)
    if len(shape) < 2 or shape[-1] != 3 or shape[-2] < 1:
        raise ArgumentError("places", "the shape (K, 3) with K >= 1", shape, verb="have")
    shift = find_origin(start, origin, batch, dtype)
    leaf = functools.partial(array_of, batch=batch, dtype=dtype)
    back = None if shift is None else -shift
    near = move("places", places, back, dtype)
    if shape_of("place_range", place_range) == (3,):
        place_range = numbers_of("place_range", place_range, shape[-2:-1], (3,))
    base = hit_case(
        ball_pos,
        ball_vel,
        (0.0, 0.0, 0.0),  # hits of a rally have places instead of a target
        start=start,
        origin=origin,
        dtype=dtype,
        **options,
    )
    if base.lift is not None:
        raise ArgumentError("spin", "left out for rallies", shown="a spin")
    if options.get("heading") == "ball":
        raise ArgumentError("heading", "an angle, or 'velocity'", "ball")
    values = {name: value for name, value in vars(base).items() if name != "target"}
    values["hit_limits"] = RallyLimits(
        **vars(base.hit_limits),
        min_contact=leaf("min_contact", min_contact),
        max_contact=leaf("max_contact", max_contact),
    )
    cases = RallyCase(
        **values,
        places=leaf("places", near, *shape[-2:]),
        place_range=leaf("place_range", place_range, *shape[-2:]),
        ball_time=leaf("ball_time", ball_time),
        home=None if home is None else leaf("home", move("home", home, back, dtype), 3),
    )
    names = {f"hit_limits.{field.name}": field.name for field in dataclasses.fields(RallyLimits)}
    require_sound(cases, names)
    height, half = (to_host(each)[..., 2] for each in (cases.places, cases.place_range))
    least, most = (
        to_host(each)[..., None]
        for each in (cases.hit_limits.min_contact, cases.hit_limits.max_contact)
    )
    is_within = (height - half >= least - _ROUNDING) & (height + half <= most + _ROUNDING)
    words = "boxes between the heights min_contact and max_contact"
    return rules.require_or_mark(cases, "places", height, is_within, words)

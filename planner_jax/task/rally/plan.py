"""Plans of chains of hits: the quadrotor's trajectory through all contacts, and the contacts."""

from flax import struct
from jax import Array

from planner_jax.robot.quadrotor import QuadrotorPlan
from planner_jax.task.hit.plan import Stroke


@struct.dataclass
class RallyPlan(QuadrotorPlan):
    """The plan of K hits, which ends at the last one; or a batch: leaves have a leading axis B.

    Attributes:
        strokes: the K impacts, with leaves that have a leading axis K. Times count from the plan's
            start; the flight time of a stroke ends at the next contact, and the flight time of the
            last stroke at the last place.
        places: (K, 3) [m], position to which the ball comes after each hit: the next contact.
    """

    strokes: Stroke
    places: Array

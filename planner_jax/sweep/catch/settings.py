"""Settings of sweeps, that is runs over many cases, of a quadrotor that catches with a net."""

import dataclasses
import math
from typing import ClassVar

from planner_jax.core.choices import require, require_one_of
from planner_jax.core.registry import split_name
from planner_jax.runs.settings import option
from planner_jax.sweep.quadrotor_settings import QuadrotorSettings
from planner_jax.task.catch.spec import DECISIONS, SUITES, TRAINED

NET_TESTS = ("plane", "ball")  # how the referee tests the net's radius: see the option `net_test`


@dataclasses.dataclass(frozen=True)
class CatchSettings(QuadrotorSettings):
    """Settings and command-line options of a run over many drawn cases of catching with a net."""

    decide: str = option(
        "best", "NAME", f"decision of the order and times: {', '.join(DECISIONS)}, policy:FILE"
    )
    tolerance: float = option(
        1e-3, "R", "relative tolerance of the referee; published protocol: 0.05 and --net-test ball"
    )
    net_test: str = option(
        "plane",
        "NAME",
        f"how the net's radius is tested, {' or '.join(NET_TESTS)}: within the plane of the net, "
        "or in all directions from its centre",
    )

    TOOL: ClassVar[str] = "net"
    WITHOUT_EFFORT: ClassVar[str] = "mpp"
    RUN: ClassVar[str] = "planner_jax.sweep.catch.sweep:CatchSweep"
    PLANNER: ClassVar[tuple[str, ...]] = ("decide",)
    DRAW: ClassVar[tuple[str, ...]] = ("limit_scale", "robot", "wind", "starts")
    JUDGE: ClassVar[tuple[str, ...]] = ("tolerance", "net_test")
    # Number of cases in a batch on a GPU. It is small, because evaluating the 720 orders of six
    # targets takes 1 MB of memory for each case.
    GPU_BATCH: ClassVar[int] = 16384

    def __post_init__(self) -> None:
        super().__post_init__()
        tolerance = self.tolerance
        split_name(DECISIONS, "decide", self.decide, TRAINED)
        require_one_of(NET_TESTS, "net_test", self.net_test)
        require(0.0 <= tolerance < math.inf, "tolerance", "finite and >= 0", tolerance)

    @property
    def case_bytes(self) -> int:
        """Estimated memory [bytes] of one case; it grows with the number of orders of catching."""
        suite = SUITES.get(self.suite or next(iter(SUITES)))
        all_orders = self.decide == "best" and suite is not None and not suite.optional
        orders = math.factorial(min(suite.num_targets, 6)) if suite and all_orders else 1
        return self.CASE_BYTES + 1_400 * orders

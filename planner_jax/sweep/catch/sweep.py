"""Runs over many cases of catching with a net, compared with the rates of [Yu2023catch]."""

import numpy as np
import pyarrow as pa
from jaxtyping import PyTree

from planner_jax.baselines.catch.published import SOURCE, make_table
from planner_jax.runs.manifest import Entries
from planner_jax.runs.summary import COUNTED, Tally
from planner_jax.runs.table import RateTable
from planner_jax.sweep.catch.columns import COLUMNS, FRAME
from planner_jax.sweep.catch.figures import flight_figure, motion_figure
from planner_jax.sweep.catch.settings import CatchSettings
from planner_jax.sweep.figures import CAPTION as MOTION
from planner_jax.sweep.quadrotor import recovery_remark
from planner_jax.sweep.quadrotor_settings import robot_remark
from planner_jax.sweep.rows import quadrotor_plan
from planner_jax.sweep.sweep import RunFigure, Sweep, first_values

_SOLVED = ("CONVERGED", "FEASIBLE")
_DECISIONS = {
    "best": "the most promising orders are planned; the earliest last catch is selected",
    "greedy": "next the target that can be caught earliest",
    "random": "next a random target that can be caught",
    "given": "targets in the order of the case, at evenly spaced times up to the horizon",
    "policy": "by a network trained with reinforcement learning",
}
_NET_TESTS = {
    "plane": "5 mm from the net's plane and there within its radius",
    "ball": "within the net's radius of its centre in any direction",
}


class CatchTally(Tally):
    """Counts of successes, and means of three further quantities of catches.

    They are the fraction of targets that are caught; the times of catches [s]; and the optimal time
    ratio |T_o - T_p| / T_o of solved cases [Yu2023catch, eq. 29]. T_p is the time of a catch that
    is estimated when the order of targets is chosen, T_o its time in the optimised plan.
    """

    READS = (*COUNTED, "caught", "present", "catch_times", "time_ratio")

    def __init__(self, decides: bool = True) -> None:
        super().__init__()
        self._decides = decides  # False for planners that choose catch times without a decision
        self._shares = self._ratios = self._times = 0.0
        self._num_ratios = self._num_caught = 0

    def add(self, rows: pa.Table) -> None:
        """Add rows, one for each planned and judged case, to the counts and sums."""
        super().add(rows)
        names = ("caught", "present", "catch_times")
        caught, present, times = (np.stack(rows[name].to_pylist()) for name in names)
        self._shares += float((caught.sum(axis=1) / present.sum(axis=1)).sum())
        self._times += float(times[caught].sum())
        self._num_caught += int(caught.sum())
        ratio = rows["time_ratio"].to_numpy()
        known = np.isin(rows["status"].to_numpy(), _SOLVED) & np.isfinite(ratio)
        self._ratios += float(ratio[known].sum())
        self._num_ratios += int(known.sum())

    def summary(self) -> Entries:
        """Return success rates, mean time [s] of catches, and the mean optimal time ratio.

        The ratio is |T_o - T_p| / T_o, with T_p the estimated and T_o the planned time of a catch.
        """
        return {
            **super().summary(),
            "caught": self._shares / self.num,
            "mean_catch_time": _mean(self._times, self._num_caught),
            "optimal_time_ratio": _mean(self._ratios, self._num_ratios if self._decides else 0),
        }


class CatchSweep(Sweep[CatchSettings]):
    """Sweeps that plan and judge many cases of a quadrotor that catches with a net."""

    frame, own_columns, single_columns = FRAME, COLUMNS, COLUMNS
    plan_of_row = staticmethod(quadrotor_plan)
    figures = (
        RunFigure(
            "flight.png",
            "One plan from the side and from above, and its catches close up from the "
            "side: targets, quadrotor, and the net at every catch.",
            (13.0, 7.6),
            flight_figure,
        ),
        RunFigure("motion.png", MOTION, (13.0, 6.8), motion_figure),
        *Sweep.figures,
    )
    single_figures = figures[:2]

    def setting(self, cases: PyTree) -> Entries:
        """Return physics and limits that all cases share, for the manifest's entry `setting`."""
        net = first_values(cases.net, ["height", "radius", "max_angle"], "net_")
        return first_values(cases, ["gravity"]) | net | first_values(cases.limits)

    def tally(self, settings: CatchSettings) -> CatchTally:
        """Return a new counter of rows, from which the summary of a run is made."""
        return CatchTally(decides=settings.planner != "mpp")

    def table(self, manifest: Entries) -> RateTable:
        """Return the table of success rates, beside rates of [Yu2023catch, Tables I and III]."""
        return make_table(manifest)

    def findings(self, manifest: Entries) -> list[str]:
        """Return a sentence on caught targets, times of catches, and changes of estimated times."""
        summary = manifest["summary"]
        text = f"{100.0 * summary['caught']:.2f} % of the targets caught"
        if summary["mean_catch_time"] is not None:
            text += f", after {summary['mean_catch_time']:.3f} s on average"
        if summary["optimal_time_ratio"] is not None:
            text += f"; optimal time ratio {summary['optimal_time_ratio']:.3f}"
        return [f"{text}."]

    def remarks(self, manifest: Entries) -> list[str]:
        """Return sentences on robot, cases, order of catches, limits, and the rule of success."""
        settings, limits = manifest["parameters"], manifest["setting"]
        gravity = limits["gravity"]
        return [
            *robot_remark(settings),
            *recovery_remark(settings),
            f"Cases: {settings['num']:,} of suite {settings['suite']}, seed {settings['seed']}. "
            "Suites are modelled on suites of the same name in the paper, which states no ranges.",
            f"Order and first times, decision {settings['decide']}: "
            f"{_DECISIONS[settings['decide'].partition(':')[0]]}.",
            f"Limits: speed {limits['speed']:g} m/s, body rate {limits['body_rate']:g} rad/s, "
            f"thrust {limits['min_thrust'] / gravity:.3g} to {limits['max_thrust'] / gravity:.3g} "
            f"g, height {limits['min_height']:g} m; scale {settings['limit_scale']:g} on speed, "
            "body rate and the thrust's distance from hover.",
            "The referee accepts a success: all targets caught and every limit within "
            f"{settings['tolerance']:g} relative, the target {_NET_TESTS[settings['net_test']]}. A "
            "target counts as caught if its catch keeps its limits, even if another limit fails.",
            "OTR is the optimal time ratio, the mean of |T_o - T_p| / T_o over the targets of "
            "solved cases, T_p decided and T_o optimised (eq. 29 of the paper); mpp has none, as "
            "it chooses its own times.",
            SOURCE,
        ]


def _mean(total: float, num: int) -> float | None:
    return total / num if num else None

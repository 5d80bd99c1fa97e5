"""A learned policy that decides the order and times of catches: `decide="policy"`."""

import functools
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from planner_jax.core.checks import require_number
from planner_jax.core.choices import require_size
from planner_jax.core.errors import ArgumentTypeError
from planner_jax.core.rules import NOT_NEGATIVE, POSITIVE
from planner_jax.policies.checkpoint import checkpoint_of
from planner_jax.policies.networks import LEAST_STD
from planner_jax.policies.observation import PER_TARGET, STRETCH, choice_of, observe
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.decide import CatchDecision, in_several_lengths
from planner_jax.task.catch.estimate import timetable

# Training rewards times from which few iterations lead to a plan. The planner has more iterations
# and also solves from earlier times: with this factor the last catch is 3 to 4 % earlier.
_EARLIER = 0.95


@struct.dataclass
class Policy(CatchDecision):
    """A decision whose order and times come from a network; the weights are leaves.

    The first of several proposals is the mean of the network's distribution. The others are drawn
    around the mean with the same noise for every case. The planner plans all proposals and keeps
    the one with the earliest last catch.
    """

    params: Any  # weights of the network
    network: Any = struct.field(pytree_node=False)
    proposals: int = struct.field(pytree_node=False, default=1)
    spread: float = struct.field(pytree_node=False, default=1.0)  # factor on standard deviations
    # Factor on the times. Above 1 a plan needs fewer iterations, and its last catch is later.
    stretch: float = struct.field(pytree_node=False, default=1.0)

    def __post_init__(self) -> None:
        require_size("proposals", self.proposals)
        require_number("spread", self.spread, NOT_NEGATIVE)
        require_number("stretch", self.stretch, POSITIVE)
        if not callable(getattr(self.network, "apply", None)):
            raise ArgumentTypeError("network", "a Flax module", self.network)

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` where there are more targets than the network takes."""
        most = getattr(self.network, "size", None)
        if most is not None and cases.num_targets > most:
            raise ValueError(
                f"this policy was trained for up to {most} targets and takes no more, got "
                f"{cases.num_targets}"
            )

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return the proposals for one case, leaves (K, N); more than K with optional targets."""
        table = timetable(case)
        numbers = self.network.apply(self.params, observe(case, table))
        mean, spread = numbers[:, :PER_TARGET], numbers[:, PER_TARGET:]
        deviation = jax.nn.softplus(spread) + LEAST_STD
        shape = (self.proposals, case.num_targets, PER_TARGET)
        noise = np.random.default_rng(0).normal(size=shape)
        noise[0] = 0.0
        actions = jnp.tanh(mean + self.spread * deviation * jnp.asarray(noise, mean.dtype))
        later = np.array([0.0, np.log(self.stretch) / STRETCH], mean.dtype)
        actions = jnp.clip(actions + later, -1.0, 1.0)
        choices = jax.vmap(functools.partial(choice_of, case, table))(actions)
        return in_several_lengths(case, choices)


def policy(file: str | os.PathLike = "catch", **options: Any) -> Policy:
    """Load a policy from a checkpoint.

    Args:
        file: path of a file written by `planner-jax train`, or the name of a shipped policy:
            "catch", trained on suites of one to twelve targets, or "rush6", trained on the suite
            `rush6` alone.
        **options: `proposals`, `spread` and `stretch` of `Policy`; the default of `stretch` is
            0.95, and 1 gives the times as trained.

    Raises:
        TypeError: an option has the wrong type.
        ValueError: `proposals` is below 1, or another option is negative, zero or not finite.
        ArgumentError: the file is not a checkpoint of a policy, or has another format.
    """
    found = checkpoint_of(file)
    params = jax.tree.map(jnp.asarray, found.params)  # sent to the device once, not each time
    return Policy(params=params, network=found.network, **{"stretch": _EARLIER, **options})

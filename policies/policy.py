"""A learned decision about catches: `pj.catch.planner(decide="policy")`."""

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

# Training rewards times from which few iterations lead to a plan. The planner has more, and makes
# plans from earlier times as well: so much earlier costs nothing, and catches come 3 to 4 % sooner.
_EARLIER = 0.95


@struct.dataclass
class Policy(CatchDecision):
    """Order and times by a network; its weights are leaves.

    Of several proposals the first is the network's mean, and the others are drawn around it, the
    same ones for every case; the planner plans them all and keeps the earliest.
    """

    params: Any  # of the network
    network: Any = struct.field(pytree_node=False)
    proposals: int = struct.field(pytree_node=False, default=1)
    spread: float = struct.field(pytree_node=False, default=1.0)  # factor on deviations
    # Factor on the times: above one a plan needs fewer iterations, and its last catch is later.
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
        """The proposals for one case, leaves (K, N), or more if targets are optional."""
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
    """The policy of a checkpoint.

    Args:
        file: that `planner-jax train` wrote, or the name of one that is shipped: "catch", which
            was trained on suites of one to twelve targets, or "rush6", on that suite alone.
        **options: `proposals`, `spread` and `stretch` of `Policy`; `stretch` is 0.95 unless given,
            and 1 for the times as they were trained.

    Raises:
        TypeError: an option is of another kind.
        ValueError: there is no proposal, or an option is negative, zero or not finite.
        ArgumentError: it is no checkpoint of a policy, or of another version; one line.
    """
    found = checkpoint_of(file)
    params = jax.tree.map(jnp.asarray, found.params)  # sent to the device once, not each time
    return Policy(params=params, network=found.network, **{"stretch": _EARLIER, **options})

"""A learned policy for the order and times of catches: option `decide="policy"` of planners."""

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
from planner_jax.policies.networks import LEAST_STD, PublishedMlp
from planner_jax.policies.observation import PER_TARGET, STRETCH, choice_of, observe
from planner_jax.policies.published import PublishedPolicy
from planner_jax.policies.settings import LEAST_TIME
from planner_jax.task.catch.case import CatchCase, CatchChoice
from planner_jax.task.catch.decide import CatchDecision, in_several_lengths
from planner_jax.task.catch.estimate import timetable

# Default factor on a policy's times. In training the planner has few iterations, so that the policy
# learns times that are easy to reach. In use the planner has more iterations and also succeeds from
# earlier times: this factor makes the last catch 3 to 4 % earlier.
_EARLIER = 0.95


@struct.dataclass
class Policy(CatchDecision):
    """A decision that takes the order and times of catches from a neural network.

    A proposal is an order and times of catches. The first proposal for a case is the mean of the
    network's distribution of actions. Further proposals are drawn from it, with equal random
    numbers for every case. The planner plans all and selects the plan with the earliest last catch.
    If targets are optional, a beam search for orders adds the network's handicaps to the ranks.
    """

    params: Any  # weights of the network, the leaves of this pytree
    network: Any = struct.field(pytree_node=False)  # a Flax module from `networks`
    proposals: int = struct.field(pytree_node=False, default=1)  # number of proposals for a case
    spread: float = struct.field(pytree_node=False, default=1.0)  # factor on standard deviations
    # Factor on the times of the catches. With a factor above 1 the planner needs fewer iterations,
    # and the last catch is later.
    stretch: float = struct.field(pytree_node=False, default=1.0)
    # Number of partial orders that continue in the search with the network's handicaps, if targets
    # are optional; 1: no search.
    width: int = struct.field(pytree_node=False, default=8)

    def __post_init__(self) -> None:
        require_size("proposals", self.proposals)
        require_size("width", self.width)
        require_number("spread", self.spread, NOT_NEGATIVE)
        require_number("stretch", self.stretch, POSITIVE)
        if not callable(getattr(self.network, "apply", None)):
            raise ArgumentTypeError("network", "a Flax module", self.network)

    def check(self, cases: CatchCase) -> None:
        """Raise `ValueError` if the cases have more targets than the network accepts."""
        most = getattr(self.network, "size", None)
        if most is not None and cases.num_targets > most:
            raise ValueError(
                f"this policy was trained for up to {most} targets and takes no more, got "
                f"{cases.num_targets}"
            )

    def propose(self, case: CatchCase) -> CatchChoice:
        """Return proposals for the order and times of the catches in one case with N targets.

        Order and times are arrays (K, N) for K proposals. If targets are optional, each proposal of
        the network also gives variants that omit its last catches, which are the least certain.
        """
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
        decide = functools.partial(choice_of, case, table, width=self.width)
        choices = jax.vmap(decide)(actions)
        return in_several_lengths(case, choices)


def policy(file: str | os.PathLike = "catch", **options: Any) -> Policy | PublishedPolicy:
    """Load a trained policy from a file.

    Args:
        file: path of a file written by `planner-jax train`, or the name of a policy that is part of
            the package: "catch", trained on cases of one to twelve targets, or "rush6", trained on
            cases of six targets with deadlines.
        **options: `proposals`, number of proposals for a case (default 1); `spread`, factor on the
            standard deviations of drawn proposals (1); `stretch`, factor on catch times (0.95);
            `width`, number of partial orders in the search if targets are optional (8). A published
            policy of [Yu2023catch] has the one option `t_min`, the least time of a catch [s].

    Raises:
        TypeError: an option has the wrong type.
        ValueError: `proposals` or `width` is below 1, or another option is negative, zero or not
            finite.
        ArgumentError: the file is not a checkpoint of a policy, or has another format.
    """
    found = checkpoint_of(file)
    # Copy the weights to the device once, so that later calls need not copy them.
    params = jax.tree.map(jnp.asarray, found.params)
    if isinstance(found.network, PublishedMlp):
        trained = {"t_min": found.about.get("t_min", LEAST_TIME)}
        return PublishedPolicy(params, found.network, **trained | options)
    return Policy(params=params, network=found.network, **{"stretch": _EARLIER, **options})

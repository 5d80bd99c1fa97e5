"""Walking through a jaxpr, JAX's list of a function's operations, with values of any kind."""

from collections.abc import Callable
from typing import Any

from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

_CALLS = frozenset(
    "checkpoint closed_call core_call custom_jvp_call custom_vjp_call jit pjit remat2".split()
)
# Operations that give what they are given. In a program for several devices `jnp.where` and others
# say by `reshard` that an array is a device's own, which in one lane all are.
_UNCHANGED = frozenset("copy copy_p reshard stop_gradient".split())


def evaluate(
    closed: ClosedJaxpr, args: list[Any], outputs: Callable[[JaxprEqn, list[Any]], list[Any]]
) -> list[Any]:
    """Values of the outputs of a function.

    Args:
        closed: the function's operations and constants.
        args: values of its arguments, of any kind that `outputs` takes.
        outputs: of one operation and the values of its inputs, to the values of its outputs.
    """
    jaxpr = closed.jaxpr
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values.update(zip(jaxpr.invars, args, strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        inputs = [read(atom) for atom in eqn.invars]
        is_same = eqn.primitive.name in _UNCHANGED
        values.update(zip(eqn.outvars, inputs if is_same else outputs(eqn, inputs), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def called(eqn: JaxprEqn) -> ClosedJaxpr | None:
    """The function that an operation calls, if it does nothing else."""
    if eqn.primitive.name not in _CALLS:
        return None
    inner = eqn.params["jaxpr"] if "jaxpr" in eqn.params else eqn.params["call_jaxpr"]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())


def shape_of(atom: Any) -> tuple[int, ...]:
    """Shape of a variable or literal."""
    return atom.aval.shape

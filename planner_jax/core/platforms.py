"""The platform for which JAX traces a program, by which functions choose a method: CPU or GPU."""

import contextlib
import contextvars
from collections.abc import Iterator

from jax.extend.backend import backends

_TRACED: contextvars.ContextVar[str | None] = contextvars.ContextVar("platform", default=None)


@contextlib.contextmanager
def trace_for(platform: str) -> Iterator[None]:
    """Declare that programs traced within the `with` block run only on one platform ("cpu")."""
    token = _TRACED.set(platform)
    try:
        yield
    finally:
        _TRACED.reset(token)


def traced_platform() -> str | None:
    """Return the only platform for which a program is being traced, or None if it is unknown.

    If it is known, the methods of other platforms need not be traced.
    """
    return _TRACED.get()


def has_only_cpu() -> bool:
    """Return whether all devices of JAX are CPUs."""
    return set(backends()) == {"cpu"}

"""The exception for optional packages that are not installed."""

from pathlib import Path

from planner_jax.core.errors import PlannerJaxError


class MissingExtra(PlannerJaxError, ModuleNotFoundError):
    """A feature needs a package that is not installed; the text says how to install it.

    Args:
        feature: argument or command that needs the package.
        package: package that is missing.
        extra: extra of `planner-jax` that installs the package.
    """

    _names = ("feature",)

    def __init__(self, feature: str, package: str | None, extra: str):
        super().__init__(feature, package, extra)
        self.feature, self.name = feature, package
        self.install = install_line(extra)

    def __str__(self) -> str:
        return f"{self.feature} needs {self.name}: {self.install}"


def install_line(extra: str) -> str:
    """Return the command that installs an extra (optional packages), in a checkout or elsewhere."""
    if (Path(__file__).parents[2] / "pyproject.toml").is_file():
        return f"pip install -c constraints.txt -e '.[{extra}]'"
    return f"pip install 'planner-jax[{extra}]'"

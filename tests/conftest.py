"""Settings that every test shares, made before the first import of JAX.

They are environment variables, so that worker processes and the processes that tests start (the
command line, the notebooks' kernels) have them too.
"""

import os
from importlib.metadata import version
from pathlib import Path

CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "agg")
# The tests mostly compile, and a third of that time fuses loops, which does not pay for few lanes.
# XLA ends a process that names an unknown flag, and later versions do not know this one.
if version("jaxlib") < "0.11":
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402
from typecheck import PACKAGES, accept_leaves  # noqa: E402

pytest.register_assert_rewrite("sweeps", "tests.sweeps")
accept_leaves()
install_import_hook([f"planner_jax.{name}" for name in PACKAGES], "typecheck.check")

# Every compiled program takes some of the 65,530 memory mappings that Linux allows a process by
# default; without a free one a compilation aborts the process.
MOST_MAPPINGS = 40_000


def pytest_runtest_teardown(item, nextitem):
    """Forget compiled programs if there are many, after a module or a slow test."""
    ends_module = nextitem is None or nextitem.path != item.path
    mappings = Path("/proc/self/maps")
    if (ends_module or item.get_closest_marker("slow")) and mappings.exists():
        if mappings.read_bytes().count(b"\n") > MOST_MAPPINGS:
            jax.clear_caches()


@pytest.fixture
def float64():
    """Use double precision during one test: the reference arithmetic of the suite."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module", autouse=True)
def strict_arrays(request):
    """Raise in default runs where JAX would add axes or convert a type to combine arrays.

    Types are converted in modules with MJX or Brax.
    """
    stem = request.path.stem.removeprefix("test_")
    options = {"jax_numpy_rank_promotion": "raise"}
    if not stem.startswith("sims_") and stem not in MIXED:
        options["jax_numpy_dtype_promotion"] = "strict"
    if "not slow" not in request.config.option.markexpr:
        options = {}
    usual = {name: getattr(jax.config, name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    yield
    for name, value in usual.items():
        jax.config.update(name, value)


@pytest.fixture(scope="module")
def finished(request, tmp_path_factory):
    """Return folder and manifest of a complete sweep of the module's TASK and SETTINGS."""
    from planner_jax.sweep.run import start_sweep

    out = tmp_path_factory.mktemp("runs") / "finished"
    module = request.module
    return out, start_sweep(module.TASK, module.SETTINGS, out, progress=False)


# Published baselines, studies, learned policies, stores and clusters: `make test-slow` runs them.
SLOW = (
    *("b_spline", "baselines", "bezier", "block_adapt", "block_library", "block_peers"),
    *("catch_peer", "hybrid_astar", "minimum_jerk", "mpp", "paper_catch", "path_smoothing"),
    *("path_then_speed", "qp", "speed", "station_time"),
    *("block_eye", "block_receding"),
    *("policy", "training", "learned_start"),
    "cluster",
    *("bench", "benchmark_ipopt", "intercept_oracle"),
)
# Modules beside `test_sims_*` that convert types implicitly, mostly in MJX, Brax or optax.
MIXED = (
    *("policy", "training", "stack", "speed", "bench", "live_loop", "perception"),
    *("plane_prediction", "cli", "snippets", "notebooks"),
)
# Modules that take longest, or compile programs that others find in the cache: test_exact the hit
# planner's, test_decide the catch planner's. Workers get whole modules in this order, so that none
# ends with a long module, and no two compile the same program.
FIRST = (
    *("along_curvature", "sims_flights", "exact", "notebooks", "intercept", "decide"),
    *("contract", "block", "own_task", "along", "estimation"),
)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the modules of SLOW, and put the modules of FIRST before the others."""
    places = {f"test_{name}": place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(FIRST)))
    for item in items:
        if item.path.stem.removeprefix("test_") in SLOW:
            item.add_marker(pytest.mark.slow)

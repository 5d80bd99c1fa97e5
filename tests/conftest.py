"""Environment variables, fixtures and the order of all tests.

The variables are set before the first import of JAX. Worker processes, and processes that tests
start (the command line, the notebooks' kernels), inherit them.
"""

import gc
import os
from importlib.metadata import version
from pathlib import Path

CACHE = Path(__file__).resolve().parents[1] / ".cache" / "jax"

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "agg")

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402
from marks import selects_slow  # noqa: E402
from typecheck import PACKAGES, accept_leaves  # noqa: E402

pytest.register_assert_rewrite("sweeps", "tests.sweeps")
accept_leaves()
install_import_hook([f"planner_jax.{name}" for name in PACKAGES], "typecheck.check")

# Number of a process's memory mappings above which compiled programs, which use some mappings each,
# are released. Above Linux's default limit of 65,530 mappings, a compilation aborts the process.
MOST_MAPPINGS = 40_000


def pytest_configure(config):
    """Let XLA compile in less time, before JAX reads its flags.

    Without XLA's newer fusion emitters, tests compile in two thirds of the time, and their small
    batches run as fast. Without LLVM's optimisation, default tests compile in half of that time.
    Slow tests run for longer, and need the optimisation. Later versions of XLA may not know these
    flags and would end the process.
    """
    flags = "--xla_cpu_use_fusion_emitters=false"
    if not selects_slow(config.option.markexpr):
        flags += " --xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    if version("jaxlib") < "0.11":
        os.environ.setdefault("XLA_FLAGS", flags)


def pytest_collection_finish():
    """Collect garbage rarely, and not among imported modules, to save some 8 % of the time."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 10)


def pytest_runtest_teardown(item, nextitem):
    """Release compiled programs after a module or slow test if they use many memory mappings."""
    ends_module = nextitem is None or nextitem.path != item.path
    mappings = Path("/proc/self/maps")
    if (ends_module or item.get_closest_marker("slow")) and mappings.exists():
        if mappings.read_bytes().count(b"\n") > MOST_MAPPINGS:
            jax.clear_caches()


@pytest.fixture
def float64():
    """Let JAX compute in double precision during one test, for accurate reference values."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module", autouse=True)
def strict_arrays(request):
    """Make JAX raise an error at implicit axes or type conversions, unless slow tests run, too."""
    stem = request.path.stem.removeprefix("test_")
    options = {"jax_numpy_rank_promotion": "raise"}
    if not stem.startswith("sims_") and stem not in MIXED:
        options["jax_numpy_dtype_promotion"] = "strict"
    if selects_slow(request.config.option.markexpr):
        options = {}
    usual = {name: getattr(jax.config, name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    yield
    for name, value in usual.items():
        jax.config.update(name, value)


@pytest.fixture(scope="module")
def finished(request, tmp_path_factory):
    """Plan and judge the problems of the module's SETTINGS; return run folder and manifest."""
    from planner_jax.sweep.run import start_sweep

    out = tmp_path_factory.mktemp("runs") / "finished"
    module = request.module
    return out, start_sweep(module.TASK, module.SETTINGS, out, progress=False)


# Test modules, without "test_", of baselines, observed balls, plans that replace others, policies,
# clusters, wheels and benchmarks, which only `make test-slow` runs, or the mark `gpu`.
SLOW = (
    *("b_spline", "baselines", "bezier", "block_library", "block_peers"),
    *("hybrid_astar", "minimum_jerk", "mpp", "paper_catch", "path_smoothing"),
    *("path_then_speed", "qp", "speed", "station_time"),
    *("block_eye", "block_receding", "catch_replan", "trip_peers"),
    *("policy", "training", "learned_start"),
    *("cluster", "gpu", "wheel"),
    *("bench", "benchmark_ipopt", "intercept_gradient", "intercept_oracle"),
)
# Besides `test_sims_*`, modules in which JAX may convert types, because code of MJX, Brax or optax
# relies on conversions (see `strict_arrays`).
MIXED = (
    *("policy", "training", "stack", "speed", "bench", "live_loop", "perception"),
    *("plane_prediction", "cli", "snippets", "notebooks"),
)
# Test modules that start first, because they take longest or fill the compile cache for others:
# test_exact compiles the planner of hits, test_decide of catches, test_intercept of interceptions.
# Worker processes get whole modules in this order, so that no worker ends late, and no two compile
# the same program. The first line has the longest modules of slow tests.
FIRST = (
    *("along_curvature", "sims_flights", "notebooks", "own_task", "along", "estimation"),
    *("exact", "intercept", "decide", "task_reach", "intercept_group", "block", "contract"),
    *("sweep_intercept", "sweep_catch", "sweep", "recorded_ball", "solve", "recovery"),
    *("single_block", "live_loop", "space", "arm_kinds", "spinning_hit", "sensitivity"),
    *("sims_parts", "intercept_suites", "extras"),
)


def pytest_ignore_collect(collection_path, config):
    """Do not import modules in SLOW if the slow tests are deselected; paths named by a user are."""
    is_slow = collection_path.stem.removeprefix("test_") in SLOW
    return True if is_slow and not selects_slow(config.option.markexpr) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark tests of modules in SLOW as slow, and move tests of modules in FIRST to the front."""
    places = {f"test_{name}": place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(FIRST)))
    for item in items:
        if item.path.stem.removeprefix("test_") in SLOW:
            item.add_marker(pytest.mark.slow)

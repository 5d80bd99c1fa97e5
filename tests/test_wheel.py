"""A built wheel: its contents, and every command run from it in an empty folder.

The wheel borrows the dependencies of the tests' environment, which needs no network. `make
test-wheel` sets PLANNER_JAX_WHEEL=whole, which installs them from the package index.
"""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WHOLE = os.environ.get("PLANNER_JAX_WHEEL") == "whole"
# Without PYTHONPATH, Python imports the installed wheel instead of the repository's sources.
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

pytestmark = pytest.mark.slow


def run(*command, cwd, **environment):
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=ENVIRONMENT | environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )


def build(kind, tree, out):
    done = run(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", out, cwd=tree)
    assert done.returncode == 0, done.stderr
    (file,) = out.iterdir()
    return file


def python_files(folder):
    paths = [Path(top) / name for top, _, names in os.walk(folder) for name in names]
    kept = [path for path in paths if "__pycache__" not in path.parts]
    return {path.relative_to(folder).as_posix() for path in kept}


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    return build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Install the wheel; return the folder of its commands and the wheel's files."""
    folder = tmp_path_factory.mktemp("environment")
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    (site,) = folder.glob("lib/python*/site-packages")
    if WHOLE:
        what = [f"{wheel}[view,policies]", "--constraint", ROOT / "constraints.txt"]
    else:
        what = [wheel, "--no-deps", "--no-index"]
        (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    done = run(python, "-m", "pip", "install", "--quiet", *what, cwd=folder)
    assert done.returncode == 0, done.stderr
    (record,) = site.glob("planner_jax-*.dist-info/RECORD")
    return folder / "bin", [line.split(",")[0] for line in record.read_text().splitlines()]


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    return tmp_path_factory.mktemp("elsewhere")


def test_the_wheel_has_every_module_and_its_data_once(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    packed = [name for name in names if not name.split("/")[0].endswith(".dist-info")]
    library = python_files(ROOT / "planner_jax")
    beside = ("sims", "policies", "benchmarks")
    outside = {f"{name}/{file}" for name in beside for file in python_files(ROOT / name)}
    assert len(packed) == len(set(packed))
    assert set(packed) == {f"planner_jax/{name}" for name in library | outside}


def test_a_wheel_from_the_sdist_is_the_one_from_the_tree(sdist, wheel, tmp_path):
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (tree,) = (tmp_path / "source").iterdir()
    again = build("wheel", tree, tmp_path / "wheel")
    first, second = zipfile.ZipFile(wheel), zipfile.ZipFile(again)
    assert sorted(first.namelist()) == sorted(second.namelist())
    assert all(first.read(name) == second.read(name) for name in first.namelist())


def test_the_sdist_has_the_tests_and_nothing_of_this_machine(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tops = {name.split("/")[0] for name in names}
    files = {"README.md", "LICENSE", "CHANGELOG.md", "pyproject.toml", "PKG-INFO", ".gitignore"}
    assert tops <= files | {"planner_jax", "tests"} and "tests/test_wheel.py" in names


def test_the_wheel_owns_one_name_among_the_packages(installed):
    _, owned = installed
    tops = {name.split("/")[0] for name in owned if not name.startswith("../")}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"planner_jax"}
    assert [name for name in owned if name.startswith("../")] == ["../../../bin/planner-jax"]


# The order matters, because `report` reads the folders that `sweep` and `fly` have written.
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ("--help", "sweep"),
        ("sweep hit --help", "--planner"),
        ("sweep catch --help", "--suite"),
        ("fly catch --help", "--noise"),
        ("view --help", "--port"),
        ("bench throughput --help", "--batch"),
        ("doctor", "the referee accepts"),
        ("sweep hit --num 64 --out hits", "plans pass the referee"),
        ("sweep catch --num 64 --out catches", "plans pass the referee"),
        ("report hits", "plans pass the referee"),
        ("compare hits hits", "McNemar"),
        ("export hits --row 0 --to px4 --out hit.csv", "hit.csv"),
        ("plan hit --pos 4 0.3 1.2 --vel -7 0.2 6 --target 4 0 0 --out one", "setpoints.csv"),
        ("fly catch --num 8 --out flights", "planner-jax view flights"),
        ("report flights", "planner-jax view flights"),
        ("bench throughput --batch 64 --repeat 1", "| 64 |"),
    ],
)
def test_a_command_runs_from_the_wheel_in_an_empty_folder(installed, elsewhere, arguments, part):
    commands, _ = installed
    done = run(commands / "planner-jax", *arguments.split(), cwd=elsewhere)
    assert part in done.stdout, done.stderr
    # `doctor` may fail on this machine, for example if a GPU is present but not used.
    assert done.returncode == 0 or arguments == "doctor", done.stderr


def test_the_modules_are_those_of_the_wheel(installed, elsewhere):
    commands, _ = installed
    code = "import planner_jax, planner_jax.sims as s; print(planner_jax.__file__, s.__file__)"
    done = run(commands / "python", "-c", code, cwd=elsewhere)
    assert all(path.startswith(str(commands.parent)) for path in done.stdout.split()), done.stdout


@pytest.mark.parametrize("arguments", ["fly catch --num 1", "fly hit --num 1"])
def test_without_mjx_a_flight_names_the_extra_in_one_line(
    installed, elsewhere, tmp_path, arguments
):
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['mujoco.mjx'] = None\n")
    command = [installed[0] / "planner-jax", *arguments.split()]
    done = run(*command, cwd=elsewhere, PYTHONPATH=str(tmp_path))
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "pip install 'planner-jax[sims]'" in done.stderr

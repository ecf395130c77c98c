"""What the project promises of itself: sizes, who imports whom, dependencies, what CI runs."""
import ast
import re
import sys

import pytest

import fac_tdmpc_ref as fac
from toys import ROOT, SCRIPT as MODULE

TESTS = sorted((ROOT / "tests").glob("*.py"))
CLIENTS = sorted((ROOT / "data").glob("*.py"))


def imported(text):
    """The names of the modules that a program's text imports, wherever it does."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module)
    return {name.split(".")[0] for name in found}


def imports_of(path):
    return imported(path.read_text("utf-8"))


# sizes --------------------------------------------------------------------------------


def test_the_files_that_a_reader_reads_are_short():
    """Part I a sitting; the module no longer than it has become, on its way to 2,200."""
    text = MODULE.read_text("utf-8")
    assert text.split("# ==== Part II")[0].count("\n") <= 700
    assert text.count("\n") <= 2532
    assert (ROOT / "manipulator_demo.py").read_text("utf-8").count("\n") <= 500


# who imports whom ---------------------------------------------------------------------


def test_part_one_stands_alone():
    """It imports NumPy and the standard library, and calls of Part II only what says so."""
    first, _ = MODULE.read_text("utf-8").split("# ==== Part II")
    assert imported(first) - {*sys.stdlib_module_names} == {"numpy"}
    scope = {"__name__": "fac_tdmpc_ref"}
    exec(compile(first, "part one", "exec", dont_inherit=True), scope, scope)
    used = {node.id for node in ast.walk(ast.parse(first))
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    assert {name for name in used if name in vars(fac) and name not in scope} == {
        "check_settings"}  # which refuses what a user gives


def test_the_module_needs_no_client_and_its_dependencies_alone():
    """But gym_robot for Gymnasium's robots, and matplotlib for a picture that may be missing."""
    needed = {"numpy", "scipy", "mujoco", "dm_control", "tqdm", "threadpoolctl"}
    assert imports_of(MODULE) - {*sys.stdlib_module_names} == needed | {"gym_robot", "matplotlib"}
    listed = re.search(r"^dependencies = \[(.*?)\]$", (ROOT / "pyproject.toml").read_text(), re.M)
    names = re.findall(r'"([\w-]+)(?:==([\d.]+))?"', listed.group(1))
    assert {name.replace("-", "_") for name, _ in names} == needed
    assert ("mujoco", "3.17.0") in names and ("dm-control", "1.0.50") in names  # a pair


@pytest.mark.parametrize("path", [*CLIENTS, ROOT / "manipulator_demo.py"], ids=lambda p: p.stem)
def test_a_client_imports_no_test(path):
    assert not imports_of(path) & {test.stem for test in TESTS}


@pytest.mark.parametrize("path", TESTS, ids=lambda p: p.stem)
def test_no_test_imports_another(path):
    """What they share is in toys.py; nor does a process that one starts."""
    assert imports_of(path) & {test.stem for test in TESTS} <= {"toys"} - {path.stem}
    assert not re.search(r"^ *(from|import) test_\w+", path.read_text("utf-8"), re.M)


# the rest -----------------------------------------------------------------------------


def test_continuous_integration_runs_the_readme_s_test_command():
    """In an environment that holds nothing else: what it installs for more comes later."""
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    (at,) = [i for i, line in enumerate(lines) if line.endswith("pytest tests")]
    assert lines[at] in (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert not [line for line in lines[:at] if re.search(r"\.venv/bin/pip", line)]


def test_the_readme_s_tests_skip_what_needs_pytorch_or_dask_alone():
    """Of what libraries lack: its extra brings all others."""
    project = (ROOT / "pyproject.toml").read_text()
    brought = set(re.findall(r"[\w-]+", " ".join(re.findall(
        r"^(?:test|experiments) = \[(.*)\]$", project, re.M))))
    by = {"PIL": "matplotlib", "sklearn": "scikit-learn", "imageio_ffmpeg": "ffmpeg"}
    for path in (ROOT / "tests").glob("test_*.py"):
        for name in re.findall(r'importorskip\(\s*"(\w+)', path.read_text("utf-8")):
            assert by.get(name, name) in brought | {"torch", "distributed"}, (path, name)


def test_durations_are_of_a_clock_that_nobody_sets():
    """A checkpoint of one that was set back would count as damaged."""
    for path in (*ROOT.glob("*.py"), *(ROOT / "data").glob("*.py")):
        assert not re.search(r"\btime\.time\(|\bdatetime\b", path.read_text("utf-8")), path

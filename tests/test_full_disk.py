"""Long commands whose disk is full: one line that names the file, nothing half written is left,
and the same command goes on when there is room. A limit on the size of files is the full disk."""
import os
import subprocess
import sys

import pytest

import experiments
import fac_tdmpc_ref as fac
from toys import (ROOT, SET, SWEEP, TRAINING, distill_arguments, here, launch, student_in,
                  succeeded)

LIMITED = """
import os, resource, runpy, sys
size = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
sys.argv = sys.argv[2:]
sys.path.insert(0, os.path.dirname(sys.argv[0]))
runpy.run_path(sys.argv[0], run_name="__main__")
"""

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no limits there")


def full_disk(name, size, script, *arguments, cwd, picture=False):
    """Run a command whose files may have `size` bytes; check what it says of the file `name`, which
    may be a picture, that costs no result."""
    done = launch(["-c", LIMITED, size, ROOT / script, *arguments], cwd)
    assert done.returncode == (0 if picture else 2) and "Traceback" not in done.stderr, done.stderr
    last = done.stderr.splitlines()[-1]
    begins = f"{name}: no picture: " if picture else os.path.basename(script)
    assert last.startswith(begins) and (picture or ": error: " in last), last
    assert f"{name}: can't be written: File too large" in last
    left = [f for _, _, found in os.walk(cwd) for f in found]
    assert not any(f.startswith(".") or f.endswith(".tmp") for f in left), left


COMMAND = """
import sys
import fac_tdmpc_ref as fac
parser = fac.Parser(prog="x")
fac.add_command(parser.add_subparsers(), "x", lambda args: print("a table") or {"a": 1}, "x")
sys.exit(fac.run_command(parser))
"""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("flags", [[], ["--json"]])
@pytest.mark.parametrize("unbuffered", [[], ["-u"]])
def test_stdout(flags, unbuffered):
    env = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, *unbuffered, "-c", COMMAND, "x", *flags], cwd=ROOT,
                              stdout=full, stderr=subprocess.PIPE, text=True, env=env)
    assert done.returncode == 2
    assert done.stderr == "x: error: [Errno 28] No space left on device\n"


def test_distill(tmp_path, files, monkeypatch):
    command = distill_arguments(files)
    told = dict.fromkeys(("episodes", "eval_seed", "expert_horizon", "student_horizon", "kept"), 1)
    monkeypatch.setattr(fac, "compare", lambda *_: (told, [("",)]))
    for size in (50, 1000):
        full_disk("checkpoint.npz", size, "fac_tdmpc_ref.py", *command, "--out", "a", cwd=tmp_path)
    for out in ("a", "b"):
        succeeded(here(fac.main, *command, "--out", out, cwd=tmp_path))
    assert student_in(tmp_path / "a") == student_in(tmp_path / "b")


def test_train_expert(tmp_path):
    full_disk("checkpoint.npz", 1000, "data/train_expert.py", *TRAINING, "--out", "a", cwd=tmp_path)


def test_experiments(tmp_path):
    command = [*SWEEP, *SET]
    full_disk("sweep.csv", 20, "data/experiments.py", *command, cwd=tmp_path)
    assert experiments.read_rows(tmp_path / "sweep.csv") == []
    succeeded(here(experiments.main, *command, cwd=tmp_path))
    assert len(experiments.finished(experiments.read_rows(tmp_path / "sweep.csv"))) == 1


def test_import_expert(tmp_path, files):
    full_disk("expert.npz", 1000, "data/import_expert.py", files / "expert.npz", "--task",
              "reacher-hard", "--out", "mine", cwd=tmp_path)
    assert not (tmp_path / "mine" / "expert.npz").exists()


def test_manipulator_demo(tmp_path):
    pytest.importorskip("matplotlib")
    (tmp_path / "m.png").write_bytes(b"old")
    full_disk("m.png", 1000, "manipulator_demo.py", "--figure", "m.png", "--steps", "2",
              "--ik", "closed-form", cwd=tmp_path, picture=True)
    assert (tmp_path / "m.png").read_bytes() == b"old"

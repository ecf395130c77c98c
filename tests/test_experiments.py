"""data/experiments.py: the paper's tables as users run them, small."""
import importlib.util
import os

import numpy as np
import pytest

import experiments
import fac_tdmpc_ref as fac
from test_cli import BLOCKED, ONE_THREAD, ROOT, last_json, launch
from test_planning import random_model


def run(*arguments, cwd, env=ONE_THREAD):
    return launch([ROOT / "data" / "experiments.py", *arguments], cwd, env)


def refused(done, *parts):
    """Status 2, nothing on stdout, one line on stderr that holds `parts`."""
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("experiments.py") and ": error: " in done.stderr
    for part in parts:
        assert part in done.stderr


@pytest.mark.parametrize("flags, parts", [
    ([], ["EXPERIMENT"]),
    (["table3", "--robots", "reecher"], ["'reecher'", *experiments.ROBOTS]),
    (["table3", "--runs", "9"], ["runs", "at least 10"]),
    (["table3", "--workers", "-1"], ["--workers", "-1"]),
    (["table3", "--elites", "600"], ["samples (512)", "not 600"])])
def test_bad_commands_are_refused(tmp_path, flags, parts):
    refused(run(*flags, cwd=tmp_path), *parts)


def test_table3_refuses_a_picture_it_cannot_draw(tmp_path):
    (tmp_path / "matplotlib.py").write_text(BLOCKED)
    refused(run("table3", "--figure", "x.png", cwd=tmp_path,
                env={"PYTHONPATH": str(tmp_path), **ONE_THREAD}), "matplotlib")


def test_table3_measures_every_mode(tmp_path):
    flags = ["--robots", "reacher", "hopper", "--runs", "10", "--samples", "16", "--iterations",
             "1", "--json"]
    if importlib.util.find_spec("matplotlib"):
        flags += ["--figure", "figure6.png"]
    done = run("table3", *flags, cwd=tmp_path)
    found = last_json(done)
    assert set(found) == {"prediction", "decision", "speedup", "handover_us", "cores"}
    assert found["cores"] == fac.cores()
    assert found["cores"] == 1 or found["handover_us"] > 0  # one core: no worker by default
    modes, functions = ("one-thread", "processes", "critical-path"), ("f_T", "f_R", "f_Q")
    rows = {(r["robot"], r["model"], r["function"], r["mode"]): r for r in found["prediction"]}
    assert set(rows) == {(robot, *subject) for robot in ("reacher", "hopper") for subject in (
        *((m, f, "one-thread") for m in ("TD-MPC", "10% TD-MPC", "TAP") for f in functions),
        *(("Fac-TDMPC", f, mode) for f in functions for mode in modes))}
    assert all(r["ms_mean"] > 0 and r["ms_std"] >= 0 for r in rows.values())
    decisions = {(r["robot"], r["model"], r["preset"], r["mode"], r["samples"], r["iterations"]): r
                 for r in found["decision"]}
    assert len(decisions) == len(found["decision"]) == 2 * 2 * 4 * 3
    for r in decisions.values():
        assert np.isclose(r["ratio_to_floor"], r["ms_median"] / r["floor_ms"])
    speedup = {(r["robot"], r["function"], r["mode"]): r for r in found["speedup"]}
    assert set(speedup) == {(robot, f, mode) for robot in ("reacher", "hopper")
                            for f in (*functions, "decision") for mode in modes}
    assert round(speedup["reacher", "f_T", "critical-path"]["paper"], 1) == 4.7
    assert round(speedup["hopper", "f_T", "processes"]["paper"], 1) == 7.1
    row = speedup["hopper", "decision", "one-thread"]
    times = [decisions["hopper", m, "section51", "one-thread", 16, 1]["ms_median"]
             for m in ("TD-MPC", "Fac-TDMPC")]
    assert row["paper"] is None and np.isclose(row["value"], times[0] / times[1])
    for part in ("hopper", "critical-path", "paper's x", "16 x 1", "hand-over"):
        assert part in done.stdout
    assert os.listdir(tmp_path) == ["figure6.png"] * ("--figure" in flags)
    if "--figure" in flags:
        assert (tmp_path / "figure6.png").read_bytes()[:4] == b"\x89PNG"


def test_table3_without_workers_and_with_a_budget_of_its_own(tmp_path):
    found = last_json(run("table3", "--robots", "reacher", "reacher", "--runs", "10",
                          "--samples", "128", "--iterations", "2", "--workers", "0", "--json",
                          cwd=tmp_path))
    assert found["handover_us"] is None
    assert len(found["prediction"]) == 18 and len(found["decision"]) == 2 * 4


def test_multiply_adds_count_the_weights_of_equation_2():
    model = random_model(3)
    sizes = {name: sum(v.size for k, v in model.params.items() if k.startswith(name)
                       and k.endswith("weight") and v.shape[2] > 1)
             for name in ("_dynamics", "_reward", "_Q")}
    config = fac.PlannerConfig(samples=7, iterations=2, horizon=3)
    assert experiments.multiply_adds(model.config, config) == 7 * 2 * (
        3 * (sizes["_dynamics"] + sizes["_reward"]) + sizes["_Q"])


# watch --------------------------------------------------------------------------------


def test_shares_are_each_agent_s_own():
    """An agent alone plans and gains the same (Proposition 1), and more than nothing."""
    model, config = random_model(), fac.PlannerConfig(samples=64, horizon=2)
    z = model.encode(np.random.default_rng(0).standard_normal((8, 1), np.float32))
    found = experiments.shares(model, z, config)
    alone = [experiments.shares(model.agents(i, i + 1), z[i:i + 1], config)[0] for i in range(3)]
    assert found.shape == (3,) and (found > 0).all()
    np.testing.assert_allclose(found, alone, rtol=1e-4)


def test_frames_hold_pictures_and_bars():
    pytest.importorskip("PIL")
    size, shares = experiments.PIXELS, np.array([1.0, -0.5])
    frames = [(np.full((size, size, 3), 7, np.uint8), shares, 3.0)] * 4
    images = experiments.draw_frames([(frames, "expert, N = 2", 1.0), (frames, "student", 2.0)])
    width = size + experiments.BARS
    assert len(images) == 4 and images[0].size == (2 * width, size + experiments.TEXT)
    for left in (0, width):
        assert images[0].getpixel((left + 5, 5)) == (7, 7, 7)
        middle = left + size + experiments.BARS // 2
        assert images[0].getpixel((middle + 8, size // 4)) == (31, 119, 180)  # a gain, blue
        assert images[0].getpixel((middle - 8, 3 * size // 4)) == (153, 153, 153)
        assert images[0].getpixel((middle - 8, size // 4)) == (255, 255, 255)


def test_watch_writes_a_moving_picture(tmp_path):
    image = pytest.importorskip("PIL.Image")
    expert = fac.data_file("reacher-easy", "expert.npz")
    done = run("watch", "--model", expert, "--beside", expert, "--decisions", "4", "--out", "x.gif",
               "--json", cwd=tmp_path)
    if "can't draw off-screen" in done.stderr:
        pytest.skip("neither EGL nor OSMesa here")
    result = last_json(done)
    assert result["frames"] == 2 and result["returns"][0] == result["returns"][1]
    with image.open(tmp_path / "x.gif") as found:
        assert found.n_frames == 2 and result["bytes"] == (tmp_path / "x.gif").stat().st_size


@pytest.mark.parametrize("flags, parts", [
    (["--model", "none.npz", "--out", "x.gif"], ["none.npz", "no such file"]),
    (["--model", "none.npz", "--out", "x.png"], ["x.png", ".gif"])])
def test_watch_refuses(tmp_path, flags, parts):
    pytest.importorskip("matplotlib")
    refused(run("watch", *flags, cwd=tmp_path), *parts)

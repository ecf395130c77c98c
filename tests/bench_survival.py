"""What survives: `python tests/bench_survival.py [--kills 100] [--plans 1000000] [--json]`.

1. A chain of distillations, each killed (SIGKILL) at a random moment and started again, against
   one that nobody disturbs: the same bytes of weights? Its clock runs 60 times as fast, so that
   checkpoints come twice a second.
2. A planning worker that is killed in the middle of a plan, again and again: seconds until the
   error, and what is left in /dev/shm and among the processes.
3. Many plans of a small model: memory before and after.
"""
import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac
from toys import ONE_THREAD, ROOT, TINY, random_model, write_expert, write_replay

FAST_CLOCK = ("import sys, time; clock = time.monotonic; time.monotonic = lambda: 60 * clock(); "
              f"sys.path.insert(0, {str(ROOT)!r}); import fac_tdmpc_ref; "
              "sys.exit(fac_tdmpc_ref.main(sys.argv[1:]))")


def start(folder, out, steps):
    """A distillation of a tiny expert in a process of its own."""
    command = [sys.executable, "-c", FAST_CLOCK, "distill", "--expert", folder, *TINY, "--steps",
               str(steps), "--out", folder / out]
    return subprocess.Popen(list(map(str, command)), env={**os.environ, **ONE_THREAD},
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def killed_distillation(folder, kills, steps):
    """Kills at random moments; how often there was progress between two; whether weights agree."""
    rng, stages = np.random.default_rng(0), [0]
    write_expert(folder / "expert.npz")
    write_replay(folder / "replay.npz")
    assert start(folder, "whole", steps).wait() == 0
    for _ in range(kills):
        process = start(folder, "parts", steps)
        time.sleep(rng.uniform(0, 4))
        if process.poll() is not None:
            break
        process.kill()
        process.wait()
        checkpoint = folder / "parts" / "checkpoint.npz"
        stages.append(int(np.load(checkpoint)["step"]) if checkpoint.exists() else 0)
    assert start(folder, "parts", steps).wait() == 0
    same = [fac.load_model(folder / out / "student.npz")[0].params for out in ("whole", "parts")]
    return {"kills": len(stages) - 1, "stages": len(set(stages)), "last_stage": stages[-1],
            "steps": steps,
            "same_bytes": all(v.tobytes() == same[1][k].tobytes() for k, v in same[0].items()),
            "left": sorted(p.name for p in (folder / "parts").iterdir())}


def children():
    """This process's children, zombies among them."""
    pids = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return {pid for pid in pids
            if "resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_text()}


def killed_worker(kills):
    """Seconds from a worker's death in the middle of a plan to the error; what is left after."""
    model, seconds, rng = random_model(), [], np.random.default_rng(0)
    config = fac.PlannerConfig(samples=512)
    shared, before = set(os.listdir("/dev/shm")), children()
    for _ in range(kills):
        with fac.Planner(model, config, workers=1) as planner:
            planner.act(np.zeros(8))
            pid, died = planner._workers._members[0][0].pid, []

            def kill(pid=pid, died=died):
                died.append(time.perf_counter())
                os.kill(pid, signal.SIGKILL)

            threading.Timer(rng.uniform(0, 0.05), kill).start()
            try:
                while True:
                    planner.act(np.zeros(8))
            except fac.WorkerError:
                seconds.append(time.perf_counter() - died[0])
    return {"kills": kills, "seconds_median": float(np.median(seconds)),
            "seconds_max": float(np.max(seconds)),
            "left_in_shm": len(set(os.listdir("/dev/shm")) - shared),
            "processes_left": len(children() - before)}


def memory():
    """Resident memory, MiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def many_plans(plans):
    """Memory after the first hundredth of the plans and after all."""
    model = random_model(latent=2, hidden=4)
    config = fac.PlannerConfig(samples=4, iterations=1, horizon=1)
    with fac.one_thread(), fac.Planner(model, config) as planner, \
            fac.progress("plans", plans, "plan") as bar:
        for i in range(plans):
            planner.act(np.zeros(8, np.float32))
            if i == plans // 100:
                before = memory()
            if i % 1000 == 0:
                bar.update(1000)
    return {"plans": plans, "mib_before": round(before, 1), "mib_after": round(memory(), 1)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=100, help="of a run, and of workers [100]")
    parser.add_argument("--steps", type=int, default=20_000, help="of the killed run [20000]")
    parser.add_argument("--plans", type=int, default=1_000_000, help="[1000000]")
    parser.add_argument("--json", action="store_true", help="print one JSON object as last line")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = {"distill": killed_distillation(Path(folder), args.kills, args.steps)}
    result.update(worker=killed_worker(args.kills), memory=many_plans(args.plans))
    for name, found in result.items():
        print(name, found)
    if args.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()

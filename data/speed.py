"""Table 3 and Figure 6: milliseconds of the networks and of whole decisions, fresh weights.

`experiments.py table3` runs it, or `figure6`. Speed doesn't depend on what a model has learned.
"""
import contextlib
import dataclasses
import functools
import itertools
import pickle
import platform
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac
import plots
from tables import record

# robot: dim O, dim A (Figure 3), milliseconds of f_T, f_R, f_Q in TD-MPC and in Fac-TDMPC (Table 3)
ROBOTS = {
    "reacher": (8, 3, (5.83, 5.32, 11.73), (1.25, 1.02, 2.56)),
    "hopper": (15, 4, (5.86, 5.34, 11.70), (0.83, 0.65, 1.71)),
    "fish": (24, 5, (5.83, 5.26, 11.56), (0.77, 0.57, 1.53)),
    "cheetah": (17, 6, (5.63, 5.06, 11.35), (0.75, 0.49, 1.34)),
    "walker": (24, 6, (5.86, 5.28, 11.71), (0.72, 0.48, 1.32)),
    "quadruped": (78, 12, (5.96, 5.34, 11.86), (0.63, 0.49, 0.96)),
    "humanoid": (67, 21, (5.83, 5.25, 11.71), (0.42, 0.32, 0.69)),
}
FUNCTIONS = {"f_T": ("_dynamics",), "f_R": ("_reward",), "f_Q": ("_Q1", "_Q2")}
TABLE3_BATCH = 512
MODES = ("one-thread", "processes", "critical-path")


def processor():
    """The processor's name, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


TIMED = "processor", "cores", "blas", "what"  # heads of what times are of


def machine():
    """The first three of TIMED."""
    kernels = {f"{pool['internal_api']} {pool.get('architecture', '')}".strip()
               for pool in fac._thread_pools().info() if pool["user_api"] == "blas"}
    return processor(), str(fac.cores()), ", ".join(sorted(kernels))


class Predictor(fac.Workers):
    """f_T, f_R and f_Q alone, on fixed inputs: predictor("f_T").

    workers: processes beside this one that share the agents; their inputs are there already.
    """

    def __init__(self, model, workers=0):
        mine, *theirs = fac.split_agents(model.config.num_agents, workers)
        self.model = fac.some_agents(model, mine.start, mine.stop)
        sizes = self.model.config
        self._x = np.random.default_rng(0).standard_normal(
            (sizes.num_agents, sizes.latent_dim + sizes.agent_actions, TABLE3_BATCH), fac.F32)
        super().__init__(_prediction_worker, workers, "prediction worker")
        self.send_all(fac.some_agents(model, share.start, share.stop) for share in theirs)

    def __call__(self, function):
        self.send_all(itertools.repeat(function))
        for name in FUNCTIONS[function]:
            self.model.forward(name, self._x)
        self.receive_all()


def useful_workers(agents):
    """As many processes beside this one as there are cores and agents for."""
    return min(agents, fac.cores()) - 1


def _prediction_worker(connection):
    predict, done = Predictor(connection.recv()), pickle.dumps(None)
    while True:
        predict(connection.recv())
        connection.send_bytes(done)


def multiply_adds(config, planner):
    """Multiply-adds of a decision's networks, as Equation 2 reads (none saved)."""
    cost = {name: agents * sum(a * b for a, b in zip(widths, widths[1:]))
            for name, agents, widths in fac.networks(config)}
    step, value = cost["_dynamics"] + cost["_reward"], cost["_Q1"] + cost["_Q2"]
    return planner.samples * planner.iterations * (planner.horizon * step + value)


def benchmark_prediction(robot, workers, runs):
    """Table 3 for one robot: rows of robot, model, function, mode, ms_mean, ms_std."""
    _, n, *_ = ROBOTS[robot]
    factored = random_model(robot, n, 512 // n, 512 // n)
    with contextlib.ExitStack() as stack:
        def predictor(*args):
            return stack.enter_context(Predictor(*args))

        subjects = [("TD-MPC", "one-thread", predictor(random_model(robot, 1, 512, 512))),
                    ("10% TD-MPC", "one-thread", predictor(random_model(robot, 1, 512, 66))),
                    ("TAP", "one-thread", predictor(random_model(robot, 1, 512, 512, 2))),
                    ("Fac-TDMPC", "one-thread", predictor(factored)),
                    ("Fac-TDMPC", "processes", predictor(factored, workers)),
                    ("Fac-TDMPC", "critical-path", predictor(fac.some_agents(factored, 0, 1)))]
        calls = [(model, mode, f, functools.partial(predict, f))
                 for model, mode, predict in subjects for f in FUNCTIONS]
        seconds = fac.interleaved_seconds([call[-1] for call in calls], runs,
                                          f"{robot}: networks")
    return [{"robot": robot, "model": model, "function": f, "mode": mode,
             "ms_mean": 1e3 * float(s.mean()), "ms_std": 1e3 * float(s.std())}
            for (model, mode, f, _), s in zip(calls, seconds.T)]


def benchmark_decisions(robot, workers, planning, rounds):
    """Whole decisions for one robot: rows of robot, model, preset, mode, samples, iterations,
    ms_median, floor_ms, ratio_to_floor; and the microseconds of a hand-over to the workers."""
    _, n, *_ = ROBOTS[robot]
    obs = np.random.default_rng(0).standard_normal(ROBOTS[robot][0], fac.F32)
    budgets = [planning]
    if planning.samples != 128:  # Figure 7
        budgets.append(dataclasses.replace(planning, samples=128, elites=0))
    if planning.iterations != 2:
        budgets.append(dataclasses.replace(planning, iterations=2))
    presets = {"table2": ((50, 512), (50, max(512 // n, 50))),
               "section51": ((512, 512), (512 // n, 512 // n))}
    subjects, matrix = [], np.ones((512, 512), fac.F32)  # whose square is the machine's rate
    with contextlib.ExitStack() as stack:
        def planner(model, config, workers=0):
            return stack.enter_context(fac.Planner(model, config, workers=workers))

        for preset, (central, factored) in presets.items():
            central, factored = random_model(robot, 1, *central), random_model(robot, n, *factored)
            for config in budgets:
                parallel = planner(factored, config, workers)
                subjects += [
                    ("TD-MPC", preset, "one-thread", central, config, planner(central, config).act),
                    ("Fac-TDMPC", preset, "one-thread", factored, config,
                     planner(factored, config).act),
                    ("Fac-TDMPC", preset, "processes", factored, config, parallel.act),
                    ("Fac-TDMPC", preset, "critical-path", fac.some_agents(factored, 0, 1), config,
                     one_agent(factored, config))]
        seconds = fac.interleaved_seconds(
            [lambda: matrix @ matrix, *(functools.partial(subject[-1], obs)
                                        for subject in subjects)], rounds, f"{robot}: decisions")
        echo = stack.enter_context(fac.Workers(_echo_worker, workers, "echo worker"))
        hand_over = fac.interleaved_seconds([functools.partial(wake, echo)], 200,
                                            f"{robot}: hand-over")
    multiply_add = float(np.median(seconds[:, 0])) / 512 ** 3
    rows = []
    for (model, preset, mode, measured, config, _), s in zip(subjects, seconds.T[1:]):
        ms = 1e3 * float(np.median(s))
        floor = 1e3 * multiply_add * multiply_adds(measured.config, config)
        rows.append({"robot": robot, "model": model, "preset": preset, "mode": mode,
                     "samples": config.samples, "iterations": config.iterations,
                     "ms_median": ms, "floor_ms": floor, "ratio_to_floor": ms / floor})
    return rows, 1e6 * float(np.median(hand_over)) if workers else None


def wake(workers):
    """Wake all workers and wait for their answers, without planning: what a plan pays."""
    workers.send_all(itertools.repeat(None))
    workers.receive_all()


def _echo_worker(connection):
    while True:
        connection.send(connection.recv())


def one_agent(model, config):
    """A decision's critical path: the encoder, then the plan of one agent (all are of one size)."""
    alone = fac.FastPlanner(fac.some_agents(model, 0, 1), config)
    alone.reset(np.random.SeedSequence(0).spawn(1))
    return lambda obs: alone.plan(model.encode(obs[:, None])[:1])


def random_model(robot, num_agents, latent_dim, mlp_dim, dim_action=None):
    """A model of a robot's dimensions with fresh weights."""
    dim_obs, actions, *_ = ROBOTS[robot]
    sizes = fac.ModelConfig(dim_obs, dim_action or actions, num_agents, latent_dim, 256, mlp_dim)
    return fac.WorldModel.create(sizes, np.random.default_rng(0))


def speedups(prediction, decision, planning):
    """TD-MPC's time over Fac-TDMPC's: rows of robot, function, mode, value, paper (Table 3)."""
    ms = {(r["robot"], r["function"], r["model"], r["mode"]): r["ms_mean"] for r in prediction}
    ms.update({(r["robot"], "decision", r["model"], r["mode"]): r["ms_median"] for r in decision
               if (r["preset"], r["samples"], r["iterations"]) ==
               ("section51", planning.samples, planning.iterations)})
    paper = {(robot, f): central / factored for robot, (_, _, *times) in ROBOTS.items()
             for f, central, factored in zip(FUNCTIONS, *times)}
    return [{"robot": robot, "function": f, "mode": mode,
             "value": value / ms[robot, f, "Fac-TDMPC", mode], "paper": paper.get((robot, f))}
            for (robot, f, model, _), value in ms.items() if model == "TD-MPC" for mode in MODES]


def command_table3(args):
    """table3: the networks and whole decisions on this machine."""
    planning = fac.from_args(fac.PlannerConfig, args,
                             **fac.preset_values(fac.PlannerConfig, "paper"))
    fac.need(planning.iterations, "--iterations: expected at least 1, found 0")
    args.robots = list(dict.fromkeys(args.robots))
    if args.command == "figure6":
        args.figure = args.figure or fac.DATA / "figures" / "figure6.png"
    if args.figure:
        plots.pyplot_for(args.figure)
    prediction, decision, hand_overs = [], [], []
    for robot in args.robots:
        agents = ROBOTS[robot][1]
        workers = (useful_workers(agents) if args.workers is None
                   else min(args.workers, agents - 1))
        prediction += benchmark_prediction(robot, workers, args.runs)
        rows, hand_over = benchmark_decisions(robot, workers, planning, args.runs // 10)
        decision += rows
        hand_overs += [hand_over] * (hand_over is not None)
    result = {"prediction": prediction, "decision": decision,
              "speedup": speedups(prediction, decision, planning),
              "handover_us": float(np.median(hand_overs)) if hand_overs else None,
              "cores": fac.cores()}
    print_benchmark(result, args.robots)
    if args.record:
        record(args.record, (*TIMED, "ms"), [
            (*machine(), "{robot}, {model}, {preset}, {samples} x {iterations}, {mode}".format_map(
                row), row["ms_median"]) for row in decision])
    if args.figure:
        plots.drawn(draw_prediction, args.figure, prediction, args.robots)
    return result


def print_benchmark(result, robots):
    """Table 3, the speed-ups beside the paper's, and the decisions."""
    times = {(r["robot"], r["function"], r["model"], r["mode"]):
             f"{r['ms_mean']:.2f} ± {r['ms_std']:.2f}" for r in result["prediction"]}
    ratio = {(r["robot"], r["function"], r["mode"]): r for r in result["speedup"]}
    columns = [(m, "one-thread") for m in ("TD-MPC", "10% TD-MPC", "TAP", "Fac-TDMPC")]
    columns += [("Fac-TDMPC", mode) for mode in MODES[1:]]
    print(f"\nPrediction, ms, batch {TABLE3_BATCH}, mean ± sd of timings; x: TD-MPC's time over "
          f"Fac-TDMPC's, one thread / processes / one agent alone (paper: N threads), both of "
          f"section 5.1's sizes (layers and latents 512 wide, agents' 512 // N), which experts and "
          f"students that are shipped don't have; TAP: TD-MPC's networks on two latent actions\n")
    heads = [m if mode == "one-thread" else mode for m, mode in columns]
    fac.print_table([("", "", *heads, "x", "paper's x")] + [
        (robot, f, *(times[(robot, f, *column)] for column in columns),
         " / ".join(f"{ratio[robot, f, mode]['value']:.1f}" for mode in MODES),
         f"{ratio[robot, f, 'one-thread']['paper']:.1f}") for robot in robots for f in FUNCTIONS])
    print("\nOne decision, ms, median (times the GEMM floor)\n")
    rows = {}
    for r in result["decision"]:
        key = r["robot"], r["preset"], f"{r['samples']} x {r['iterations']}"
        rows.setdefault(key, []).append((r["ms_median"], r["ratio_to_floor"]))
    fac.print_table([("", "sizes", "budget", "TD-MPC", "Fac-TDMPC", *MODES[1:], "x")] + [
        (*key, *(f"{ms:.2f} ({times_floor:.2f})" for ms, times_floor in cells),
         " / ".join(f"{cells[0][0] / ms:.1f}" for ms, _ in cells[1:]))
        for key, cells in rows.items()])
    us = result["handover_us"]
    print("\nno workers" if us is None else f"\na hand-over to the workers and back: {us:.0f} us",
          f"{result['cores']} cores", sep="; ")


def draw_prediction(path, prediction, robots):
    """Figure 6: prediction times as bars, logarithmic."""
    subjects = list(dict.fromkeys((r["model"], r["mode"]) for r in prediction))
    figure, axes = plots.pyplot().subplots(3, 1, figsize=(10, 8), layout="constrained",
                                           sharex=True)
    for ax, function in zip(axes, FUNCTIONS):
        for i, (model, mode) in enumerate(subjects):
            rows = [r for r in prediction if (r["function"], r["model"], r["mode"]) ==
                    (function, model, mode)]
            ax.bar(np.arange(len(robots)) + (i - 2.5) * 0.14, [r["ms_mean"] for r in rows], 0.13,
                   yerr=[r["ms_std"] for r in rows], label=f"{model}, {mode}")
        ax.set(yscale="log", ylabel=f"${function}$, ms")
        ax.grid(False, axis="x")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    axes[-1].set_xticks(range(len(robots)), [f"{r}\nN = {ROBOTS[r][1]}" for r in robots])
    plots.save_figure(path, figure)


def add_commands(commands):
    """The sub-command's arguments."""
    sub = fac.add_command(
        commands, "table3", command_table3, "Planning speed: Table 3 (the networks) and whole "
        "decisions, centralized and factored, in one process and in several.",
        epilog="Weights are fresh, without a policy. Keep the machine quiet, read ratios.",
        aliases=["figure6"])
    sub.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS, metavar="ROBOT",
                     help="some of: " + ", ".join(ROBOTS) + " [all]")
    sub.add_argument("--workers", type=fac.natural, help="beside this process [as many as help]")
    sub.add_argument("--runs", type=functools.partial(fac.natural, least=10), default=100,
                     help="timings; of decisions a tenth [100]")
    sub.add_argument("--figure", help="draw it into this file [figure6: data/figures/figure6.png]")
    sub.add_argument("--record", metavar="CSV", help="keep the milliseconds of decisions there, in "
                     "place of this machine's earlier ones [none]")
    fac.add_config(sub, fac.PlannerConfig, skip=("pi_trajs", "action_repeat"),
                   **fac.preset_values(fac.PlannerConfig, "paper"))

"""Runs, many at a time, each only once: how experiments.py and multitask.py make their CSVs.

A run is a task, a seed, a case and settings, of which a function makes rows. These go to a CSV,
which one command has at a time, as runs end; the same command again makes those that are missing.
"""
import contextlib
import csv
import ctypes
import importlib.util
import io
import json
import multiprocessing
import operator
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

import fac_tdmpc_ref as fac

# ------------------------------------------------------------------------------ rows in a CSV

KEY = ("task", "seed", "case", "settings")  # what a run is; the rest is what it found
key_of = operator.itemgetter(*KEY)  # what a run, or any of its rows, is known by
NUMBERS = ("step", "return_mean", "return_std", "return_min", "expert_mean", "rank_q",
           "rank_return", "ms", "ms_workers", "minutes", "evaluation_seed")
LISTS = ("returns", "expert_returns", "policy_returns", "ranks")  # JSON; returns by episode
ROW = (*KEY, *NUMBERS, *LISTS, "versions", "error")


def make_run(task, seed, case, **settings):
    """A run as its rows begin: settings, of which None means not set, as JSON. It is known by what
    is set and, in `data`, by what it is made from."""
    settings = {k: v for k, v in settings.items() if v is not None}
    return {"task": task, "seed": str(seed), "case": case,
            "settings": json.dumps(settings, sort_keys=True)}


def unique(runs):
    """Each run once, in their order: a task, a seed or a value may be named twice."""
    return list({key_of(run): run for run in runs}.values())


def read_rows(path):
    """A CSV's rows, dicts of strings; without a line that a kill cut off."""
    text = Path(path).read_text("utf-8", "replace") if Path(path).exists() else ""
    head, *lines = text.splitlines() or [""]
    columns = ",".join(ROW)  # of which a kill may have left a part
    fac.need(head == columns or "\n" not in text and columns.startswith(head),
             f"{path}: expected the columns {columns}, found {head[:200]!r}; choose another --out")
    rows = []
    for line in lines:
        try:
            row = dict(zip(ROW, cells := next(csv.reader([line]), [])))
            if len(cells) == len(ROW):  # a kill cuts one line alone
                numbers = [float(row[key] or 0) for key in NUMBERS]
                fac.need(np.isfinite(numbers).all() and json.loads(row["settings"]).items, "")
                fac.need(all(isinstance(json.loads(row[key]), dict if key == "ranks" else list)
                             for key in LISTS if row[key]), "")
                rows.append(row)
        except (ValueError, TypeError, AttributeError, RecursionError, csv.Error, fac.UserError):
            raise fac.UserError(f"{path}: expected numbers from {ROW[4]} on, settings and lists as "
                                f"JSON, found {line[:200]}; delete the line") from None
    return rows


def append_rows(path, rows):
    """Add a run's rows to a CSV in one write."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ROW, lineterminator="\n")
    try:
        with open(path, "a+b") as file:
            file.seek(0)
            before = file.read()
            if b"\n" not in before:
                file.truncate(0)
                writer.writeheader()
            elif not before.endswith(b"\n"):
                text.write("\n")  # ends a line that was cut off
            writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else json.dumps(v) if
                              k in LISTS else v for k, v in row.items()} for row in rows)
            file.write(text.getvalue().encode())
    except OSError as error:
        raise fac.UserError(f"{path}: can't be written: {error.strerror}; the same command makes "
                            "what is missing") from None


def write_rows(path, rows):
    """Replace a CSV by these rows, which were read from it."""
    with fac.atomic_file(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ROW, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def lock(path):
    """`fac.locked` for a CSV, which is made."""
    fac.check_writable(path)
    path.touch()
    return fac.locked(path, folder=False)


def finished(rows):
    """Rows of runs that came to their end, by run: {(task, seed, case, settings): rows}."""
    runs = {}
    for row in rows:
        runs.setdefault(key_of(row), []).append(row)
    return {key: found for key, found in runs.items() if any(row["minutes"] for row in found)}


def versions():
    """`fac.software`, as a row holds it."""
    found = fac.software()
    return ", ".join(f"{name} {found[name]}" for name in ("numpy", "mujoco", "fac-tdmpc-ref"))


# ---------------------------------------------------------------------- runs, many at a time

def attempt(function, run):
    """A run's rows; one that fails is a row with its error."""
    began = time.monotonic()
    with fac.one_thread(), contextlib.redirect_stdout(sys.stderr):
        try:
            found = list(function(run["task"], int(run["seed"]), run["case"],
                                  json.loads(run["settings"])))
            fac.need(all(np.isfinite(v) for row in found for v in row.values()
                         if isinstance(v, float)), f"found {found[-1]}, not finite")
            found[-1].setdefault("minutes", (time.monotonic() - began) / 60)
        except Exception as error:
            return failed(run, error)
    return [{**run, **row, "versions": versions()} for row in found]


def failed(run, error):
    """The rows of a run that ended so."""
    return [{**run, "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}]


def in_process(function, run):
    """`attempt` in a process of its own, so that one that dies takes no other run with it."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), begin,
                             (os.getpid(),)) as pool:
        return pool.submit(attempt, function, run).result()


def begin(parent):
    """In a run's process: it shows no bars, and ends with the one that waits for it."""
    os.environ["TQDM_DISABLE"] = "1"
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
    if os.getppid() != parent:  # it has ended already
        os._exit(1)


def in_processes(function, runs, jobs):
    """Rows of each run as it ends, in so many processes here."""
    pool = ThreadPoolExecutor(max(1, jobs))
    try:
        yield from as_they_end({pool.submit(in_process, function, run): run for run in runs})
    finally:  # also where what waits for rows is interrupted
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()


def on_cluster(function, runs, client):
    """Rows of each run as it ends on a dask cluster."""
    with client, client.get_executor(pure=False) as pool:
        yield from as_they_end({pool.submit(attempt, function, run): run for run in runs})


def as_they_end(futures):
    """Rows of {future: run}."""
    for future in as_completed(futures):
        fac.need(not future.cancelled(), "the connection to the scheduler is lost; the same "
                 "command makes what is missing")
        error = future.exception()
        yield failed(futures[future], error) if error else future.result()


def connect(address):
    """A dask cluster's client; UserError if there is none, or it lacks what runs need."""
    with fac.optional("dask", "cluster"):
        from dask.distributed import Client
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, TypeError) as error:
        raise fac.UserError(f"--scheduler {address}: {error}") from None
    known = importlib.util.find_spec, "baselines"
    fac.need(all([client.run_on_scheduler(*known), *client.run(*known).values()]),
             f"--scheduler {address}: it or a worker lacks data/ on its PYTHONPATH")
    return client


def make_all(path, function, runs, jobs, scheduler=None):
    """function(task, seed, case, settings), rows, of all runs that the CSV doesn't hold; result."""
    errors, runs = [], unique(runs)
    client = connect(scheduler) if scheduler else None
    with lock(path):
        done = finished(read_rows(path))  # by whoever had it before, too
        todo = [run for run in runs if key_of(run) not in done]
        ended = on_cluster(function, todo, client) if client else in_processes(function, todo, jobs)
        append_rows(path, [])  # its head: what can't be written is missed now
        with fac.progress(path.stem, len(runs), "run", len(runs) - len(todo)) as bar:
            for rows in ended:
                append_rows(path, rows)
                errors += [row["error"] for row in rows if row.get("error")]
                bar.update()
    for error in errors:
        print(f"failed: {error}", file=sys.stderr)
    print(f"{path}: {len(runs)} runs, {len(todo)} of them now, {len(errors)} failed")
    return {"out": str(path), "runs": len(runs), "now": len(todo), "failed": len(errors)}

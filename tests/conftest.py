import os

for library in ("OPENBLAS", "OMP"):  # products are small, t-SNE's threads spin: more only wait
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import pytest  # noqa: E402

from toys import BLOCKED, ONE_THREAD, fac, write_expert, write_replay  # noqa: E402

SKIPPED = []  # tests, and files of them, of this run
QUICK = {f"test_{name}" for name in (
    "layers", "planning", "priors", "distill", "equation1", "data", "students", "project")}
SLOW = ("worker", "process", "hang", "parent", "learns_the_experts_order", "keeps_its_memory",
        "taught_priors", "damage_anywhere", "plain_step")  # of these, in their names


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, default=250, help="mutated files of each kind [250]")
    parser.addoption("--skipped", action="store_true", help="only what the last run skipped")


def pytest_collectreport(report):
    if report.skipped:
        SKIPPED.append(report.nodeid)


pytest_runtest_logreport = pytest_collectreport


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(config, items):
    for item in items:
        if item.path.stem in QUICK and not any(word in item.name for word in SLOW):
            item.add_marker("quick")
    if config.getoption("skipped"):
        before = tuple(config.cache.get("skipped", []))
        items[:] = [item for item in items if item.nodeid.startswith(before)]


def pytest_sessionfinish(session):
    if not hasattr(session.config, "workerinput"):  # pytest-xdist's processes tell the first
        session.config.cache.set("skipped", SKIPPED)


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """A folder with an expert, a replay and things that are neither."""
    folder = tmp_path_factory.mktemp("files")
    write_expert(folder / "expert.npz")
    write_expert(folder / "other.npz", seed=1)
    write_expert(folder / "wider.npz", latent=7)
    write_expert(folder / "spoilt.npz")
    (folder / "spoilt.json").write_text('{"x": 3}')
    write_replay(folder / "replay.npz")
    write_replay(folder / "walker.npz", (24, 6))
    write_replay(folder / "longer.npz", (8, 3), 3, 60)  # the same rows, other ends
    write_replay(folder / "named.npz", task="reacher-hard")
    (folder / "corrupt.npz").write_bytes((folder / "expert.npz").read_bytes()[:3000])
    return folder


@pytest.fixture(scope="session")
def no_plots(tmp_path_factory):
    """Settings under which matplotlib can't be imported; runs end sooner without it, too."""
    folder = tmp_path_factory.mktemp("blocked")
    (folder / "matplotlib.py").write_text(BLOCKED)
    return {"PYTHONPATH": str(folder), **ONE_THREAD}


@pytest.fixture
def short_episodes(monkeypatch):
    """Of 50 decisions, those that this process plays."""
    monkeypatch.setattr(fac, "CONTROL_STEPS", 100)


@pytest.fixture(scope="session")
def replay(tmp_path_factory):
    """24 episodes of 30 decisions."""
    return fac.Replay(write_replay(tmp_path_factory.mktemp("replay") / "replay.npz", (8, 3), 24, 31,
                                   0))

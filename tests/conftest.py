import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small products; more threads only wait
SKIPPED = []  # tests, and files of them, of this run


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, default=250, help="mutated files of each kind [250]")
    parser.addoption("--skipped", action="store_true", help="only what the last run skipped")


def pytest_collectreport(report):
    if report.skipped:
        SKIPPED.append(report.nodeid)


pytest_runtest_logreport = pytest_collectreport


def pytest_collection_modifyitems(config, items):
    if config.getoption("skipped"):
        before = tuple(config.cache.get("skipped", []))
        items[:] = [item for item in items if item.nodeid.startswith(before)]


def pytest_sessionfinish(session):
    session.config.cache.set("skipped", SKIPPED)

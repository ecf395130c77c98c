import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small products; more threads only wait


def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, default=250, help="mutated files of each kind [250]")

def pytest_addoption(parser):
    parser.addoption("--fuzz", type=int, default=250, help="mutated files of each kind [250]")

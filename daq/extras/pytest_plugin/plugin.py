"""Options and fixtures of the pytest plugin. Until one of them is used, no other module of this package is imported."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from daq.extras.pytest_plugin.bench import NidaqmxBench

_session_bench = pytest.StashKey[ExitStack]()
# Names of the tasks on each bench that remain open after the test: those of fixtures of longer scope.
_benches_in_use: dict[NidaqmxBench, set[str]] = {}
_DESCRIPTION = (
    "modules such as 'NI 9234, NI 9263', a YAML file with modules, wires and sources, or a scene (default: NI 9234, "
    "NI 9263)"
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options `--nidaqmx` and `--nidaqmx-bench`."""
    group = parser.getgroup("nidaqmx", "programs for NI's package nidaqmx, without hardware")
    group.addoption("--nidaqmx", action="store_true", help="run all tests on a bench of emulated devices")
    group.addoption("--nidaqmx-bench", metavar="BENCH", help=f"bench on which --nidaqmx runs the tests: {_DESCRIPTION}")
    parser.addini("nidaqmx_bench", f"default bench: {_DESCRIPTION}")


def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Open the bench of the whole session if `--nidaqmx` is given, before any module of the tests is imported."""
    options = early_config.known_args_namespace
    if not (options.nidaqmx or options.nidaqmx_bench):
        return
    stack = early_config.stash[_session_bench] = ExitStack()
    early_config.add_cleanup(stack.close)
    try:
        stack.enter_context(_bench_in_use(_chosen_bench(early_config)))
    except Exception as error:
        stack.close()
        raise pytest.UsageError(f"--nidaqmx: {error}") from error


@pytest.hookimpl(tryfirst=True)  # type: ignore[untyped-decorator]
def pytest_runtest_setup() -> None:
    """Note the tasks that are open before the fixtures of a test are set up."""
    _benches_in_use.update({bench: set(bench.open_tasks) for bench in _benches_in_use})


@pytest.hookimpl(wrapper=True)  # type: ignore[untyped-decorator]
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Generator[None, object, object]:
    """Record the tasks that a fixture of module or session scope opens, which the end of a test must not close.

    A running test can request such a fixture, too.
    """
    before = {bench: bench.open_tasks for bench in _benches_in_use}
    result = yield
    if fixturedef.scope != "function":
        for bench, kept in _benches_in_use.items():
            kept.update(set(bench.open_tasks).difference(before.get(bench, ())))
    return result


@pytest.hookimpl(wrapper=True)  # type: ignore[untyped-decorator]
def pytest_runtest_teardown() -> Generator[None, None, None]:
    """Close the tasks that a test has left open on a bench of longer scope, and remove the faults that it injected."""
    try:
        yield
    finally:
        with ExitStack() as stack:  # resets all benches, also if one warns and warnings are errors
            for bench, kept in _benches_in_use.items():
                stack.callback(bench.reset, kept)


@pytest.fixture  # type: ignore[untyped-decorator]
def nidaqmx_bench(pytestconfig: pytest.Config) -> Iterator[Callable[..., NidaqmxBench]]:
    """Open a bench of emulated devices that every `nidaqmx.Task()` uses until the end of the test.

    `nidaqmx_bench(["NI 9234", "NI 9263"], wires=["ao0 -> ai0"])`; see `daq.extras.pytest_plugin.bench.open_bench`.
    """
    yield from _benches(pytestconfig)


@pytest.fixture(scope="session")  # type: ignore[untyped-decorator]
def nidaqmx_session_bench(pytestconfig: pytest.Config) -> Iterator[Callable[..., NidaqmxBench]]:
    """Open a bench as `nidaqmx_bench` does, until the end of the session."""
    yield from _benches(pytestconfig)


def _benches(config: pytest.Config) -> Iterator[Callable[..., NidaqmxBench]]:
    """Yield the function that opens a bench; close the benches afterwards."""
    with ExitStack() as stack:

        def open_for_test(bench: Any = None, **settings: Any) -> NidaqmxBench:
            names = "bench, wires, sources, pulses, clock"
            if unknown := settings.keys() - names.split(", "):
                raise TypeError(f"nidaqmx_bench() has no argument {', '.join(sorted(unknown))}. Choose {names}.")
            chosen = _chosen_bench(config) if bench is None else bench
            return stack.enter_context(_bench_in_use(chosen, **settings))

        yield open_for_test


def _chosen_bench(config: pytest.Config) -> Any:
    """Return the bench of the command line or of the configuration file, or the default."""
    from daq.extras.pytest_plugin.bench import DEFAULT_MODULES

    return config.known_args_namespace.nidaqmx_bench or config.getini("nidaqmx_bench") or DEFAULT_MODULES


@contextmanager
def _bench_in_use(bench: Any, **settings: Any) -> Iterator[NidaqmxBench]:
    """Open a bench, and let NI's client in this process and in its child processes use it without options."""
    from daq.extras.ni_server import client_defaults
    from daq.extras.pytest_plugin.bench import open_bench

    with open_bench(bench, **settings) as opened, pytest.MonkeyPatch.context() as patch:
        for name, value in client_defaults.environment(opened.address, opened.follows_wall_clock).items():
            patch.setenv(name, value)
        for owner, name, value in client_defaults.replacements():
            patch.setattr(owner, name, value)
        if not opened.follows_wall_clock:
            patch.setattr("time.sleep", opened.sleep)
            for owner, name, value in opened.callback_waits.replacements():
                patch.setattr(owner, name, value)
        _benches_in_use[opened] = set()
        try:
            yield opened
        finally:
            del _benches_in_use[opened]
            client_defaults.disconnect(opened.address)

"""All benchmarks in one run: `make bench`."""

import tempfile
from pathlib import Path

from tests.benchmarks import chain, command_times, compared_times, engine, orbits, recordings, scaling


def main() -> None:
    """Run all benchmarks and print their results."""
    Path("build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        benchmarks = {
            command_times: command_times.main,
            scaling: scaling.main,
            engine: engine.main,
            orbits: lambda: print(*orbits.measure(), sep="\n"),
            chain: lambda: print(*chain.measure(), sep="\n"),
            recordings: lambda: print(*recordings.measure(Path(folder), one_hour=False), sep="\n"),
            compared_times: lambda: compared_times.main(["build/bench.json"]),
        }
        for module, run in benchmarks.items():
            print(f"\n== {(module.__doc__ or '').splitlines()[0]}", flush=True)
            run()


if __name__ == "__main__":
    main()

"""All benchmarks in one run: `make bench`."""

from __future__ import annotations

import tempfile
from pathlib import Path

from tests.benchmarks import answers, chain, engine, growth, orbits, recordings, waits


def main() -> None:
    """Print them, part by part."""
    for part in (answers, growth, engine, orbits, chain, recordings, waits):
        print(f"\n== {(part.__doc__ or '').splitlines()[0]}", flush=True)
        if part in (answers, growth, engine):
            part.main()
        elif part is waits:
            Path("build").mkdir(exist_ok=True)
            waits.main(["build/bench.json"])
        elif part is orbits:
            print(*orbits.measure(), sep="\n")
        elif part is chain:
            print(*chain.measure(), sep="\n")
        else:
            with tempfile.TemporaryDirectory() as folder:
                print(*recordings.measure(Path(folder), hour=False), sep="\n")


if __name__ == "__main__":
    main()

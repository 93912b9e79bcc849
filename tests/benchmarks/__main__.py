"""All benchmarks in one run: `make bench`."""

from tests.benchmarks import chain, engine, recordings

for part in (engine, chain, recordings):
    print(f"\n== {(part.__doc__ or '').splitlines()[0]}")
    part.main()

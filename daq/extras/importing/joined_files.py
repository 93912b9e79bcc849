"""Joins files of one hammer impact each to one test.

Lost samples separate the impacts, because the time between them is unknown.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from daq.extras.importing.signal import Signal
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

#: Number of lost samples between two files.
GAP = 16


def are_repetitions(files: Sequence[Sequence[Signal]]) -> bool:
    """Return whether several files contain signals of the same names, in the same order."""
    names = [[signal.name for signal in signals] for signals in files]
    return len(files) > 1 and all(other == names[0] for other in names[1:])


def join_repetitions(files: Sequence[Sequence[Signal]]) -> list[Signal]:
    """Join the signals of the same name, one file after another.

    Raises `RecordingError` if the files differ in sample rate or unit.
    """
    gaps = [GAP] * (len(files) - 1)
    return [join(signals, gaps) for signals in zip(*files, strict=True)]


def join(signals: Sequence[Signal], gaps: Sequence[int]) -> Signal:
    """Join signals of one name; `gaps`: numbers of lost samples between them."""
    first = signals[0]
    for other in signals[1:]:
        for what, expected, stated in (("rate", first.rate, other.rate), ("unit", first.unit, other.unit)):
            if stated != expected:
                raise RecordingError(
                    f"{other.file}: the {what} of {other.name!r} is {stated or 'not stated'}, but {first.file} has "
                    f"{expected or 'none'}. Import files with a different {what} separately."
                )
    sizes = np.array([signal.samples for signal in signals])
    starts = np.cumsum([0, *(sizes[:-1] + gaps)])

    def read(start: int, stop: int) -> Array:
        values = np.full(stop - start, np.nan)
        for signal, position in zip(signals, starts.tolist(), strict=True):
            begin, end = max(start, position), min(stop, position + signal.samples)
            if begin < end:
                values[begin - start : end - start] = signal.read(begin - position, end - position)
        return values

    ends = starts + sizes
    full_scales = {signal.full_scale for signal in signals}
    return replace(
        first,
        file=", ".join(dict.fromkeys(signal.file for signal in signals)),
        samples=int(starts[-1] + sizes[-1]),
        read=read,
        full_scale=first.full_scale if len(full_scales) == 1 else None,
        separators=tuple(zip(ends[:-1].tolist(), starts[1:].tolist(), strict=True)),
    )

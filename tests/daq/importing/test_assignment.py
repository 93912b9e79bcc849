"""Columns of a channel table are assigned to the signals of files, also in wide files."""

import numpy as np
import pytest

from daq.extras.importing import assignment
from daq.extras.importing.assignment import _signals_of_column
from daq.extras.importing.channel_table import Column
from daq.extras.importing.signal import Signal


def signals(count: int) -> list[Signal]:
    return [
        Signal("a.csv", k + 1, f"Channel {k}", "V", 10, 1000.0, lambda first, stop: np.zeros(stop - first))
        for k in range(count)
    ]


def test_each_name_is_normalized_once() -> None:
    assignment._normalized.cache_clear()
    in_file = signals(300)
    for k in range(300):
        (signal,) = _signals_of_column(Column(f"channel_{k}"), in_file)
        assert signal.number == k + 1
    # A name and its last parts, and the name in the table.
    assert assignment._normalized.cache_info().misses <= 4 * 300


def test_misspelled_names_of_wide_files_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []
    monkeypatch.setattr(assignment, "suggestion", lambda name, names: compared.append(name) or "Did you mean x?")
    for count in (100, 300):
        with pytest.raises(ValueError, match="no column 'chunnel'"):
            _signals_of_column(Column("chunnel"), signals(count))
    assert len(compared) == 1

"""`analysis demo` makes recordings and figures, and prints results and further commands."""

import numpy as np
import pytest

from analysis.commands.presentation.demo import demonstrate


@pytest.mark.thorough
@pytest.mark.usefixtures("undrawn_figures")
def test_demo_makes_recordings_figures_and_commands(tmp_path):
    lines: list[str] = []
    # Three frequencies at each resonance, less than half its bandwidth apart, and one between each two resonances.
    around_resonances = [np.linspace(0.996, 1.004, 3) * f for f in (13.037, 34.777, 49.663)]
    files = demonstrate(tmp_path, lines.append, sorted([20.0, 42.0, *np.concatenate(around_resonances)]))
    assert all(path.exists() and path.stat().st_size > 0 for path in files)
    assert {path.suffix for path in files} == {".mcap", ".png", ".svg", ".csv"}
    text = "\n".join(lines)
    assert "3 modes" in text and "13.03" in text and "49.66" in text
    assert "daq replay" in text and "analysis report" in text

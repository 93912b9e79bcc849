"""Figures with logarithmic axes can be drawn for extreme numbers, and their labels do not overlap."""

import os
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from rig.core.base.figure_style import log_axis, new_figure, save_figure, save_with_table


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-310, 1e308, np.inf, np.nan])
def test_log_axis_is_drawn_for_extreme_values(value: float, tmp_path: Path) -> None:
    with new_figure(3.0) as figure:
        axes = figure.subplots()
        axes.plot([1.0, 2.0], [value, 0.5 * value])
        log_axis(axes, [np.array([value, 0.5 * value])])
        figure.savefig(tmp_path / "a.png")

    assert (tmp_path / "a.png").stat().st_size > 1000  # bytes of an image that is not empty


def test_axis_labels_do_not_overlap_tick_labels(tmp_path: Path) -> None:
    with new_figure(4.6, 10.0) as figure:
        _, right = figure.subplots(1, 2, sharey=True)
        mesh = right.pcolormesh([1.0, 2.0], [1.0, 2.0], [[1000.0]])
        bar = figure.colorbar(mesh, ax=right, label="periods", pad=0.02)
        figure.suptitle("title")
        save_figure(figure, tmp_path / "a")

        label, *tick_labels = (text.get_window_extent() for text in (bar.ax.yaxis.label, *bar.ax.get_yticklabels()))
        assert not any(label.overlaps(tick_label) for tick_label in tick_labels)


def drawn(path: Path) -> bytes:
    """Return a figure with a curve and text."""
    with new_figure(2.0) as figure:
        axes = figure.subplots()
        axes.plot([1.0, 2.0], [1.0, 3.0], label="5 % _x")
        axes.legend()
        save_figure(figure, path / "a")
    return (path / "a.png").read_bytes() + (path / "a.svg").read_bytes()


def test_user_settings_do_not_affect_figures(tmp_path: Path) -> None:
    expected = drawn(tmp_path / "own")
    with matplotlib.rc_context({"text.usetex": True, "lines.linewidth": 9.0, "axes.facecolor": "red"}):
        assert drawn(tmp_path / "user") == expected


def test_unknown_backend_does_not_prevent_figures() -> None:
    code = (
        "import os; from rig.core.base.figure_style import new_figure\n"
        "with new_figure(2.0): print(os.environ['MPLBACKEND'])"
    )
    environment = {**os.environ, "MPLBACKEND": "nonsense"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert result.stdout == "nonsense\n"


def test_failed_figure_leaves_no_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with new_figure(2.0) as figure:
        figure.subplots()
        monkeypatch.setattr(figure, "savefig", lambda *arguments, **options: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            save_with_table(figure, tmp_path / "a", [["x"], ["1"]])
    assert not list(tmp_path.iterdir())

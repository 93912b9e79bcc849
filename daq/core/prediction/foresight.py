"""The predicted test: a summary, and a table of the largest values and their limits."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.measurement.estimate import duration_text
from daq.core.prediction.linear import LowestSignalToNoise
from rig.core.base.figure_types import Axes
from rig.core.results import Result, format_number, format_percent
from rig.core.results.text import table_lines
from rig.core.scene.scene import STANDARD_GRAVITY

# The range of the duration is printed if the ratio of its ends exceeds this value.
_MIN_RANGE_RATIO = 1.1

# A maximum is transient if the largest value in steady state is below this fraction of the maximum.
_MAX_STEADY_RATIO = 0.8


@dataclass(frozen=True)
class Expectation:
    """Predicted maximum of a channel, sensor, output, amplifier or table in a test."""

    name: str
    unit: str
    largest: float  # largest value without any limits
    frequency: float | None = None  # frequency of the maximum [Hz]
    time: float | None = None  # time of the maximum from the start of the test [s]
    limit: float = np.inf  # limit in the same unit; infinite without a limit
    limited_by: str = ""  # component with this limit, such as "sensor"; empty without a limit
    overloaded: bool = False  # whether the limit is exceeded in the test
    recorded: float = np.nan  # largest reading in the recording; only for channels
    driven: float | None = None  # largest value after the power-on transient; None: equal to `largest`
    steady: float = 0.0  # largest value in the measurements of tones; 0 without such measurements

    @property
    def driven_share(self) -> float:
        """Ratio of the maximum after the power-on transient to the limit; the transient is independent of the level."""
        return self.share if self.driven is None else self.driven / self.limit

    @property
    def share(self) -> float:
        """Ratio of the maximum to the limit; 0 without a limit."""
        if not np.isfinite(self.limit):
            return 0.0
        share = self.largest / self.limit
        return max(share, 1.0) if self.overloaded else share

    @property
    def place(self) -> str:
        """Frequency or time of the maximum, as text."""
        if self.frequency is not None:
            is_transient = 0.0 < self.steady < _MAX_STEADY_RATIO * self.largest
            steady = f", transient ({format_quantity(self.steady, self.unit)} in steady state)" if is_transient else ""
            return f"{self.frequency:.4g} Hz{steady}"
        driven = "" if self.driven is None else format_quantity(self.driven, self.unit)
        cause = "" if self.driven is None else f", bias settling ({driven} in the test)"
        return "" if self.time is None else f"{self.time:.2f} s{cause}"

    def __str__(self) -> str:
        location = f" at {self.place}" if self.place else ""
        return f"{self.name}: {format_quantity(self.largest, self.unit)}{location}"


def format_quantity(magnitude: float, unit: str) -> str:
    """Format a value with its unit: accelerations in g, small values with the prefix m or µ.

    >>> format_quantity(519.8, "m/s^2"), format_quantity(0.00149, "m"), format_quantity(2.8, "N")
    ('53 g', '1.49 mm', '2.8 N')
    """
    if not np.isfinite(magnitude):
        return "beyond any limit"
    if unit == "m/s^2":
        return f"{format_number(magnitude / STANDARD_GRAVITY)} g"
    for scale, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
        if unit in ("m", "m/s", "V", "A") and (magnitude * scale >= 0.1 or prefix == "µ"):
            return f"{format_number(magnitude * scale)} {prefix}{unit}"
    return f"{format_number(magnitude)} {unit}"


@dataclass(frozen=True, repr=False)
class Foresight(Result):
    """Prediction of a test."""

    scene: str
    expectations: tuple[Expectation, ...]  # channels first, then sensors, outputs, amplifier, table
    key: str  # key of the test's level, such as test.force; "" without a level
    level: float  # highest level of the test, in `level_unit`
    largest_level: float  # largest level without overload; NaN without a limit
    level_unit: str
    limited_by: Expectation | None  # maximum that limits `largest_level`
    nonlinear: bool  # whether dampers or joints act, so `largest_level` is approximate
    aborts: str | None  # reason why the test will abort; None if it will not
    signals: dict[str, LowestSignalToNoise] = field(default_factory=dict)  # by channel name
    hidden: tuple[str, ...] = ()  # warnings about signals below the resolution or noise, and about an unresolved force
    flights: tuple[str, ...] = ()  # lines about the action of dampers and joints
    seconds: float = 0.0  # duration of the test [s]
    seconds_range: tuple[float, float] = (0.0, 0.0)  # shortest and longest probable duration [s]
    settled_sensors: float = 0.0  # time until the bias of the sensors has settled [s]; it is part of `seconds`
    disk: float = 0.0  # size of its recording [bytes]
    rehearsed: str = ""  # description of the part that was simulated (rehearsed); "" for the whole test
    outside: tuple[str, ...] = ()  # line about modes outside the band of the test
    checks: tuple[str, ...] = ()  # lines of the check of the test's controller

    @property
    def fits(self) -> bool:
        """Whether the test runs to its end without any overload."""
        return self.aborts is None and all(entry.share < 1.0 for entry in self.expectations)

    def __getitem__(self, name: str) -> Expectation:
        for entry in self.expectations:
            if entry.name == name:
                return entry
        raise KeyError(
            f"{name!r}: unknown name; expected one of {', '.join(entry.name for entry in self.expectations)}"
        )

    def summary(self) -> str:
        """Return whether the test stays within all limits, and the largest level that does."""
        worst = max(self.expectations, key=lambda entry: entry.share, default=None)
        if self.aborts is not None:
            statement = f"the test will abort: {self.aborts}"
        elif worst is None or worst.share == 0.0:
            statement = "the test stays within all limits: nothing in the scene has a limit"
        elif worst.share >= 1.0:
            others = [entry.name for entry in self.expectations if entry.share >= 1.0 and entry is not worst]
            also = f"; also over their limits: {', '.join(others)}" if others else ""
            statement = f"the test overloads {worst}; {_describe_limit(worst)}{also}"
        else:
            share = f"{format_percent(worst.share)} of its {_describe_limit(worst)}"
            statement = f"the test stays within all limits; nearest to its limit is {worst}, {share}"
        if self.limited_by is None or not np.isfinite(self.largest_level):
            return statement
        about = "about " if self.nonlinear else ""
        return (
            f"{statement}\n{self.key}: at most {about}"
            f"{format_quantity(_round_down(self.largest_level), self.level_unit)} stays within all limits "
            f"({', '.join(dict.fromkeys((self.limited_by.name, self.limited_by.limited_by)))})"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return name, unit, largest value, its frequency or time, limit, and largest recorded value."""
        rows = self.expectations
        # A missing frequency or time is NaN.
        return {
            "name": np.array([entry.name for entry in rows], dtype=np.str_),
            "unit": np.array([entry.unit for entry in rows], dtype=np.str_),
            "largest": np.array([entry.largest for entry in rows]),
            "frequency_Hz": np.array([entry.frequency for entry in rows], dtype=np.float64),
            "time_s": np.array([entry.time for entry in rows], dtype=np.float64),
            "limit": np.array([entry.limit for entry in rows]),
            "recorded": np.array([entry.recorded for entry in rows]),
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw each maximum as a share of its limit, as bars."""
        limited = [entry for entry in self.expectations if np.isfinite(entry.limit)]
        ax.barh([entry.name for entry in limited], [100.0 * entry.share for entry in limited], **style)
        ax.axvline(100.0, color="black", lw=0.8)
        ax.set(xlabel="largest value relative to its limit / %")

    def __str__(self) -> str:
        header = ("", "largest", "at", "limit", "of limit", "lowest signal-to-noise ratio")
        rows = [header]
        for entry in self.expectations:
            limit, share = "", ""
            if np.isfinite(entry.limit):
                limit = f"{entry.limited_by}, {format_quantity(entry.limit, entry.unit)}"
                share = "over" if entry.share >= 1.0 else format_percent(entry.share)
            signal = str(self.signals[entry.name]) if entry.name in self.signals else ""
            rows.append((entry.name, format_quantity(entry.largest, entry.unit), entry.place, limit, share, signal))
        about, reason = "about " if self.rehearsed else "", ""
        lines = [*self.hidden, *self.checks, *self.flights, *self.outside]
        shortest, longest = self.seconds_range
        if longest > _MIN_RANGE_RATIO * shortest > 0.0:
            about = f"{duration_text(shortest)} to {duration_text(longest)}, {about}"
            reason = " (waits with moving dampers or joints are uncertain)" if self.nonlinear else ""
        if self.settled_sensors >= 1.0:
            reason += f", of which {duration_text(self.settled_sensors)} until the bias of the sensors has settled"
        lines.append(
            f"the test takes {about}{duration_text(self.seconds)} on the bench{reason}; its recording has about "
            f"{self.disk / 1e6:.3g} MB"
        )
        if self.rehearsed:
            lines.append(f"simulated for this prediction: {self.rehearsed}")
        return "\n".join([self.summary(), *lines, "", *table_lines(rows, "<" * len(header))])


def _describe_limit(entry: Expectation) -> str:
    return f"limit {format_quantity(entry.limit, entry.unit)} ({entry.limited_by})"


def _round_down(level: float) -> float:
    """Round a level down to two digits.

    >>> _round_down(2.879), _round_down(247.0)
    (2.8, 240.0)
    """
    magnitude = 10.0 ** (np.floor(np.log10(level)) - 1)
    return float(f"{np.floor(level / magnitude * (1.0 + 1e-9)) * magnitude:.10g}")

"""Data of the page of `daq bench`, as messages for the scripts in the folder `browser`.

A message is a JSON object and the arrays that it lists, as 32-bit floats: long curves as text would take a third of a
processor at 20 messages a second.
"""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.drawing.palette import channel_color, hex_color
from daq.extras.bench_page.half_power import largest_peaks
from daq.extras.bench_page.impacts import Impact
from daq.extras.bench_page.live_bench import LiveBench
from daq.extras.bench_page.monitor import MOTION_S
from daq.extras.bench_page.rig_svg import RigDrawing
from rig.core.base.arrays import Array
from rig.core.base.errors import ShotrigError

# Interval of the refreshes of the page [s].
REFRESH_S = 0.05
# Number of refreshes of the page from one refresh of the spectra to the next.
_REFRESHES_PER_SPECTRUM = 2
# Number of refreshes of the page from one refresh of the responses and the rig to the next.
_REFRESHES_PER_RESPONSE = 10
# Duration of the animation [s]. It shows the last `MOTION_S` seconds in slow motion.
_ANIMATION_S = 2.0
_REFRESHES_PER_ANIMATION = round(_ANIMATION_S / REFRESH_S)
# Minimum number of columns of a time history; each shows the minimum and the maximum in it, so no peak is lost.
_HISTORY_COLUMNS = 300
# Frequency bands of a drawn spectrum, about one a pixel; each band shows its largest line.
_SPECTRUM_BANDS = 400
# Maximum number of listed impacts, and of listed tasks of clients; more do not fit beside the charts.
_MAX_LISTED = 6
# Maximum number of listed peaks of a response.
_MAX_PEAKS = 4
# Number of points of the theoretical curve, about one per pixel.
_THEORY_POINTS = 400


def min_max_envelope(values: Array, columns: int) -> Array:
    """Reduce samples (channels, samples) to minimum and maximum of each column, alternating.

    The last column is complete.

    There are at least `columns` columns. The first samples, if they do not fill a column, are omitted.

    >>> min_max_envelope(np.array([[3.0, 1.0, 2.0, 0.0]]), 2).tolist()
    [[1.0, 3.0, 0.0, 2.0]]
    >>> min_max_envelope(np.array([[1.0, 3.0, 2.0, 0.0, 7.0]]), 2).tolist()
    [[2.0, 3.0, 0.0, 7.0]]
    """
    channels, samples = values.shape
    per_column = max(1, samples // columns)
    blocks = values[:, samples % per_column :].reshape(channels, -1, per_column)
    return np.stack([blocks.min(axis=2), blocks.max(axis=2)], axis=2).reshape(channels, -1)


def band_peaks(frequency: Array, spectra: Array, bands: int = _SPECTRUM_BANDS) -> tuple[Array, Array]:
    """Reduce spectra (channels, lines) to the largest line in each of at most `bands` bands of equal frequency ratio.

    Returns the lowest frequency of each band, and the values (channels, bands).

    >>> band_peaks(np.array([1.0, 2.0, 4.0]), np.array([[3.0, 5.0, 4.0]]), 2)[1].tolist()
    [[3.0, 5.0]]
    """
    starts = np.unique(np.searchsorted(frequency, np.geomspace(frequency[0], frequency[-1], bands, endpoint=False)))
    return frequency[starts], np.maximum.reduceat(spectra, starts, axis=1)


def message(content: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a message: length of the JSON text (4 bytes), the text with the shapes of the arrays, and their values.

    >>> message({"a": 1}, {"b": np.zeros((1, 2))})[4:40]
    b'{"a": 1, "arrays": {"b": [1, 2]}}   '
    """
    text = json.dumps({**content, "arrays": {name: values.shape for name, values in arrays.items()}}).encode()
    text += b" " * (-len(text) % 4)
    return b"".join([struct.pack("<I", len(text)), text, *(a.astype("<f4").tobytes() for a in arrays.values())])


class Page:
    """The view of the bench in one browser."""

    def __init__(self, bench: LiveBench) -> None:
        self._bench, self._monitor, self._controller = bench, bench.monitor, bench.controller
        self._scene = bench.chassis.bench.scene
        self._rig, self._shown_svg = RigDrawing(self._scene), ""
        self._refreshes = 0
        self._shown_version: Any = None
        # Duration of the shown time histories [s]: the decay after an impact, or some periods at 10 to 50 Hz.
        self.span = 5.0 if self._controller.has_hammer else 0.2
        self.obeyed = 0  # number of commands of the browser that were carried out

    def description(self) -> bytes:
        """Return the first message, which contains all data that do not change."""
        content = {
            "scene": self._scene.name,
            "address": self._bench.address,
            "has_hammer": self._controller.has_hammer,
            "is_linear": self._scene.is_linear,
            "animation": _ANIMATION_S,
            "slow": _ANIMATION_S / MOTION_S,
            "forms": {title: each.form.fields for title, each in self._controller.forms.items() if each.form},
            "channels": [
                {
                    "name": info.name, "unit": info.unit, "at": info.at, "color": hex_color(channel_color(info.at)),
                    "limit": None if info.range is None else info.range / info.sensitivity,
                    "responds": bool(info.body and info.quantity != "force"),
                }
                for info in self._monitor.channels
            ],
        }  # fmt: skip
        return message({"description": content}, {})

    def refresh(self) -> bytes:
        """Return the next message: the state and the curves that are due."""
        monitor = self._monitor
        # The number of commands is read first, because a command may be carried out while the state is read.
        content: dict[str, Any] = {"obeyed": self.obeyed, "span": self.span}
        # Locked, because a test can end while the state is read.
        with self._bench.chassis.changed:
            content["state"] = self._state()
        history = monitor.history.last(round(self.span * monitor.rate))
        arrays: dict[str, NDArray[Any]] = {"history": min_max_envelope(history, _HISTORY_COLUMNS)}
        if self._refreshes % _REFRESHES_PER_SPECTRUM == 0:
            frequency, spectra = monitor.spectra()
            arrays["spectrum_frequency"], arrays["spectra"] = band_peaks(frequency[1:], spectra[:, 1:])
        if self._refreshes % _REFRESHES_PER_RESPONSE == 0:
            self._add_response(content, arrays)
        if self._refreshes % _REFRESHES_PER_ANIMATION == 0 and (motion := monitor.motion()) is not None:
            content["motion"] = self._rig.frames(motion)
            if self._rig.svg != self._shown_svg:
                self._shown_svg = content["svg"] = self._rig.svg
        if impacts := self._impacts():
            arrays["pulse"] = impacts[-1].force
            content["pulse_step"] = 1.0 / monitor.rate
        self._refreshes += 1
        return message(content, arrays)

    def _state(self) -> dict[str, Any]:
        """Return the state of the bench."""
        bench, monitor, controller, recordings = self._bench, self._monitor, self._controller, self._bench.recordings
        impacts = self._impacts()
        return {
            "state": bench.state,
            "running": controller.running,
            "message": bench.message,
            "is_driven_by_clients": bench.is_driven_by_clients,
            "problem": recordings.problem or next(reversed(bench.chassis.problems), ""),
            "progress": controller.progress if controller.running else None,
            "remaining": controller.remaining,
            "target": controller.target if controller.tests else None,
            "force": controller.force,
            "tone": bench.drive_frequency,
            "level_kind": controller.level_kind,
            "details": controller.details,
            "lag": bench.lag,
            "settings": vars(controller.settings),
            "enabled": recordings.enabled,
            "recording": recordings.paths[-1].name if recordings.running else "",
            "recorded": [path.name for path in recordings.paths[: -1 if recordings.running else None]],
            "levels": monitor.levels(),
            "clipping": monitor.overloaded_rows(),
            "overloads": {row: list(cause) for row, cause in monitor.overloads.copy().items()},
            "outputs": bench.outputs(),
            "clients": bench.clients(_MAX_LISTED),
            "frf_reason": controller.frf_unavailable_reason,
            "hits": [
                [impact.number, impact.peak, impact.faults, impact.accepted, impact.is_complete, impact.overloaded]
                for impact in reversed(impacts)
            ],
        }

    def _impacts(self) -> list[Impact]:
        """Return the last impacts of the test; the window of the last impact may be incomplete."""
        detector = self._monitor.detector
        if detector is None:
            return []
        pending = detector.pending
        return [*detector.impacts, *([] if pending is None else [pending])][-_MAX_LISTED:]

    def _add_response(self, content: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        """Add the live frequency response if it has changed."""
        frf, test = self._monitor.frf, self._controller.tests
        tone = self._controller.tone
        # At the end of a test, the peaks near its last tone are added.
        version = test, tone is None, None if frf is None else (id(frf), frf.version)
        if version == self._shown_version:
            return
        self._shown_version = version
        curves = None if frf is None else frf.curves()
        controller = self._controller
        averages = curves and curves.averages
        content["response"] = {
            "test": test, "band": controller.band, "averages": averages, "level": controller.target,
        }  # fmt: skip
        if curves is None:
            return
        content["response"] |= {"names": curves.names, "peaks": largest_peaks(curves, _MAX_PEAKS, tone)}
        arrays |= {
            "frequency": curves.frequency,
            "magnitude": np.abs(curves.value),
            "phase": np.degrees(np.angle(curves.value)),
            "coherence": curves.coherence,
            "coherence_limit": curves.coherence_limit,
            "force": controller.level_per_rms * curves.force,
            "relation": curves.relation,
        }

    def theory(self) -> bytes:
        """Return the response of the linear structure without dampers in the band of the test, as a message."""
        low, high = self._controller.band or (1.0, self._monitor.rate / 10)
        frequency = np.geomspace(max(low, 1e-3 * high), high, _THEORY_POINTS)
        try:
            values = self._controller.theory(frequency)
        except ShotrigError as error:
            return message({"theory": str(error)}, {})
        return message({"theory": ""}, {"theory_frequency": frequency, "theory_magnitude": np.abs(values)})

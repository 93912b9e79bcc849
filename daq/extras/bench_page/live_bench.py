"""The bench that the page operates: builds tests from a few settings, runs tests, and marks tests in the recording."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from daq.core.excitation import Excitation, Station, excitation, procedure_of
from daq.core.excitation.manual_tone import ManualTone, ToneControls
from daq.core.excitation.procedure import FormValues, Procedure
from daq.core.recording.recorded_test import kind_of_settings
from daq.extras.bench_page.hits import HitDetector
from daq.extras.bench_page.live_frf import LiveFrf
from daq.extras.bench_page.monitor import Monitor
from daq.extras.bench_page.recordings import BenchRecordings
from rig.core.base.errors import SceneError, ShotrigError
from rig.core.scene.excitation import KINDS

if TYPE_CHECKING:
    from daq.extras.ni_device.background_test import BackgroundTest
    from daq.extras.ni_device.chassis import Chassis
    from rig.core.scene.scene import Scene

_NO_INPUT = "the scene has neither a shaker nor a hammer"
_NO_FORCE = "the page controls forces, but the shaker exerts none; record the test with `daq record`"
# The test that is selected first, if the scene has a shaker.
_DEFAULT_FORM = "sweep"
# Band of the tests, Hz, if the scene's test has none.
_DEFAULT_BAND = 5.0, 100.0
# Minimum number of samples per period of a sine; it limits the frequency.
_MIN_SAMPLES_PER_PERIOD = 10.0
# Limits of the block length of the live frequency response, s. Within these limits, it is a tenth of the test.
_MIN_BLOCK_S = 1.0
_MAX_BLOCK_S = 4.0
# The window of a hit lasts at most this time, and the next hit begins at least this time after a window, s.
_MAX_HIT_S = 4.0
_MIN_PAUSE_S = 0.1
# A hit is accepted if its peak is at least this fraction of the requested peak.
_MIN_PEAK_RATIO = 0.5


def offered_forms(scene: Scene) -> dict[str, Procedure[Any]]:
    """Return the procedures that the page offers, by the titles of their forms."""
    # The levels on the page are forces.
    exerts_force = any("force" in shaker.level_keys for shaker in scene.shakers)
    kinds = [kind for kind in KINDS if kind.uses_shaker]
    if scene.test is not None and scene.hammer is not None:
        # Only a scene with a hammer test has a channel for the hammer.
        kinds = [type(scene.test)]
    forms: dict[str, Procedure[Any]] = {}
    for kind in kinds:
        # A kind without a procedure can only be simulated.
        with suppress(SceneError):
            procedure = procedure_of(kind)
            is_own = scene.test is not None and type(scene.test) is kind
            # A form without fields runs the test of the scene.
            if procedure.form is not None and (is_own if not procedure.form.fields else exerts_force or scene.hammer):
                forms[procedure.form.title] = procedure
    return forms


class TestController:
    """Starts and stops tests on the bench of a chassis, which is the instrument with its modules.

    The initial `settings` are those of the scene's test. `forms` are the procedures of the tests for which the scene
    has a shaker or a hammer, by title. `message` is the state of the test, or the reason why it did not start.
    `frf_unavailable_reason` is the reason why there is no live frequency response.
    """

    # Name of this client in the chassis' list; the client keeps the clock of the bench running.
    name = "daq bench"

    def __init__(self, chassis: Chassis, monitor: Monitor, recordings: BenchRecordings) -> None:
        self._chassis, self._monitor, self._recordings = chassis, monitor, recordings
        # The terminals of a simulated bench, which can run a test in the background.
        self._terminals: Any = chassis.terminals
        self._scene: Scene = chassis.bench.scene
        test = self._scene.test
        self.forms = offered_forms(self._scene)
        # The settings of the scene's test.
        band = None if test is None else test.band
        low, high = band if band is not None and band[0] < band[1] else _DEFAULT_BAND
        has_force = test is not None and test.level_key not in ("", "drive")
        self.settings = FormValues(
            kind=_DEFAULT_FORM if _DEFAULT_FORM in self.forms else next(iter(self.forms), _DEFAULT_FORM),
            level=float(test.levels[0]) if test is not None and has_force else 1.0,
            frequency=min(test.dwells, default=low) if test is not None else low,
            low=low,
            high=high,
            duration=60.0,
            interval=float(getattr(test, "interval", 0.0)),
            hits=int(getattr(test, "repeats", 1)),
        )
        self.message = "ready" if self.forms else _NO_FORCE if self._scene.shakers else _NO_INPUT
        self.frf_unavailable_reason = ""
        self._background_test: BackgroundTest | None = None
        self._controls: ToneControls | None = None
        # First sample, stop and marker fields of each hit of the test.
        self._hits: list[tuple[int, int, dict[str, Any]]] = []

    @property
    def has_hammer(self) -> bool:
        """Whether the tests are hammer hits."""
        return self._scene.hammer is not None

    @property
    def running(self) -> bool:
        """Whether a test of the page is running."""
        return self._background_test is not None and not self._background_test.is_idle

    def switch_on(self) -> None:
        """Start the clock of the bench without a test."""
        with self._chassis.changed:
            self._terminals.run_test(self._scene, 0, _ignore, _ignore, _ignore, _zero_drive)
            self._chassis.keep_time_running(cast(Any, self))

    def switch_off(self) -> None:
        """Mark the hits, and stop the clock of the bench unless a client runs a task."""
        with self._chassis.changed:
            self._mark_hits()
        self._chassis.unregister(cast(Any, self))

    def start(self) -> None:
        """Start the test that the settings describe; on failure `message` states the reason."""
        if self.running:
            return
        chassis = self._chassis
        try:
            self._require_numbers()
            scene, excite, self._controls = self._build_test()
            frf, detector = self._build_estimate(scene)
            with chassis.changed:
                chassis.return_outputs()
                self._hits = []
                self._recordings.begin_test(scene, kind_of_settings(scene.test))
                self.message = f"{self.settings.kind} runs"
                self._background_test = self._terminals.run_test(
                    scene, chassis.position, self._on_mark, self._on_progress, self._on_end, excite
                )
                if self.running:
                    self._monitor.start_estimate(frf, detector)
        except (ShotrigError, ValueError) as error:
            self.message = str(error)

    def stop(self) -> None:
        """End the test after the present window of its drive."""
        if self._background_test is not None:
            self._background_test.stop()

    def apply_settings(self) -> None:
        """Apply the changed frequency and level to a running sine."""
        if self._controls is not None and self.running:
            try:
                self._require_numbers()
                self._controls.set(self.settings.frequency, self.settings.level)
            except SceneError as error:
                self.message = str(error)

    def _require_numbers(self) -> None:
        """Raise `SceneError` if a field of the page is empty."""
        empty = [name for name, value in vars(self.settings).items() if value is None]
        if empty:
            raise SceneError(f"{', '.join(empty)}: the field is empty. Enter a number.")

    def _build_test(self) -> tuple[Scene, Any, ToneControls | None]:
        """Return the scene of the test, its excitation, and the controls of a sine (None for other tests)."""
        values, procedure = self.settings, self.forms.get(self.settings.kind)
        if procedure is None or procedure.form is None:
            raise SceneError(_NO_INPUT if not self.forms else f"test: choose {', '.join(self.forms)}.")
        controls, excite = None, excitation
        if procedure.form.adjustable:
            controls = ToneControls(values.frequency, values.level, self._monitor.rate / _MIN_SAMPLES_PER_PERIOD)
            excite = ManualTone(controls).excite
        return self._scene.replace(test=procedure.from_form(values, self._scene.test)), excite, controls

    def _build_estimate(self, scene: Scene) -> tuple[LiveFrf | None, HitDetector | None]:
        """Return the live estimate and the detector of hits; each is None if its channel is missing.

        Without an estimate, `frf_unavailable_reason` is set.
        """
        settings, monitor, detector = self.settings, self._monitor, None
        band = sorted((settings.low, settings.high))
        block = min(max(settings.duration / 10, _MIN_BLOCK_S), _MAX_BLOCK_S)
        if scene.hammer is not None:
            block = min(settings.interval - _MIN_PAUSE_S, _MAX_HIT_S)
            band = [0.0, 0.5 * monitor.rate]
            row = next((k for k, info in enumerate(monitor.channels) if info.at == "hammer"), None)
            if row is not None:
                detector = HitDetector(row, monitor.rate, _MIN_PEAK_RATIO * settings.level, block)
        elif self._controls is not None:
            band = [0.0, monitor.rate / _MIN_SAMPLES_PER_PERIOD]
        try:
            frf = LiveFrf(scene, monitor.channels, monitor.rate, block, (band[0], band[1]))
            self.frf_unavailable_reason = ""
        except SceneError as error:
            frf, self.frf_unavailable_reason = None, str(error)
        return frf, detector

    def _on_mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        if kind == "hit":
            # The operator can accept or reject hits until the test ends.
            self._hits.append((first, stop, fields))
        else:
            self._recordings.mark(kind, first, stop, **fields)

    def _mark_hits(self) -> None:
        """Mark each hit in the recording as accepted (`hit`) or `rejected`, with the reason."""
        detected = () if self._monitor.detector is None else self._monitor.detector.hits
        for first, stop, fields in self._hits:
            overlapping = (h for h in detected if h.first <= stop and first <= h.first + h.window_samples)
            hit = next(overlapping, None)
            rejected = hit is not None and not hit.accepted
            reason = {"reason": ", ".join(hit.faults) or "operator"} if hit is not None and rejected else {}
            self._recordings.mark("rejected" if rejected else "hit", first, stop, **fields, **reason)
        self._hits = []

    def _on_progress(self, fraction: float, message: str) -> None:
        self.message = f"{100 * fraction:.0f} %: {message}" if fraction else message

    def _on_end(self, reason: str) -> None:
        self._mark_hits()
        self._monitor.end_estimate()
        self._recordings.end_test()
        self.message = f"test ended: {reason}" if reason else "ready"


def _zero_drive(station: Station) -> Excitation:
    """Output one sample of zeros instead of the test of the scene."""
    yield station.zero_drive(1)


def _ignore(*arguments: Any, **fields: Any) -> None:
    """Ignore the call: a callback without effect."""


class LiveBench:
    """The bench that the pages of all browsers share; `address` is the address of the device for NI clients."""

    def __init__(self, chassis: Chassis, address: str, recording: Path, overwrite: bool) -> None:
        self.chassis, self.address = chassis, address
        self.monitor = Monitor(chassis)
        self.recordings = BenchRecordings(chassis, recording, overwrite)
        self.controller = TestController(chassis, self.monitor, self.recordings)
        # The recordings receive each block first, because the block in which a test ends still belongs to its file.
        chassis.listeners += [self.recordings.on_block, self.monitor.on_block]
        self.controller.switch_on()

    def outputs(self) -> list[str]:
        """Return a line for each output: peak in V and frequency."""
        lines = []
        for number, ((peak, frequency), drive_per_volt) in enumerate(
            zip(self.monitor.drive_levels(), self.chassis.terminals.drive_per_volt, strict=False), 1
        ):
            tone = f", {frequency:.4g} Hz" if frequency else ""
            lines.append(f"output {number}: {peak / drive_per_volt:.4g} V{tone}")
        return lines

    def clients(self) -> str:
        """Return lines about the tasks of NI clients."""
        chassis = self.chassis
        with chassis.changed:
            lines = [
                f"{name}: {'running' if task in chassis.inputs or task in chassis.outputs else 'open'} on {task.device}"
                for name, task in chassis.tasks.items()
            ]
        return "\n".join(["Tasks of NI clients:", *lines]) if lines else "no task of an NI client"

    def close(self) -> None:
        """Complete the recording, and stop all threads."""
        with self.chassis.changed:
            self.chassis.listeners.remove(self.recordings.on_block)
            self.chassis.listeners.remove(self.monitor.on_block)
        self.controller.switch_off()
        self.recordings.close()
        self.monitor.close()

"""The bench that the page operates: creates tests from a few settings, runs and marks them in the recording."""

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from daq.core.excitation import Excitation, Station, excitation, procedure_of
from daq.core.excitation.procedure import FormValues, Procedure
from daq.core.excitation.tones.manual_tone import ManualTone, ToneControls
from daq.core.recording.recorded_test import kind_of_settings
from daq.extras.bench_page.impacts import ImpactDetector
from daq.extras.bench_page.live_frf import LiveFrf
from daq.extras.bench_page.monitor import Monitor
from daq.extras.bench_page.recordings import BenchRecordings
from daq.extras.ni_device.background_test import BackgroundTest
from daq.extras.ni_device.chassis import Chassis
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError, ShotrigError
from rig.core.scene.excitation import KINDS
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import structural_model

_NO_INPUT = "the scene has neither a shaker nor a hammer"
_NO_FORCE = "the page controls forces, but the shaker exerts none; record the test with `daq record`"
# The test that is selected first, if the scene has a shaker.
_DEFAULT_FORM = "sweep"
# Band of the tests [Hz], if the scene's test has none.
_DEFAULT_BAND = 5.0, 100.0
# Minimum number of samples per period of a sine: the shape of a faster sine is not displayed. It limits the frequency.
_MIN_SAMPLES_PER_PERIOD = 10.0
# Limits of the block length of the live frequency response [s]. Within these limits, a block is a tenth of the test.
_MIN_BLOCK_S = 1.0
_MAX_BLOCK_S = 4.0
# For NI clients, the band of the frequency response ends at the sample rate divided by this number, as usual with
# anti-aliasing filters.
_NYQUIST_MARGIN = 2.56
# Longest window of an impact [s]: an operator waits no longer for the result.
_MAX_HIT_S = 4.0
# Shortest pause [s] from the end of a window to the next impact, in which the sensors settle.
_MIN_PAUSE_S = 0.1
# Lowest frequency of the response to impacts, periods per window. Below it, the low cutoff of the sensors dominates.
_MIN_PERIODS_PER_WINDOW = 4.0
# An impact is accepted if its peak is at least this fraction of the requested peak; weaker impacts disappear in the
# noise.
_MIN_PEAK_RATIO = 0.5


def offered_forms(scene: Scene) -> dict[str, Procedure[Any]]:
    """Return the procedures that the page offers, by the titles of their forms."""
    # The page offers only tests whose level is a force.
    exerts_force = any("force" in shaker.level_keys for shaker in scene.shakers)
    kinds = [kind for kind in KINDS if kind.uses_shaker]
    if scene.test is not None and scene.hammer is not None:
        # Only a scene with an impact test has a channel for the hammer.
        kinds = [type(scene.test)]
    forms: dict[str, Procedure[Any]] = {}
    for kind in kinds:
        # A kind of test without a procedure can only be simulated.
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
    `progress` is the completed fraction of the measurement; 0 while the test settles. `is_aborted` states whether the
    last test ended early. `tests` is the number of started tests; single impacts of the same settings belong to one
    test. `target` is the level of the test [N]. `frf_unavailable_reason` is the reason why there is no live frequency
    response.
    """

    # Name of this client in the list of the chassis; the client keeps the clock of the bench running.
    name = "daq bench"

    def __init__(self, chassis: Chassis, monitor: Monitor, recordings: BenchRecordings) -> None:
        self._chassis, self._monitor, self._recordings = chassis, monitor, recordings
        # These are the terminals of a simulated bench, which can run a test in the background.
        self._terminals: Any = chassis.terminals
        self._scene: Scene = chassis.bench.scene
        test = self._scene.test
        self.forms = offered_forms(self._scene)
        band = None if test is None else test.band
        low, high = band if band is not None and band[0] < band[1] else _DEFAULT_BAND
        impacts, interval = (1, 0.0) if test is None else test.hits
        has_force = test is not None and test.level_key not in ("", "drive")
        self.settings = FormValues(
            kind=_DEFAULT_FORM if _DEFAULT_FORM in self.forms else next(iter(self.forms), _DEFAULT_FORM),
            level=float(test.levels[0]) if test is not None and has_force else 1.0,
            frequency=min(test.dwells, default=low) if test is not None else low,
            low=low,
            high=high,
            duration=60.0,
            interval=interval,
            hits=impacts,
        )
        self.message = "ready" if self.forms else _NO_FORCE if self._scene.shakers else _NO_INPUT
        self.frf_unavailable_reason = ""
        self.progress, self.is_aborted, self.tests = 0.0, False, 0
        # Level of the last test; None if NI clients drive the outputs.
        self.target: float | None = 0.0
        # Time at which the measurement began, s since power-on; None while the test settles.
        self._measures_from: float | None = None
        self._test: tuple[Procedure[Any], Any] | None = None
        self._background_test: BackgroundTest | None = None
        self._controls: ToneControls | None = None
        # Level and interval of the impacts in the current average, and the message shown during a single impact.
        self._series: tuple[float, float] | None = None
        self._single_impact = ""
        # First sample, stop and marker fields of each impact of the test.
        self._impacts: list[tuple[int, int, dict[str, Any]]] = []

    @property
    def has_hammer(self) -> bool:
        """Whether the tests are hammer impacts."""
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
        """Mark the impacts, and stop the clock of the bench unless a client runs a task."""
        with self._chassis.changed:
            self._mark_impacts()
        self._chassis.unregister(cast(Any, self))

    @property
    def state(self) -> str:
        """State of the test: idle, settling, measuring or aborted."""
        if not self.running:
            return "aborted" if self.is_aborted else "idle"
        return "settling" if self.excited_band() is None else "measuring"

    @property
    def level_kind(self) -> str:
        """Meaning of the level of the last test: peak of an impact, amplitude of a tone, or rms of noise."""
        if self.has_hammer:
            return "peak"
        procedure, test = self._test or (None, None)
        is_tone = self._controls is not None or (procedure and procedure.frequency_at(test, 0.5) is not None)
        return "amplitude" if is_tone else "rms"

    @property
    def level_per_rms(self) -> float:
        """Ratio of the level of a continuous test to the rms of its force."""
        return 2.0**0.5 if self.level_kind == "amplitude" else 1.0

    @property
    def details(self) -> str:
        """Settings of the last test that are not fields of the page, such as the rate of a sweep.

        Empty after a single impact, which has the settings of the averaged impacts.
        """
        return "" if self._test is None or self._single_impact else ", ".join(self._test[1].details)

    @property
    def band(self) -> tuple[float, float] | None:
        """Band of the last test, or of the settings before a test [Hz].

        The result is None for impacts, whose pulse determines the band.
        """
        if self.has_hammer:
            return None
        if self._controls is not None:
            return 0.0, 2.0 * self.settings.frequency
        low, high = sorted((self.settings.low or 0.0, self.settings.high or 0.0))
        return (low, high) if high > low else None

    def theory(self, frequency: Array) -> ComplexArray:
        """Return the compliance of the linear structure without dampers [m/N] for comparison with the live response.

        Shape (channels on bodies, frequencies). Raises `SceneError` if shakers remain attached in an impact test.
        """
        scene, shaker = self._scene, self._scene.driven_shaker
        if scene.shakers and (scene.hammer is not None or shaker is None or shaker.carries_structure):
            raise SceneError(
                "no theoretical compliance: it is not computed in an impact test with an attached shaker (remove the "
                "shaker), for several driven shakers (drive one), or for a structure on a shaker table."
            )
        force = np.zeros(scene.structure.bodies)
        force[[body - 1 for body in scene.force_on]] = 1.0
        rows = [info.body - 1 for info in self._monitor.channels if info.body and info.quantity != "force"]
        return structural_model(scene).response(frequency, force)[rows]

    @property
    def force(self) -> float | None:
        """Measured force of the last test [N] as amplitude, rms or peak like its level.

        None before the first estimate.
        """
        frf, detector = self._monitor.frf, self._monitor.detector
        if detector is not None:
            return detector.impacts[-1].peak if detector.impacts else None
        if frf is None or frf.force_rms is None:
            return None
        return frf.force_rms * self.level_per_rms

    @property
    def remaining(self) -> float | None:
        """Expected time until the end of the measurement [s]; None if it is unknown."""
        if self._measures_from is None or not 0.0 < self.progress < 1.0 or not self.running:
            return None
        return (self._chassis.elapsed - self._measures_from) * (1.0 / self.progress - 1.0)

    def excited_band(self) -> tuple[float, float] | None:
        """Return the lowest and highest frequency [Hz] that the test excites now; None while it settles."""
        if self._controls is not None:
            frequency = self._controls.settings[0]
            return frequency, frequency
        if not self.progress or self._test is None:
            return None
        procedure, test = self._test
        tone = procedure.frequency_at(test, self.progress)
        return (self.settings.low, self.settings.high) if tone is None else (tone, tone)

    @property
    def tone(self) -> float | None:
        """Frequency of the tone of the running test [Hz]; None for other tests and while the test settles."""
        low, high = (self.running and self.excited_band()) or (None, 0.0)
        return low if low == high else None

    def start(self, single_impact: bool = False) -> None:
        """Start the test that the settings describe; on failure `message` states the reason.

        `single_impact`: one impact, instead of the number in the settings. It is averaged with the previous impacts,
        until the level or the interval changes, or a whole test starts.
        """
        if self.running:
            return
        chassis, monitor = self._chassis, self._monitor
        try:
            self._require_numbers()
            values = replace(self.settings, hits=1) if single_impact else self.settings
            scene, excite, self._controls = self._build_test(values)
            series = values.level, values.interval
            continues = single_impact and series == self._series and monitor.detector is not None
            frf, detector = (monitor.frf, monitor.detector) if continues else self._build_estimate(scene)
            self._series = series
            self._single_impact = (
                f"impact {1 + len(detector.impacts)}" if single_impact and detector is not None else ""
            )
            with chassis.changed:
                chassis.return_outputs()
                self._impacts = []
                self.progress, self._measures_from, self.is_aborted = 0.0, None, False
                self._test, self.target = (self.forms[values.kind], scene.test), values.level
                self.tests += not continues
                self._recordings.begin_test(scene, kind_of_settings(scene.test))
                self.message = f"{self.settings.kind} runs"
                self._background_test = self._terminals.run_test(
                    scene, chassis.position, self._on_mark, self._on_progress, self._on_end, excite
                )
                if self.running:
                    monitor.start_estimate(frf, detector, self.excited_band)
        except (ShotrigError, ValueError) as error:
            self.message = str(error)

    def stop(self) -> None:
        """End the test after the current window of its drive."""
        if self._background_test is not None and self.running:
            # A manually set tone runs until it is stopped.
            self.is_aborted = self._controls is None
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

    def _build_test(self, values: FormValues) -> tuple[Scene, Any, ToneControls | None]:
        """Return the scene of the test, its excitation, and the controls of a sine (None for other tests)."""
        procedure = self.forms.get(values.kind)
        if procedure is None or procedure.form is None:
            raise SceneError(_NO_INPUT if not self.forms else f"test: choose {', '.join(self.forms)}.")
        controls, excite = None, excitation
        if procedure.form.adjustable:
            controls = ToneControls(values.frequency, values.level, self._monitor.rate / _MIN_SAMPLES_PER_PERIOD)
            excite = ManualTone(controls).excite
        return self._scene.replace(test=procedure.from_form(values, self._scene.test)), excite, controls

    def _build_estimate(self, scene: Scene) -> tuple[LiveFrf | None, ImpactDetector | None]:
        """Return the live estimate and the detector of impacts; each is None if its channel is missing.

        Without an estimate, `frf_unavailable_reason` is set.
        """
        settings, monitor, detector = self.settings, self._monitor, None
        band = sorted((settings.low, settings.high))
        block = min(max(settings.duration / 10, _MIN_BLOCK_S), _MAX_BLOCK_S)
        if scene.hammer is not None:
            block = min(settings.interval - _MIN_PAUSE_S, _MAX_HIT_S)
            band = [_MIN_PERIODS_PER_WINDOW / block, 0.5 * monitor.rate]
            row = next((k for k, info in enumerate(monitor.channels) if info.at == "hammer"), None)
            if row is not None:
                detector = ImpactDetector(row, monitor.rate, _MIN_PEAK_RATIO * settings.level, block)
        elif self._controls is not None:
            band = [0.0, monitor.rate / _MIN_SAMPLES_PER_PERIOD]
        try:
            frf = LiveFrf(scene, monitor.channels, monitor.rate, block, (band[0], band[1]))
            self.frf_unavailable_reason = ""
        except SceneError as error:
            frf, self.frf_unavailable_reason = None, str(error)
        return frf, detector

    def start_client_estimate(self) -> None:
        """Estimate responses to the drive of NI clients, at the spectral lines that the drive excites."""
        band = (0.0, self._monitor.rate / _NYQUIST_MARGIN)
        try:
            frf = LiveFrf(self._scene, self._monitor.channels, self._monitor.rate, _MIN_BLOCK_S, band)
        except SceneError as error:
            self.frf_unavailable_reason = str(error)
            return
        self.tests += 1
        self._test, self.target = None, None
        if not self.is_aborted:
            self.message = "response to the drive of NI clients"
        self._monitor.start_estimate(frf, None, lambda: band)

    def _on_mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        if kind == "hit":
            # The operator can accept or reject impacts until the test ends.
            self._impacts.append((first, stop, fields))
        else:
            self._recordings.mark(kind, first, stop, **fields)

    def _mark_impacts(self) -> None:
        """Mark each impact in the recording as accepted (`hit`) or `rejected`, with the reason."""
        detected = () if self._monitor.detector is None else self._monitor.detector.impacts
        for first, stop, fields in self._impacts:
            overlapping = (h for h in detected if h.first <= stop and first <= h.first + h.window_samples)
            impact = next(overlapping, None)
            rejected = impact is not None and not impact.accepted
            reason = {"reason": ", ".join(impact.faults) or "operator"} if impact is not None and rejected else {}
            self._recordings.mark("rejected" if rejected else "hit", first, stop, **fields, **reason)
        self._impacts = []

    def _on_progress(self, fraction: float, message: str) -> None:
        self.message, self.progress = (fraction and self._single_impact) or message, fraction
        if fraction and self._measures_from is None:
            self._measures_from = self._chassis.elapsed

    def _on_end(self, reason: str) -> None:
        self.is_aborted |= bool(reason)
        self._mark_impacts()
        self._monitor.end_estimate()
        self._recordings.end_test()
        self.message = (
            f"test ended: {reason}"
            if reason
            else "stopped"
            if self.is_aborted
            else f"{self._single_impact or f'{self.settings.kind} test'} completed"
        )


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
        self._clients_drive = False
        # The recordings receive each block first, because the block in which a test ends belongs to the test's file.
        self._listeners = [self.recordings.on_block, self.monitor.on_block, self._follow_clients]
        chassis.listeners += self._listeners
        self.controller.switch_on()

    def _follow_clients(self, bench: Any, block: Any) -> None:
        """Estimate responses while tasks of clients drive outputs; a listener of the chassis."""
        drives = self.is_driven_by_clients
        if drives and not self._clients_drive:
            self.controller.start_client_estimate()
        elif self._clients_drive and not drives and not self.controller.running:
            self.monitor.end_estimate()
        self._clients_drive = drives

    @property
    def is_driven_by_clients(self) -> bool:
        """Whether tasks of NI clients drive outputs, so that no test can start."""
        return bool(self.chassis.outputs) and not self.controller.running

    @property
    def message(self) -> str:
        """The message of the last test, or on the response to NI clients that have driven the outputs."""
        drivers = [name for name, task in self.chassis.tasks.items() if task in self.chassis.outputs]
        return f"driven by NI client {', '.join(drivers)}" if self.is_driven_by_clients else self.controller.message

    @property
    def state(self) -> str:
        """State of the bench: idle, settling, measuring, recording or aborted."""
        state = self.controller.state
        if self.recordings.running and state != "settling":
            return "recording"
        return "measuring" if state in ("idle", "aborted") and self.chassis.inputs else state

    @property
    def lag(self) -> float:
        """Time by which the bench is behind real time [s]."""
        return max(0.0, (time.time_ns() - self.chassis.time_ns(self.chassis.position)) * 1e-9)

    @property
    def drive_frequency(self) -> float | None:
        """Frequency of the tone of the test, or of the first output that NI clients drive [Hz]."""
        if not self.is_driven_by_clients:
            return self.controller.tone
        return next((frequency for _, frequency in self.monitor.drive_levels() if frequency), None)

    def outputs(self) -> list[str]:
        """Return a line for each output: peak in V, and frequency of the tone of the test, or else of the drive.

        Without a running test or task, the level is that of the newest sample, not that of the last test.
        """
        lines = []
        levels, is_idle = self.monitor.drive_levels(), not self.controller.running and not self.chassis.outputs
        if is_idle:
            levels = [(float(value), 0.0) for value in np.abs(self.monitor.drive_history.last(1)[:, 0])]
        for number, ((peak, frequency), drive_per_volt) in enumerate(
            zip(levels, self.chassis.terminals.drive_per_volt, strict=False), 1
        ):
            frequency = frequency and (self.controller.tone or frequency)
            tone = f", {frequency:.4g} Hz" if frequency else " (held)" if is_idle and peak else ""
            lines.append(f"output {number}: {peak / drive_per_volt:.4g} V{tone}")
        return lines

    def clients(self, most: int) -> list[str]:
        """Return a line of text for each task of NI clients, at most `most` lines."""
        chassis = self.chassis
        with chassis.changed:
            lines = [
                f"{name}: {'running' if task in chassis.inputs or task in chassis.outputs else 'open'} on {task.device}"
                for name, task in chassis.tasks.items()
            ]
        return lines[:most]

    def close(self) -> None:
        """Complete the recording, and stop all threads."""
        with self.chassis.changed:
            for listener in self._listeners:
                self.chassis.listeners.remove(listener)
        self.controller.switch_off()
        self.recordings.close()
        self.monitor.close()

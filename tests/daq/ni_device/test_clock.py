"""Clocks of the instrument: when the real, fast and manual clock advance the bench, and wake waiting clients."""

import threading

import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqError, DaqReadError

from daq.extras.ni_device.clock import FastClock, ManualClock, RealClock, Sleepers, _DelayReport, clock, longest_step
from rig.core.base.errors import SceneError
from tests.daq.client import Task, add_inputs, connect, raises_code


class CountingBench:
    """A bench that only counts ticks, at 1000 Hz."""

    rate = 1000.0

    def __init__(self):
        self.position = 0
        lock = threading.RLock()
        self.changed, self.sleepers = threading.Condition(lock), Sleepers(lock)
        self.is_in_use = True
        self.delays = []

    def advance(self, ticks):
        with self.changed:
            self.position += ticks
            self.changed.notify_all()
            self.sleepers.wake(self.position)

    def anchor(self):
        pass

    def fail(self, error):
        self.failure = error

    def report_delay(self, seconds):
        self.delays.append(seconds)
        return False


def test_fast_clock_advances_by_exact_time():
    bench = CountingBench()
    with bench.changed:
        assert FastClock().wait(bench, lambda: bench.position >= 300, lambda: 300 - bench.position, 10.0)
    assert bench.position == 300


def test_fast_clock_times_out_in_bench_time():
    bench = CountingBench()
    with bench.changed:
        assert not FastClock().wait(bench, lambda: False, lambda: 7, 0.25)
    assert bench.position == 250  # 0.25 s at 1000 Hz


def test_manual_clock_advances_only_on_request():
    bench, manual = CountingBench(), ManualClock()
    manual.start(bench)
    assert not manual.wait(bench, lambda: False, lambda: 1, -1.0)
    assert bench.position == 0
    manual.advance(0.5)
    assert bench.position == 500


def test_real_clock_stops_with_last_task():
    bench, real = CountingBench(), RealClock()
    with bench.changed:
        assert real.wait(bench, lambda: bench.position >= 20, lambda: 20, 30.0)
    bench.is_in_use = False
    for thread in threading.enumerate():
        if thread.name == "bench":
            thread.join(10.0)
    final_position = bench.position
    assert not any(thread.name == "bench" for thread in threading.enumerate())
    assert bench.position == final_position


def test_each_thread_wakes_at_its_position():
    lock, woken = threading.RLock(), []
    sleepers = Sleepers(lock)
    n_waiting = threading.Semaphore(0)

    def wait(until):
        with lock:
            n_waiting.release()
            sleepers.sleep(until)
            woken.append(until)

    threads = [threading.Thread(target=wait, args=(until,)) for until in (10, 20, 30)]
    for thread in threads:
        thread.start()
    for _ in threads:
        n_waiting.acquire()
    for position, thread in ((15, threads[0]), (25, threads[1]), (None, threads[2])):
        with lock:
            sleepers.wake(position)
        thread.join(10.0)
    assert woken == [10, 20, 30]


def test_bench_failure_is_reported_to_reader(monkeypatch, capsys):
    chassis = connect("bare-structure", "real")
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        task.read(10)
        monkeypatch.setattr(chassis, "_step", lambda limit: 1 / 0)
        with pytest.raises(DaqError, match="ZeroDivisionError"):
            task.read(100000, timeout=60.0)
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_clock_is_selected_by_name():
    assert isinstance(clock("manual"), ManualClock)
    with pytest.raises(SceneError, match="Choose real or fast"):
        clock("sundial")


def test_timeout_reports_number_of_samples_read():
    manual = ManualClock()
    connect("bare-structure", manual)
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        manual.advance(0.1)  # 512 samples
        with raises_code(Code.SAMPLES_NOT_YET_AVAILABLE, kind=DaqReadError, samples=512):
            task.read(600)
        manual.advance(0.2)
        assert task.in_stream.avail_samp_per_chan == 1024
        assert len(task.read(1024)) == 1024


def test_real_and_fast_clock_give_same_samples():
    readings = []
    for name in ("fast", "real"):
        connect("bare-structure", name)
        with add_inputs(Task(), "Dev1/ai0:3", sample_mode=AcquisitionType.CONTINUOUS) as task:
            task.start()
            readings.append(np.concatenate([np.array(task.read(100, timeout=60.0)) for _ in range(5)], axis=1))
    assert np.array_equal(*readings)


def test_delayed_bench_advances_at_limited_rate():
    # After a delay of one second, the thread runs every 5 ms and advances the bench by twice that time.
    steps = [longest_step(1.0)] + [longest_step(0.005) for _ in range(20)]
    assert steps[0] == RealClock.MAX_STEP_S
    assert sum(steps[1:]) == pytest.approx(2.0 * 20 * 0.005)


def test_delay_is_logged_at_most_every_10_s(caplog):
    report = _DelayReport()
    # Wall-clock times and delays, s.
    for now, delay in ((1.0, 0.5), (1.1, 0.2), (1.2, 0.01), (2.0, 0.3), (2.1, 0.0), (3.0, 0.1)):
        report.add(delay, now)
    assert [record.getMessage() for record in caplog.records if "0.50 s behind" in record.getMessage()]
    assert len(caplog.records) == 1
    report.add(0.0, 12.0)
    assert "0.30 s behind" in caplog.records[-1].getMessage()

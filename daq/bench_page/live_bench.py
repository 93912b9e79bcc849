"""A bench with what its page needs: the view of its channels, the operator's tests, recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from daq.bench_page.monitor import Monitor
from daq.bench_page.operator import Operator
from daq.bench_page.recordings import BenchRecordings

if TYPE_CHECKING:
    from daq.instrument.chassis import Chassis


class LiveBench:
    """What every browser's page shows; NI clients find the device at `address`."""

    def __init__(self, chassis: Chassis, address: str, recording: Path, overwrite: bool) -> None:
        self.chassis, self.address = chassis, address
        self.monitor = Monitor(chassis)
        self.recordings = BenchRecordings(chassis, recording, overwrite)
        self.operator = Operator(chassis, self.monitor, self.recordings)
        # The recorder first: a test ends after the block that it gets.
        chassis.listeners += [self.recordings.hear, self.monitor.hear]
        self.operator.switch_on()

    def outputs(self) -> list[str]:
        """Describe each output: peak in V, and frequency."""
        lines = []
        for number, ((peak, frequency), per_volt) in enumerate(
            zip(self.monitor.output(), self.chassis.terminals.drive_per_volt, strict=False), 1
        ):
            tone = f", {frequency:.4g} Hz" if frequency else ""
            lines.append(f"output {number}: {peak / per_volt:.4g} V{tone}")
        return lines

    def clients(self) -> str:
        """Describe the tasks of NI clients."""
        chassis = self.chassis
        with chassis.changed:
            lines = [
                f"{name}: {'running' if task in chassis.inputs or task in chassis.outputs else 'open'} on {task.device}"
                for name, task in chassis.tasks.items()
            ]
        return "\n".join(["Tasks of NI clients:", *lines]) if lines else "no NI client"

    def close(self) -> None:
        """Complete the recording and stop."""
        with self.chassis.changed:
            self.chassis.listeners.remove(self.recordings.hear)
            self.chassis.listeners.remove(self.monitor.hear)
        self.operator.switch_off()
        self.recordings.close()
        self.monitor.close()

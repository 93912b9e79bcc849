"""LDAQ acquires through its NI interface: `python -m tests.controllers.ldaq SITE_PACKAGES [real|fast]`.

SITE_PACKAGES is the folder with `LDAQ` and `nidaqwrapper` in a separate environment (`pip install LDAQ`). The test of
the scene excites the structure with a tone. LDAQ's `Core` reads three accelerometers through `NIAcquisition` from its
trigger on; its data must contain this tone.
"""

import os
import sys
import tempfile
from pathlib import Path

import rig
from daq.extras.ni_server.script import run_script

SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 1 %}}
shaker: {kind: force, body: 1}
test: {kind: sine, frequency: 25 Hz, force: 5 N}
channels:
  - {name: one, at: body 1, accelerometer: {preset: PCB 352C33}}
  - {name: two, at: body 2, accelerometer: {preset: PCB 352C33}}
  - {name: two_again, at: body 2, accelerometer: {preset: PCB 352C33}}
converter: {preset: NI 9234, rate: 5120 Hz}
"""
SCRIPT = """
import LDAQ, nidaqwrapper, numpy as np
from LDAQ.national_instruments import NIAcquisition

task = nidaqwrapper.AITask("shaker test", sample_rate=5120)
device = next(name for name, kind in zip(task.device_list, task.device_product_type) if kind == "NI 9234")
for number in range(3):
    task.add_channel(f"a{number}", device, number, 100.0, "mV/g", "g", min_val=-50.0, max_val=50.0)
task.configure()
source = NIAcquisition(task)
source.set_trigger(0.02, 1, duration=2.0, duration_unit="seconds", presamples=200)
core = LDAQ.Core([source])
core.run(hotkeys=False, verbose=0)
measured = core.get_measurement_dict()["shaker test"]
task.clear_task()
time, data = measured["time"], measured["data"]
assert data.shape == (10240, 3), data.shape
assert np.allclose(np.diff(time), 1 / 5120)
# 200 samples precede the trigger at 0.02 g in channel 1.
assert data[:199, 1].max() < 0.02 <= data[199:202, 1].max(), data[195:205, 1]
# The lines of the spectrum of the last second are 1 Hz apart; the tone of 25 Hz is the highest.
spectrum = np.abs(np.fft.rfft(data[-5120:] * np.hanning(5120)[:, None], axis=0))
assert (np.argmax(spectrum[5:], axis=0) + 5 == 25).all()
# The sensors on one body agree within their tolerances.
first, second = np.std(data[-5120:, 1:], axis=0)
assert abs(first / second - 1) < 0.15
print(f"LDAQ {LDAQ.__version__ if hasattr(LDAQ, '__version__') else ''}: passed, {data.shape} samples")
"""


def main() -> int:
    """Run the script; LDAQ's packages come after those of this environment on the path."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    packages = [os.environ.get("PYTHONPATH", ""), str(Path(sys.argv[1]).resolve())]
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, packages))
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder, "script.py")
        script.write_text(SCRIPT)
        return run_script(script, [], rig.loads(SCENE), sys.argv[2] if len(sys.argv) > 2 else "real")


if __name__ == "__main__":
    raise SystemExit(main())

"""Rattlesnake controls a random vibration test: `python -m tests.controllers.rattlesnake CHECKOUT [SITE_PACKAGES]`.

CHECKOUT is a copy of https://github.com/sandialabs/rattlesnake-vibration-controller (GPL), which is not part of this
project. SITE_PACKAGES is a folder with its dependencies (qtpy, PyQt5, pyqtgraph, netCDF4, openpyxl, ...). Its processes
for acquisition, output and random control run unmodified, as clients of the virtual instrument. Its window is replaced:
the script below sends the commands of a user into its queues. Rattlesnake identifies the system, predicts the drive,
and controls the acceleration to a flat spectrum. The control error that it reports must be below 3 dB RMS.
"""

import os
import sys
import tempfile
from pathlib import Path

import rig
from daq.extras.ni_server.script import run_script

SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 5 %}}
shaker: {kind: electrodynamic, body: 1, spring: 40 kN/m, output: {preset: NI 9260}}
channels:
  - {name: control, at: body 1, accelerometer: {preset: PCB 352C33}}
  - {name: drive, at: drive}
converter: {preset: NI 9234, rate: 2048 Hz}
"""
SCRIPT = """
import multiprocessing as mp, os, queue, sys, threading, time
import numpy as np
import psutil
from components import (ControlTypes, QueueContainer, VerboseMessageQueue, acquisition_process,
                        all_environment_processes, output_process)
from components.random_vibration_sys_id_environment import RandomVibrationCommands, RandomVibrationMetadata
from components.abstract_sysid_environment import SystemIdCommands
from components.utilities import Channel, DataAcquisitionParameters, GlobalCommands

NAME, RATE, FRAME, HERE = "Random", 2048, 1024, os.getcwd()
seconds = float(sys.argv[1])


def channel(number, sensitivity, unit, kind, excited, feedback):
    return Channel(str(number), "X+", "", "", "", str(sensitivity), unit, "", "", "", "cDAQ1Mod1", f"ai{number}",
                   kind, "-4", "4", "AC", "Internal" if excited else "None", "0.002" if excited else "0",
                   feedback and "cDAQ1Mod2", feedback and "ao0", "", "")


channels = [channel(0, 100, "g", "Acceleration", True, ""), channel(1, 1000, "V", "Voltage", False, "ao0")]
daq = DataAcquisitionParameters(channels, RATE, 512, 1024, 0, None, [NAME], np.ones((2, 1), bool), 1, 1)
lines = np.arange(FRAME // 2 + 1) * RATE / FRAME
target = np.where((lines >= 20) & (lines <= 200), 2e-6, 0.0)  # spectrum of the acceleration, g^2/Hz
limits = np.full((2, lines.size, 1), np.nan)
random = RandomVibrationMetadata(2, RATE, FRAME, 0.5, "Hann", 0.5, 0.5, False, 20, "Hann", 0.5, False,
                                 os.path.join(HERE, "control_laws", "control_laws.py"), "pseudoinverse_control", 0, "",
                                 [0], [1], lines, target[:, None, None].astype(complex), limits, limits, None, None)
random.sysid_frame_size, random.sysid_averaging_type = FRAME, "Linear"
random.sysid_noise_averages, random.sysid_averages, random.sysid_estimator = 5, 20, "H1"
random.sysid_exponential_averaging_coefficient, random.sysid_level, random.sysid_level_ramp_time = 0.1, 0.2, 0.5
random.sysid_signal_type, random.sysid_window, random.sysid_overlap = "Random", "Hann", 0.5
random.sysid_burst_on, random.sysid_pretrigger, random.sysid_burst_ramp_fraction = 0.5, 0.05, 0.05

log = mp.Queue()
def message_queue(name):
    return VerboseMessageQueue(log, name)
commands, data_in, data_out = {NAME: message_queue("environment")}, {NAME: mp.Queue()}, {NAME: mp.Queue()}
controller, window_updates = message_queue("controller"), mp.Queue()
queues = QueueContainer(controller, message_queue("acquisition"), message_queue("output"), message_queue("streaming"),
                        log, mp.Queue(), mp.Queue(), window_updates, commands, data_in, data_out)
acquiring, generating = mp.Value("i", 0), mp.Value("i", 0)
environments = [[ControlTypes.RANDOM, NAME]]
processes = [
    mp.Process(target=all_environment_processes[ControlTypes.RANDOM],
               args=(NAME, commands[NAME], window_updates, controller, log, data_in[NAME], data_out[NAME], acquiring,
                     generating)),
    mp.Process(target=acquisition_process, args=(queues, environments, acquiring)),
    mp.Process(target=output_process, args=(queues, environments, generating)),
]
for process in processes:
    process.start()
# Control errors, dB RMS.
identified, errors, control_errors = threading.Event(), [], []


def relay():
    # The window forwards commands of the environment to acquisition and output.
    both = (queues.acquisition_command_queue, queues.output_command_queue)
    receivers = {GlobalCommands.RUN_HARDWARE: both, GlobalCommands.STOP_HARDWARE: both,
                 GlobalCommands.START_ENVIRONMENT: both[1:], GlobalCommands.STOP_ENVIRONMENT: both[:1]}
    while True:
        message, data = controller.get("test")
        if message == GlobalCommands.COMPLETED_SYSTEM_ID:
            identified.set()
        for receiver in receivers.get(message, ()):
            receiver.put("test", (message, data))


def watch():
    while True:
        sender, update = window_updates.get()[:2]
        if sender == "error":
            errors.append(update)
            print(update, flush=True)
        elif sender == NAME and update[0] == "update_test_response_error_list":
            control_errors.append(float(update[1][0][0]))


def write_log():
    with open("Rattlesnake.log", "w") as file:
        while True:
            file.write(log.get())


for function in (relay, watch, write_log):
    threading.Thread(target=function, daemon=True).start()
commands[NAME].put("test", (GlobalCommands.INITIALIZE_DATA_ACQUISITION, daq))
for command_queue in (queues.acquisition_command_queue, queues.output_command_queue):
    command_queue.put("test", (GlobalCommands.INITIALIZE_DATA_ACQUISITION, (daq, {NAME: [0, 1]})))
commands[NAME].put("test", (GlobalCommands.INITIALIZE_ENVIRONMENT_PARAMETERS, random))
time.sleep(2)
commands[NAME].put("test", (SystemIdCommands.START_SYSTEM_ID, (random, None)))
assert identified.wait(20 + 2 * seconds) or errors, "the system was not identified"
while (acquiring.value or generating.value) and not errors:
    time.sleep(0.1)
if not errors:
    controller.put("test", (GlobalCommands.RUN_HARDWARE, None))
    time.sleep(2)
    commands[NAME].put("test", (RandomVibrationCommands.START_CONTROL, 1.0))
    time.sleep(seconds)
selected = control_errors[:: max(1, len(control_errors) // 10)]
print("control error over time, dB RMS:", " ".join(f"{error:.2f}" for error in selected))
for process in psutil.Process().children(recursive=True):
    process.kill()
passed = bool(control_errors) and not errors and control_errors[-1] < 3.0
result = f"passed, {control_errors[-1]:.2f} dB RMS after {len(control_errors)} updates" if passed else "FAILED"
print("Rattlesnake:", result, flush=True)
os._exit(0 if passed else 1)
"""


def main() -> int:
    """Run the script in the folder of the checkout."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    checkout, *packages = (str(Path(argument).resolve()) for argument in sys.argv[1:])
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), checkout, *packages]))
    os.environ["QT_QPA_PLATFORM"] = "offscreen"
    scene = rig.loads(SCENE)
    with tempfile.TemporaryDirectory() as folder:
        script = Path(folder, "script.py")
        script.write_text(SCRIPT)
        os.chdir(checkout)
        return run_script(script, ["40"], scene, "real")


if __name__ == "__main__":
    raise SystemExit(main())

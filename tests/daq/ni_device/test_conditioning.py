"""Sensor supply, coupling and TEDS of a task act on the bench; the devices are those of the scene."""

import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType, Coupling, ExcitationSource
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.system import System

import daq
import rig
from daq.extras.ni_server.live import LiveRecording
from tests.daq.client import RATE, Task, connect, options, raises_code

SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 1 %}}
shaker: {kind: electrodynamic, body: 1, spring: 6.6 kN/m}
channels:
  - {name: one, at: body 1, accelerometer: {preset: PCB 352C33}}
  - {name: two, at: body 2, accelerometer: {preset: PCB 352C33}}
  - {name: ideal, at: body 2}
converter: {preset: MODULE, rate: 5120 Hz}
"""


def connect_module(module="NI 9234", text=SCENE):
    """Connect to the scene with this input module."""
    scene = rig.loads(text.replace("MODULE", module))
    return connect(scene, "fast")


def standard_deviations(task, samples=4000):
    """Return the standard deviation of each input after the first half of the samples."""
    return np.std(np.atleast_2d(task.read(samples))[:, samples // 2 :], axis=1)


def vibration_levels(source):
    """Return the standard deviations of all inputs, g, while the shaker vibrates.

    `source` supplies the first sensor, the module the second; the third sensor is ideal.
    """
    with Task() as output_task, Task() as task:
        output_task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output_task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output_task.write(0.5 * np.sin(2 * np.pi * 20 * np.arange(256) / RATE))
        for terminal, excitation in enumerate((source, ExcitationSource.INTERNAL, ExcitationSource.NONE)):
            task.ai_channels.add_ai_accel_chan(
                f"cDAQ1Mod1/ai{terminal}",
                sensitivity=100.0,
                min_val=-50.0,
                max_val=50.0,
                current_excit_source=excitation,
                current_excit_val=0.002,
            )
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=4000)
        output_task.start()
        return standard_deviations(task)


def test_sensor_without_supply_has_no_signal():
    connect_module()
    supplied = vibration_levels(ExcitationSource.INTERNAL)
    connect_module()
    unsupplied = vibration_levels(ExcitationSource.NONE)
    assert supplied[0] > 1e-2  # g
    assert unsupplied[0] < 1e-3 * supplied[0]
    # The other inputs are unaffected; the sensor without an internal amplifier works even without supply.
    np.testing.assert_allclose(unsupplied[1:], supplied[1:], rtol=1e-3)


def test_dc_coupling_shows_bias():
    connect_module("USB-4431")
    with Task() as task:
        channel = task.ai_channels.add_ai_voltage_chan("Dev1/ai0", min_val=-10, max_val=10)
        channel.ai_excit_src, channel.ai_excit_val = ExcitationSource.INTERNAL, 0.0021
        for coupling, bias in ((Coupling.DC, 9.0), (Coupling.AC, 0.0)):  # bias of the sensor, V
            task.stop()
            channel.ai_coupling = coupling
            task.timing.cfg_samp_clk_timing(1280.0, samps_per_chan=16000)
            assert np.mean(task.read(16000, timeout=20.0)[-1000:]) == pytest.approx(bias, abs=0.1)


def test_ac_only_module_rejects_dc():
    connect_module()
    with Task() as task:
        channel = task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0", current_excit_val=0.002)
        channel.ai_coupling = Coupling.DC
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=10)
        with raises_code(Code.INVALID_ATTRIBUTE_VALUE, "AC coupling only"):
            task.start()


def test_different_coupling_of_used_input_is_rejected():
    connect_module()
    with Task() as first, Task() as second:
        first.ai_channels.add_ai_accel_chan("Dev1/ai0", current_excit_val=0.002)
        second.ai_channels.add_ai_voltage_chan("Dev2/ai0")
        for task in (first, second):
            task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        first.start()
        with raises_code(Code.PAL_RESOURCE_RESERVED, "a different coupling or sensor supply"):
            second.start()


def test_teds_sets_sensitivity():
    connect_module()
    terminals = System.remote(options()).devices["cDAQ1Mod1"].ai_physical_chans
    sensor = terminals["ai0"]
    # Manufacturer 25 (PCB), model 352, template 25 (accelerometer).
    assert (sensor.teds_mfg_id, sensor.teds_model_num, sensor.teds_template_ids) == (25, 352, [25])
    assert sensor.teds_serial_num != terminals["ai1"].teds_serial_num
    with Task() as task:
        channels = task.ai_channels.add_teds_ai_accel_chan("cDAQ1Mod1/ai0:1", "acc", min_val=-40, max_val=40)
        assert task.channel_names == ["acc0", "acc1"]
        assert channels.ai_accel_sensitivity == pytest.approx(0.1, rel=2e-4)  # V/g
        with raises_code(Code.TEDS_SENSOR_NOT_DETECTED):
            task.ai_channels.add_teds_ai_accel_chan("cDAQ1Mod1/ai2")


def test_named_device_is_outside_chassis():
    text = SCENE.replace("6.6 kN/m}", "6.6 kN/m, output: {preset: USB-4431}}")
    connect_module("USB-4431", text)
    (device,) = System.remote(options()).devices
    assert (device.name, device.product_type) == ("Dev1", "USB-4431")
    assert [len(device.ai_physical_chans), len(device.ao_physical_chans)] == [3, 1]
    assert device.ao_voltage_rngs == [-3.5, 3.5]
    with Task() as task:
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=-3.5, max_val=3.5)
        with raises_code(Code.SAMP_CLK_RATE_MUST_BE_SPECD):
            task.write(1.0)
        task.timing.cfg_samp_clk_timing(96e3)
        assert task.timing.samp_clk_rate == 96e3


def test_shakers_follow_their_own_outputs():
    shaker = "shaker: {kind: electrodynamic, body: 1, spring: 6.6 kN/m}"
    two_shakers = (
        "shaker:\n  - {kind: electrodynamic, body: 1, spring: 6.6 kN/m, output: {preset: NI 9260}}\n"
        "  - {kind: electrodynamic, body: 2, spring: 6.6 kN/m, output: {preset: NI 9260}}"
    )
    text = SCENE.replace(shaker, two_shakers).replace(
        "converter", "  - {name: first, at: drive 1}\n  - {name: second, at: drive 2}\nconverter"
    )
    connect_module(text=text)
    devices = System.remote(options()).devices
    # Vibration controllers start their outputs with the inputs by this terminal.
    assert "/cDAQ1/ai/StartTrigger" in devices["cDAQ1Mod3"].compact_daq_chassis_device.terminals
    assert [device.product_type for device in devices] == ["cDAQ-9178", "NI 9234", "NI 9234", "NI 9260 (BNC)"]
    # The outputs have different numbers of periods in 512 samples.
    output_volts = np.stack([np.sin(2 * np.pi * n * np.arange(512) / 512) for n in (4, 11)])
    with Task() as output_task, Task() as task:
        output_task.ao_channels.add_ao_voltage_chan("cDAQ1Mod3/ao0:1", min_val=-4, max_val=4)
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai3,cDAQ1Mod2/ai0", min_val=-5, max_val=5)
        output_task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=8192)
        output_task.write(output_volts, auto_start=True)
        spectra = np.abs(np.fft.rfft(np.array(task.read(8192))[:, -512:], axis=1)) / 256
    assert np.argmax(spectra, axis=1).tolist() == [4, 11]
    assert spectra[0, 11] < 1e-3 > spectra[1, 4]


def test_changed_supply_starts_new_recording(tmp_path):
    chassis = connect_module()
    recording = LiveRecording(chassis, tmp_path / "run.mcap")
    with Task() as task:
        channel = task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0", current_excit_val=0.002)
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=50)
        for source in (ExcitationSource.INTERNAL, ExcitationSource.INTERNAL, ExcitationSource.NONE):
            channel.ai_excit_src = source
            task.read(50)
            task.stop()
    recording.close()
    supplies = [daq.open(path).channels["one"].sensor["converter.excitation"] for path in recording.paths]
    assert [supply.split() for supply in supplies] == [["0.002", "A"], ["0.0", "A"]]

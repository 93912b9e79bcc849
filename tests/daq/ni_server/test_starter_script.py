"""The script that `daq serve` prints reads all sensors; a task that leaves a sensor without supply is reported."""

import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import ExcitationSource

import daq
import rig
from daq.extras.ni_server.script import run_script
from daq.extras.ni_server.serve import announcement
from daq.extras.ni_server.starter_script import report_missing_excitation

SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 1 %}}
shaker: {kind: force, body: 1}
test: {kind: free, mode: 1, amplitude: 1 mm, duration: 10 s}
channels: [CHANNELS]
converter: {CONVERTER, rate: 5120 Hz}
"""
IEPE = "accelerometer: {sensitivity: 100 mV/g, iepe: true}"
# Sensors that need a supply current, and sensors that do not.
SENSORS = """{name: one, at: body 1, IEPE}, {name: two, at: body 2, IEPE},
  {name: rough, at: body 2, accelerometer: {sensitivity: 13.7 mV/g, iepe: true}},
  {name: plain, at: body 2, accelerometer: {sensitivity: 10 mV/g}},
  {name: speed, at: body 2, IEPE, integrator: {order: 1, gain: 10}},
  {name: force, at: shaker, hammer: {preset: PCB 208C02}}""".replace("IEPE", IEPE)


def make_scene(channels, converter):
    """Return the scene with these channels and keys of the converter."""
    return rig.loads(SCENE.replace("CHANNELS", channels).replace("CONVERTER", converter))


def printed_script(connection):
    """Return the script that `daq serve` prints for clients."""
    port = int(connection.address.rpartition(":")[2])
    return announcement(connection.chassis, "127.0.0.1", port, encrypted=False).rpartition("\n\n")[2]


@pytest.mark.parametrize(
    ("channels", "converter", "n_channels"),
    [
        (SENSORS, "preset: NI 9234", 6),
        (SENSORS, "preset: NI 9234, coupling: DC", 6),
        # Channels of separate devices cannot be in one task.
        (SENSORS, "preset: USB-4431", 4),
        ("{name: one, at: body 1}, {name: two, at: body 2}", "bits: 24, range: 500 V", 2),
        ("{name: one, at: body 1}", "sampling: point", 1),
    ],
    ids=["IEPE", "DC coupling", "separate device", "ideal sensors", "one channel"],
)
def test_starter_script_reads_sensors(channels, converter, n_channels, capsys):
    blocks = []
    with daq.connect(make_scene(channels, converter), clock="fast") as connection:
        chassis = connection.chassis
        chassis.listeners.append(lambda source, block: blocks.append(source.to_units(block.samples)))
        report_missing_excitation(chassis)
        namespace = {}
        exec(printed_script(connection), namespace)
        infos = connection.sensors[:n_channels]
    data = np.atleast_2d(namespace["data"])
    expected = np.concatenate(blocks, axis=1)[:n_channels, :1000]
    # Velocity channels are read in volts.
    volts_per_unit = [info.sensitivity if info.quantity == "velocity" else 1.0 for info in infos]
    np.testing.assert_allclose(data, expected * np.array(volts_per_unit)[:, None], rtol=1e-6, atol=1e-9)
    # The lower mode with an amplitude of 1 mm has 9 m/s^2 at body 1 and 15 m/s^2 at body 2; ranges are twice that.
    accelerometers = [row for row, info in enumerate(infos) if info.quantity == "acceleration"]
    assert np.all(np.ptp(data[accelerometers], axis=1) > 10.0)
    out, err = capsys.readouterr()
    assert str(namespace["data"]) in out
    assert err == ""


def test_starter_script_waits_until_sensors_settle(capsys):
    channels = "{name: a, at: body 1, accelerometer: {preset: PCB 352C33}}, {name: f, at: shaker, hammer: {iepe: true}}"
    with daq.connect(make_scene(channels, "preset: NI 9234"), clock="fast") as connection:
        script, namespace = printed_script(connection), {}
        exec(script, namespace)
    # The structure is at rest long before; the step of the bias at power-on reads as 19 m/s^2 rms.
    assert namespace["data"].shape == (2, 1000)
    assert namespace["data"][0].std() < 0.01
    assert "    # After power-on, the bias of the sensors settles" in script
    assert str(namespace["data"]) in capsys.readouterr().out


def test_sensors_without_excitation_are_reported_once(capsys):
    with daq.connect(make_scene(SENSORS, "preset: NI 9234"), clock="fast") as connection:
        report_missing_excitation(connection.chassis)

        def read(terminals, source):
            with nidaqmx.Task(grpc_options=connection) as task:
                task.ai_channels.add_ai_accel_chan(terminals, current_excit_source=source, current_excit_val=0.002)
                task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=10)
                task.read(10)
            return capsys.readouterr().err

        assert read("cDAQ1Mod1/ai0", ExcitationSource.INTERNAL) == ""
        message = read("cDAQ1Mod1/ai0,cDAQ1Mod1/ai3", ExcitationSource.NONE)
        assert "no excitation for cDAQ1Mod1/ai0 (one): " in message
        assert "ai_excit_val to 0.002" in message
        assert "no excitation for cDAQ1Mod1/ai1 (two): " in read("cDAQ1Mod1/ai0:1", ExcitationSource.NONE)
        assert read("cDAQ1Mod1/ai0:1", ExcitationSource.NONE) == ""


def test_script_without_excitation_is_reported(tmp_path, capfd):
    script = tmp_path / "script.py"
    script.write_text("""
import nidaqmx
with nidaqmx.Task() as task:
    task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3")
    task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=10)
    print(len(task.read(10)))
""")
    assert run_script(script, scene=make_scene(SENSORS, "preset: NI 9234"), clock="fast") == 0
    out, err = capfd.readouterr()
    assert out == "4\n"
    assert "no excitation for cDAQ1Mod1/ai0 (one), cDAQ1Mod1/ai1 (two), cDAQ1Mod1/ai2 (rough): " in err

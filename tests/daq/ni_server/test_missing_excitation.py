"""A task that samples a sensor without its supply is reported."""

import nidaqmx
from nidaqmx.constants import ExcitationSource

import daq
import rig
from daq.extras.ni_server.missing_excitation import report_missing_excitation
from daq.extras.ni_server.script import run_script

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

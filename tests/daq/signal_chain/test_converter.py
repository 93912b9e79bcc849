"""Converters: quantization, clipping, clock, skew and jitter; data sheets of modules and sensors as presets."""

import numpy as np
import pytest

from daq.core.signal_chain.converter import Quantizer
from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import data_sheets
from rig.core.scene.measurement_chain import Accelerometer, Hammer
from rig.core.scene.measurement_chain import Converter as Settings
from rig.core.scene.presets import complete_from_preset
from tests.daq.dsp.analytic_motion import PointMotion, at_rest, chain_of, motion_of, scene_of


def test_count_is_range_over_number_of_codes():
    chain, _ = chain_of(scene_of("", converter="{bits: 16, range: 5 V}"))
    converter = Quantizer(Settings(bits=16, range=5.0))
    assert chain.channels[0].volts_per_count == 10.0 / 2**16
    assert chain.channels[0].range == 5.0
    samples, overload = converter.convert(np.array([[0.0, 1.0, -5.0, 5.0, 4.99995, -7.0]]))
    assert samples.dtype == np.int32
    # 1 V is 6553.6 counts; the codes of 16 bits are -32768 to 32767.
    assert samples.tolist() == [[0, 6554, -32768, 32767, 32767, -32768]]
    assert overload.tolist() == [[False, False, False, True, True, True]]


def test_range_without_bits_clips():
    samples, overload = Quantizer(Settings(range=5.0)).convert(np.array([[1.25, -6.0]]))
    assert samples.tolist() == [[1.25, -5.0]]
    assert overload.tolist() == [[False, True]]


def test_ideal_converter_passes_volts():
    volts = np.array([[1e6, -3.3]])
    samples, overload = Quantizer(Settings()).convert(volts)
    assert np.array_equal(samples, volts)
    assert not overload.any()


def test_full_range_stays_in_32_bits():
    samples, _ = Quantizer(Settings(bits=32, range=1.0)).convert(np.array([[2.0, -2.0]]))
    assert samples.tolist() == [[2**31 - 1, -(2**31)]]


@pytest.mark.parametrize("bits", [8, 16, 24])
def test_quantization_noise_variance_is_a_twelfth_count_squared(bits):
    volts = 3.0 * np.sin(np.arange(400_000) * 0.1234567)[None]
    converter = Quantizer(Settings(bits=bits, range=5.0))
    count = 10.0 / 2.0**bits
    error = converter.convert(volts)[0] * count - volts
    assert error.var() == pytest.approx(count**2 / 12, rel=0.02)


@pytest.mark.parametrize(
    ("requested", "expected"),
    [
        (51200.0, 51200.0),
        (8000.0, 51200 / 6),
        (5000.0, 5120.0),
        (5120.0, 5120.0),
        (17067.0, 51200 / 3),
        (100.0, 51200 / 31),
    ],
)
def test_module_clock_selects_next_rate(requested, expected):
    assert Settings(preset="NI 9234", rate=requested).sample_rate == pytest.approx(expected, rel=1e-12)


def test_error_names_rates_of_module():
    with pytest.raises(SceneError, match=r"rate: got 60000 Hz; expected 1651\.61 to 51200 Hz"):
        Settings(preset="NI 9234").replace(rate=60e3)


def test_rate_without_module_is_not_coerced():
    settings = Settings(rate=1234.5)
    assert settings.sample_rate == settings.true_rate == 1234.5


def test_clock_error_changes_only_true_rate():
    settings = Settings(preset="NI 9234", rate=8000.0, clock_error=50e-6)
    assert (settings.sample_rate, settings.true_rate) == (51200 / 6, 51200 / 6 * 1.00005)


def test_dropped_blocks_are_listed():
    blocks = [{"at": 0.2, "samples": 10}, {"at": 0.1, "samples": 5}, {"at": 0.1005, "samples": 6}]
    # The samples 100 to 104 and (at 0.1005 s, rounded to sample 100) 100 to 105 are merged.
    assert Quantizer(Settings(rate=1000.0, dropped_blocks=blocks)).lost == ((100, 105), (200, 209))


def test_module_preset_applies():
    scene = scene_of("", converter="{preset: NI 9234, rate: 5120 Hz}")
    chain, rate = chain_of(scene)
    assert chain.channels[0].volts_per_count == 10.0 / 2**24
    assert list(chain.effects["c1"]) == [
        "AC coupling", "decimation filter", "converter noise", "clipping", "quantization",
    ]  # fmt: skip
    volts = chain.measure(at_rest(1, rate, 60_000))[0]
    density = 0.31e-6  # V/sqrt(Hz), of the preset
    assert volts.std() == pytest.approx(density * np.sqrt(rate / 2), rel=0.02)


def test_presets_settle_and_read_a_tone():
    scene = scene_of(", accelerometer: {preset: pcb 352c33}", converter="{preset: NI 9234, rate: 5120 Hz}")
    chain, rate = chain_of(scene)
    volts = chain.measure(motion_of([PointMotion(tones=((10.0, 80.0, 0.0),))], rate, round(12 * rate)))[0]
    last_second = volts[-5120:] / chain.channels[0].sensitivity
    # In the first second, the bias of the sensor has not settled.
    assert np.abs(volts[: round(rate)]).max() > 0.5
    assert abs(last_second.mean()) < 1.0
    # The tolerance of the sensor's sensitivity is 10 %.
    assert np.ptp(last_second) / 2 == pytest.approx(10.0, rel=0.11)


@pytest.mark.parametrize("channel_keys", ["", ", integrator: {order: 1, corner: 1 Hz}", ", integrator: {order: 2}"])
@pytest.mark.parametrize("filter_key", ["", ", filter: delta_sigma"])
def test_skewed_channels_are_sampled_earlier(channel_keys, filter_key):
    rate = 5120.0
    impacts = ((0.0123, 0.3), (0.01234, -0.1), (70.0 / rate, 0.2), (0.0301, 0.4))
    channels = [channel_keys] * 3
    skewed, _ = chain_of(scene_of(*channels, converter=f"{{skew: 40 us{filter_key}}}"))
    simultaneous, _ = chain_of(scene_of(*channels, converter=f"{{rate: 5120 Hz{filter_key}}}"))
    delays = np.array([info.delay for info in skewed.channels]) - simultaneous.channels[0].delay
    assert delays == pytest.approx([80e-6, 40e-6, 0.0], abs=1e-15)
    delayed_paths = [PointMotion(impacts=tuple((t + delay, v) for t, v in impacts)) for delay in delays]
    volts = skewed.measure(motion_of([PointMotion(impacts=impacts)] * 3, rate, 300))
    expected = simultaneous.measure(motion_of(delayed_paths, rate, 300))
    assert volts == pytest.approx(expected, abs=1e-11 * np.abs(expected).max())


def test_skewed_tone_has_stated_phase():
    skewed, rate = chain_of(scene_of("", "", converter="{skew: 60 us}"))
    simultaneous, _ = chain_of(scene_of("", ""))
    motion = motion_of([PointMotion(tones=((50.0, 60.0, -np.pi / 2),))] * 2, rate, 5120)
    # The complex amplitudes over the second half second, 30 periods.
    demodulation = np.exp(-2j * np.pi * 60.0 / rate * np.arange(2560, 5120)) / 1280
    amplitudes, expected = (chain.measure(motion)[:, 2560:] @ demodulation for chain in (skewed, simultaneous))
    for row in range(2):
        stated = skewed.channels[row].response(60.0) / simultaneous.channels[row].response(60.0)
        assert amplitudes[row] / expected[row] == pytest.approx(complex(stated), rel=1e-9)


def test_total_skew_over_sample_interval_is_rejected():
    with pytest.raises(SceneError, match=r"converter\.skew"):
        chain_of(scene_of("", "", "", converter="{rate: 5120 Hz, skew: 100 us}"))


@pytest.mark.parametrize("channel_keys", ["", ", integrator: {order: 1}"])
@pytest.mark.parametrize("filter_key", ["", ", filter: delta_sigma"])
def test_jitter_noise_is_slope_times_jitter(channel_keys, filter_key):
    rate, frequency, jitter = 5120.0, 200.0, 1e-6
    omega = 2 * np.pi * frequency
    path = PointMotion(tones=((100.0, frequency, 0.0),))
    jittered, _ = chain_of(scene_of(channel_keys, channel_keys, converter=f"{{jitter: {jitter}{filter_key}}}"))
    without_jitter, _ = chain_of(scene_of(channel_keys, channel_keys, converter=f"{{rate: 5120 Hz{filter_key}}}"))
    motion = motion_of([path] * 2, rate, 40_000)
    error = (jittered.measure(motion) - without_jitter.measure(motion))[:, 200:]
    amplitude = 100.0 / (omega if channel_keys else 1.0)
    assert error[0].std() == pytest.approx(amplitude * omega * jitter / np.sqrt(2), rel=0.02)
    # All channels have the same clock.
    assert np.array_equal(error[0], error[1])


DATA_SHEETS = [
    (sheet, kind)
    for sheet in data_sheets().values()
    for kind in sheet.settings
    if kind not in ("output", "shaker")  # These are tested with the shakers.
]


@pytest.mark.parametrize(("sheet", "kind"), DATA_SHEETS, ids=lambda value: getattr(value, "name", value))
def test_preset_values_are_valid_and_sourced(sheet, kind):
    settings = {"accelerometer": Accelerometer, "hammer": Hammer, "converter": Settings}[kind]
    completed = complete_from_preset(settings(preset=sheet.name.lower().replace(" ", "-")))
    assert {key for key in sheet.settings[kind] if getattr(completed, key) is None} == set()
    assert sheet.sources


def test_explicit_value_overrides_preset():
    settings = complete_from_preset(Accelerometer(preset="PCB 352C33", sensitivity="98 mV/g"))
    assert settings.sensitivity == pytest.approx(0.098 / 9.80665)
    assert settings.resonance == 50e3


def test_error_of_invalid_value_names_preset():
    with pytest.raises(SceneError, match="PCB 086C03"):
        complete_from_preset(Hammer(preset="PCB 086C03").model_copy(update={"saturation": -1.0}))


def test_channel_lists_settings_of_its_devices():
    scene = scene_of(
        ", accelerometer: {resonance: 30 kHz}, integrator: {order: 1, corner: 1 Hz}", converter="{excitation: 2 mA}"
    )
    assert chain_of(scene)[0].channels[0].sensor == {
        "accelerometer.resonance": "30000.0 Hz",
        "integrator.order": "1",
        "integrator.corner": "1.0 Hz",
        "converter.excitation": "0.002 A",
    }

"""Aliasing errors of frequency responses, compared with sums on a fine grid.

A drive that is linear between samples contains images of each tone, at multiples of the sample rate plus and minus its
frequency. Without a filter, the response to the images is aliased to the frequency of the tone.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.responses.errors.aliasing import _free_acceleration, _impact_ratio, aliasing_limit
from analysis.core.responses.errors.systematic import ALIASING, ChannelContributions
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.results.response import MOTIONS

RATE = 5120.0  # Hz
SAMPLES = 512  # Samples of a period of the drive.
POINTS_PER_SAMPLE = 64  # Points of the fine grid in a sample interval.
CYCLES = np.array([4, 32, 128, 200])  # Cycles of the tones in a period of the drive.
FREQUENCY = CYCLES * RATE / SAMPLES
FILTER = {"rate": RATE, "delay": 38.0, "cutoff": 0.5, "beta": 11.0}
# Smallest assumed images, relative to the reading.
MIN_IMAGES = 0.1 * (FREQUENCY / RATE) ** 2
SCENE = "{structure: {masses: [2 kg], springs: [4 kN/m]}, shaker: {kind: force, body: 1}}"


def image_ratio(info, cycles):
    """Return the sum of a channel's readings of the images of a tone, relative to its reading of the tone."""
    samples = np.exp(2j * np.pi * cycles * np.arange(SAMPLES + 1) / SAMPLES)
    fraction = np.arange(POINTS_PER_SAMPLE) / POINTS_PER_SAMPLE
    drive = np.fft.fft((samples[:-1, None] * (1 - fraction) + samples[1:, None] * fraction).ravel())
    reading = abs(drive * info.response(np.fft.fftfreq(drive.size, 1 / (RATE * POINTS_PER_SAMPLE))))
    tone_and_images = reading.reshape(POINTS_PER_SAMPLE, SAMPLES)[:, cycles]
    return tone_and_images[1:].sum() / tone_and_images[0]


def aliasing_bounds(info, value, motion="acceleration", scene=SCENE, reference_share=0.0):
    """Return the bounds of the error due to images in channel `info`; the other channel is filtered.

    `reference_share`: 0 if `info` is the response, 1 if it is the reference.
    """
    other = ChannelInfo("b", "body 1", "acceleration", 1.0, RATE, filter=FILTER)
    rec = SimpleNamespace(source="", channels={info.name: info, "b": other}, scene=rig.loads(scene, where="a test"))
    in_response = np.array([[1.0 - reference_share], [reference_share]]) * np.ones(value.size)
    in_reference = in_response[::-1]
    contributions = ChannelContributions([info.name, "b"], FREQUENCY, motion, value, value * in_response, in_reference)
    return aliasing_limit(rec, contributions)


def relative_to_reading(ratio):
    """Return the error relative to the reading, if images reduce the reading by a ratio of the true value."""
    return ratio / (1.0 - ratio)


def channel(at="body 1", quantity="acceleration", **chain):
    return ChannelInfo("a", at, quantity, sensitivity=1.0, rate=RATE, **chain)


def test_images_of_flat_acceleration_are_bounded():
    value = np.full(4, 0.5 + 0.2j)
    low_pass = channel(poles=(-2 * np.pi * 100.0,), gain=2 * np.pi * 100.0)
    for info in (channel(), low_pass, channel(average=True)):
        expected = np.array([image_ratio(info, cycles) for cycles in CYCLES]) * abs(value)
        [bound] = aliasing_bounds(info, value).values()
        assert (bound >= expected).all()
        assert (bound <= np.maximum(1.25 * expected, MIN_IMAGES * abs(value))).all()


def test_bound_of_suppressed_images_is_not_zero():
    # The images of a force still move the body that it drives.
    low_pass = channel(poles=(-2 * np.pi * 1.0,) * 4, gain=(2 * np.pi * 1.0) ** 4)
    value = np.full(4, 0.5 + 0.2j)
    [bound] = aliasing_bounds(low_pass, value).values()
    np.testing.assert_allclose(bound[:2], (MIN_IMAGES * abs(value))[:2], rtol=1e-12)


def test_decimation_filter_has_no_images():
    filtered = channel(filter=FILTER)
    assert aliasing_bounds(filtered, np.ones(4, dtype=complex)) == {}


def test_images_are_those_of_acceleration_above_band():
    # The acceleration at the upper end of the band is 1; a larger acceleration below it has relatively smaller images.
    peak = np.array([1.0, 1.0, 4.0, 1.0], dtype=complex)
    for motion, order in (("acceleration", 2), ("velocity", 1), ("displacement", 0)):
        value = peak / FREQUENCY ** (2 - order)
        body_limit, drive_limit = (
            next(iter(aliasing_bounds(channel(at), value, motion).values())) for at in ("body 1", "drive")
        )
        np.testing.assert_allclose(body_limit, drive_limit / peak.real)


def test_steadily_falling_acceleration_uses_band_edge():
    falling = np.array([8.0, 4.0, 2.0, 1.0], dtype=complex)
    body_limit, drive_limit = (next(iter(aliasing_bounds(channel(at), falling).values())) for at in ("body 1", "drive"))
    np.testing.assert_allclose(body_limit, drive_limit / falling.real)


def test_modes_above_band_increase_driven_acceleration():
    value = np.full(4, 0.005 + 0.002j)
    mass = 2.0  # kg, of the driven body in SCENE
    expected = np.array([image_ratio(channel(), cycles) for cycles in CYCLES]) / mass
    for motion in MOTIONS:
        # The same acceleration, integrated to velocity or displacement.
        conversion = (2.0 * np.pi * FREQUENCY) ** (2 - MOTIONS.index(motion))
        [bound] = aliasing_bounds(channel(), value / conversion, motion).values()
        assert (bound * conversion >= expected).all()
        assert (bound * conversion <= 1.25 * expected).all()


@pytest.mark.parametrize("reference_share", [0.0, 1.0])
def test_table_drive_images_are_bounded(reference_share):
    scene = SCENE.replace("kind: force, body: 1", "kind: table, body: 1, spring: 6 kN/m, bandwidth: 700 Hz")
    value = np.full(4, 0.5 + 0.2j)
    [bound] = aliasing_bounds(channel("table"), value, scene=scene, reference_share=reference_share).values()
    for column, (frequency, cycles) in enumerate(zip(FREQUENCY, CYCLES, strict=True)):
        # After two differentiations an image is as large as the tone; only the second-order servo attenuates it.
        servo = SimpleNamespace(response=lambda f: -((2 * np.pi * f) ** 2) / (1.0 + 1j * f / 700.0) ** 2)
        ratio = image_ratio(servo, cycles)
        # A reading that is too small has the larger relative error, unless it is the reading of the reference
        # (denominator).
        expected = (ratio if reference_share else relative_to_reading(ratio)) * abs(value[column])
        assert expected <= bound[column] <= 1.25 * expected, frequency


def coil_drive(frequency, mode, force):
    """Compute the drive of a moving coil for a motion of 1 m against a force in N, from its equations of motion."""
    mass, damping, stiffness = 0.3, 60.0, 9e3  # kg, N s/m, N/m
    resistance, inductance, force_factor = 3.0, 4e-3, 12.0  # ohm, H, N/A
    s = 2j * np.pi * frequency
    # Unknowns: current and drive. Equations: of the armature, then of the coil or its current source.
    motion = mass * s**2 + damping * s + stiffness + force
    equations = np.zeros((*motion.shape, 2, 2), dtype=complex)
    equations[..., 0, 0], equations[..., 1, 1] = force_factor, -1.0
    equations[..., 1, 0] = resistance + s * inductance if mode == "voltage" else 1.0
    induced = -force_factor * s if mode == "voltage" else 0.0
    right = np.stack(np.broadcast_arrays(motion, induced), axis=-1)
    return np.linalg.solve(equations, right[..., None])[..., 1, 0]


# At an image, the force of the stiff spring is comparable to the inertia force of the armature.
@pytest.mark.parametrize("spring", [6e3, 2e8])
@pytest.mark.parametrize("mode", ["voltage", "current"])
def test_coil_drive_images_are_bounded(mode, spring):
    armature = "mass: 0.3 kg, damping: 60 N s/m, stiffness: 9 kN/m"
    coil = "resistance: 3 ohm, inductance: 4 mH, force_factor: 12 N/A"
    settings = f"armature: {{{armature}}}, coil: {{{coil}}}, amplifier: {{mode: {mode}}}"
    scene = SCENE.replace("kind: force", f"kind: electrodynamic, spring: {spring} N/m, {settings}")
    value = np.full(4, 0.5 + 0.2j)
    [bound] = aliasing_bounds(channel("table"), value, scene=scene, reference_share=1.0).values()

    def acceleration_per_drive(frequency):
        """Return the acceleration for a drive with the structure fixed; zero for a shaker at rest."""
        return -((2 * np.pi * frequency) ** 2) / coil_drive(np.maximum(abs(frequency), 1e-6), mode, spring)

    for column, (frequency, cycles) in enumerate(zip(FREQUENCY, CYCLES, strict=True)):
        # The force on the table is the spring force, with any phase.
        phases = np.exp(2j * np.pi * np.arange(64) / 64)
        drives = abs(coil_drive(frequency, mode, spring * phases))
        expected = image_ratio(SimpleNamespace(response=acceleration_per_drive), cycles) * drives.max() / drives[0]
        assert 0.99 * expected * abs(value[column]) <= bound[column] <= 1.25 * expected * abs(value[column]), frequency


MASSES = """
structure: {matrices: {mass: [[2.0, 0.5], [0.5, 1.0]], stiffness: [[8e+3, -4e+3], [-4e+3, 4e+3]]}}
dampers:
  - {body: 1, mass: 0.2 kg, clearance: 1 mm}
  - {body: 1, mass: 0.1 kg, clearance: .inf}
  - {body: 1, mass: 0.4 kg, clearance: 1 mm, locked: true}
  - {body: 1, mass: 0.8 kg, clearance: 0 mm}
  - {body: 1, mass: 1.6 kg, clearance: 1 mm, contact: {duration: 2 ms}}
  - {body: 2, mass: 0.3 kg, clearance: 1 mm}
shaker: {kind: force, body: 2}
"""


def test_only_instantaneous_impacts_increase_images():
    scene = rig.loads(MASSES, where="a test")
    # With the other body free, the apparent mass of a 2 kg body is 2 - 0.5^2 / 1 kg.
    assert _impact_ratio(scene, 1) == pytest.approx((0.2 + 0.1) / (2.0 - 0.25))
    assert _impact_ratio(scene, 2) == pytest.approx(0.3 / (1.0 - 0.125))
    assert _free_acceleration(scene, 1) == 0.0
    assert _free_acceleration(scene, 2) == pytest.approx(1.0 / (1.0 - 0.125))


def test_imported_recordings_have_no_images():
    info = channel()
    scene = rig.loads(SCENE, where="a test")
    value, in_response = np.ones(4, dtype=complex), np.ones((1, 4), dtype=complex)
    for source, errors in (("other.uff", set()), ("", {ALIASING})):
        rec = SimpleNamespace(source=source, channels={"a": info}, scene=scene)
        contributions = ChannelContributions(["a"], FREQUENCY, "acceleration", value, in_response, 0.0 * in_response)
        assert set(aliasing_limit(rec, contributions)) == errors


IMPACTS = """
structure: {masses: [1 kg], springs: [12.8 kN/m], damping: {modal: 0.5 %}}
dampers: [{body: 1, mass_ratio: 9 %, clearance: 1.5 mm}]
shaker: {kind: force, body: 1}
test: {kind: stepped_sine, frequencies: [14 Hz, 21 Hz], force: 13 N}
channels: [{name: a, at: body 1, accelerometer: {}}, {name: force, at: shaker}]
converter: {rate: 1024 Hz, sampling: point}
"""


def test_error_due_to_impacts_between_samples_is_bounded(tmp_path):
    scene = rig.loads(IMPACTS, where="a test")
    exact = rig.orbit_response(scene, [14.0, 21.0]).compliance[0]
    for sampling, expected_limit in (("point", 0.09), ("average", 0.002)):
        path = tmp_path / f"{sampling}.mcap"
        daq.record(scene.replace(converter=scene.converter.replace(sampling=sampling)), path)
        with daq.open(path) as rec:
            [[frf]] = analysis.frequency_responses(rec)
        error = abs(frf.value - exact) / abs(exact)
        aliasing_limit = frf.limits[ALIASING] / abs(frf.value)
        assert (error > 0.03).all() == (sampling == "point")
        assert (error <= frf.bound(0.95) / abs(frf.value)).all()
        assert (aliasing_limit < 1.2 * expected_limit).all()

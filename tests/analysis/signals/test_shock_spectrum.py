"""Shock response spectra of recordings: channels with different sensors, options, and their messages."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.decays.sensor_correction import correct_motion, corrected_pieces
from analysis.core.recordings.slices import Slice
from analysis.core.signals.shock_spectrum import _median
from daq.core.dsp.shock_response import shock_response
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from tests.peak_memory import peak_memory

HIT = Path(__file__).parents[3] / "recordings" / "demo-impulse-no-damper.mcap"


@pytest.fixture(scope="module")
def hits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hit measured by an ideal accelerometer, a real one, and an integrator; and its force."""
    integrator = {"order": 2, "corner": "1 Hz"}
    sensor = {"sensitivity": "10 mV/(m/s^2)", "low_cutoff": "0.5 Hz", "resonance": "20 kHz"}
    scene = rig.load("fig4-structure").replace(
        test={"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "interval": "2 s"},
        channels=[
            {"name": "ideal", "at": "body 1"},
            {"name": "real", "at": "body 1", "accelerometer": sensor},
            {"name": "displacement", "at": "body 1", "accelerometer": sensor, "integrator": integrator},
            {"name": "hammer", "at": "hammer"},
        ],
        converter={"rate": 5120.0},
    )
    return daq.record(scene, tmp_path_factory.mktemp("hits") / "hit.mcap")


@pytest.mark.parametrize("name", ["real", "displacement"])
def test_spectrum_is_independent_of_sensor(hits: Path, name: str) -> None:
    ideal = analysis.srs(hits, "ideal", highest=300.0).maximax
    assert analysis.srs(hits, name, highest=300.0).maximax == pytest.approx(ideal, rel=0.02)


def test_spectrum_is_that_of_samples(hits: Path) -> None:
    with daq.open(hits) as rec:
        spectrum = analysis.srs(rec, "hammer", lowest=20.0, q=20.0)
        expected = shock_response([rec.read("hammer")], rec.rate, spectrum.frequency, 20.0)
    assert spectrum.unit == "N"
    assert spectrum.positive == pytest.approx(expected[0], rel=0.02)


def test_memory_of_correction_is_seven_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.core.decays.sensor_correction._BLOCK_LINES", 1 << 10)
    with daq.open(HIT) as rec:
        info, samples = rec.channels["body3"], rec.read("body3")
        peak, _ = peak_memory(correct_motion, info, samples, "acceleration", 1.0, 1000.0)
    assert peak < 7.5 * samples.nbytes


@pytest.mark.parametrize("name", ["ideal", "real", "displacement"])
def test_spectrum_is_independent_of_parts(hits: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    options = {"lowest": 100.0, "highest": 900.0}
    parts = analysis.srs(hits, name, **options)
    monkeypatch.setattr("analysis.core.signals.shock_spectrum._MARGIN_PERIODS", 1000.0)
    whole = analysis.srs(hits, name, **options)
    assert parts.positive == pytest.approx(whole.positive, rel=1e-4)
    assert parts.negative == pytest.approx(whole.negative, rel=1e-4)


def test_memory_is_independent_of_length() -> None:
    info, cycle = ChannelInfo("a", "body 1", "acceleration", 0.01, 1000.0), np.random.default_rng(0).normal(size=1000)

    def read(start: int, stop: int) -> Array:
        return cycle[np.arange(start, stop) % 1000]

    def spectrum(count: int) -> None:
        pieces = corrected_pieces(info, read, count, "acceleration", 1.0, 400.0, 20_000)
        shock_response(pieces, 1000.0, np.array([10.0, 200.0]), 10.0)

    spectrum(1000)
    short, long = (peak_memory(spectrum, count)[0] for count in (400_000, 800_000))
    assert long < 1.05 * short


def test_median_is_that_of_all_samples(hits: Path) -> None:
    with daq.open(hits) as rec:
        samples = rec.read("real")
        assert _median(Slice.of(rec, ["real"])) == pytest.approx(np.median(samples), abs=1e-6 * np.ptp(samples))


@pytest.mark.parametrize("step", [0.0, 1e-310, 2e-15, 1e-6, 1.0])
@pytest.mark.parametrize("value", [0.0, 9.80665, 8e6])
def test_median_of_nearly_equal_samples(value: float, step: float, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = np.repeat([value, value + step], [40, 60])
    monkeypatch.setattr(Slice, "pieces", lambda *_: [(0, samples[None])])
    with daq.open(HIT) as rec:
        assert _median(Slice.of(rec)) == pytest.approx(value + step, rel=1e-15, abs=max(1e-4 * step, 1e-302))


def test_interpolated_gap_is_independent_of_parts(hits: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pieces_of(length: int) -> Callable[..., Iterator[Array]]:
        def pieces(_: ChannelInfo, read: Callable[[int, int], Array], count: int, *__: object) -> Iterator[Array]:
            return (read(first, min(first + length, count)) for first in range(0, count, length))

        return pieces

    with daq.open(hits) as rec:
        samples, spectra = rec.read("ideal"), []
        largest = int(np.argmax(samples))
        samples[largest - 20 : largest + 30] = np.nan
        monkeypatch.setattr(rec, "read", lambda _, start, stop: samples[start:stop])
        for length in (9, samples.size):
            monkeypatch.setattr("analysis.core.signals.shock_spectrum.corrected_pieces", pieces_of(length))
            spectra.append(analysis.srs(rec, "ideal"))
    assert spectra[0].maximax == pytest.approx(spectra[1].maximax, rel=1e-9)
    assert "50 lost samples were interpolated" in spectra[0].warnings[0]


def test_segment_without_hit_has_small_spectrum(hits: Path) -> None:
    assert analysis.srs(hits, "hammer", to_s=0.2).maximax.max() < 1.0 < analysis.srs(hits, "hammer").maximax.max()


def test_default_is_channel_of_last_body() -> None:
    spectrum = analysis.srs(HIT)
    assert spectrum.channel == "body3" and "maximax_m/s²" in spectrum.columns()
    assert "Q = 10" in spectrum.summary()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"q": 0.5}, "q: got 0.5; expected a quality factor above 0.5"),
        ({"lowest": 100.0, "highest": 50.0}, "lowest: got 100 Hz; expected a frequency above 0 and up to 50 Hz"),
        ({"highest": 4000.0}, "highest: got 4000 Hz; expected at most"),
        ({"per_octave": 0}, "per_octave: got 0; expected 1 or more"),
    ],
)
def test_wrong_option_is_named(options: dict[str, float], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        analysis.srs(HIT, **options)  # type: ignore[arg-type]


def test_overload_is_reported(hits: Path, tmp_path: Path) -> None:
    scene = rig.load("fig4-structure").replace(
        test={"kind": "impulse", "body": 1, "peak": "50 N", "width": "4 ms", "interval": "1 s"},
        channels=[{"name": "a1", "at": "body 1", "accelerometer": {"sensitivity": 1.0}}],
        converter={"rate": 5120.0, "bits": 24, "range": 5.0},
    )
    (warning,) = analysis.srs(daq.record(scene, tmp_path / "hit.mcap")).warnings
    assert "a1 was overloaded" in warning and np.isfinite(analysis.srs(hits).maximax).all()

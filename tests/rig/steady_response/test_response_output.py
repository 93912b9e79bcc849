"""Printed text of a steady response: a row for each peak, types of motion as ranges, all frequencies on request."""

from dataclasses import replace

import numpy as np
import pytest

from rig.core.steady_response.frequency_response import SteadyResponse
from rig.core.steady_response.response_output import format_response


@pytest.fixture
def response() -> SteadyResponse:
    """A response of two bodies at 10 to 19 Hz, with peaks of the base at 12 and 17 Hz and of the arm at 17 Hz.

    The arm's maximum of 1 % at 11 Hz is too low for a peak.
    """
    frequency = np.arange(10.0, 20.0)
    compliance = 1e-6 * np.array(
        [[1.0, 2, 9, 2, 1, 1, 2, 5, 2, 1], [1.0, 1.01, 1, 1, 1, 1, 1, 4, 1, 1]], dtype=np.complex128
    )
    motion = np.array(["riding"] * 6 + ["I"] * 2 + ["irregular", "riding"])
    return SteadyResponse(
        frequency=frequency,
        frf=compliance,
        peak=abs(compliance),
        reference_amplitude=np.ones(10),
        motion_type=motion,
        damper_motion=motion[np.newaxis],
        impacts=np.zeros((1, 10)),
        closing_speed=np.zeros((1, 10)),
        converged=motion != "irregular",
        repetition=np.ones(10, dtype=np.int64),
        residual=np.zeros(10),
        bodies=("base", "arm"),
    )


def test_every_peak_has_a_row(response: SteadyResponse) -> None:
    text = format_response(response)
    rows = [line.split()[:5] for line in text.splitlines() if line.startswith(("base", "arm"))]
    # One frequency lies within each half-power width, and dampers may move between the frequencies.
    assert rows == [
        ["base", "12.0000", "at", "least", "9"], ["base", "17.0000", "at", "least", "5"],
        ["arm", "17.0000", "at", "least", "4"],
    ]  # fmt: skip
    assert "fewer than 3 frequencies in the half-power width" in text


def test_headline_gives_the_highest_computed_value(response: SteadyResponse) -> None:
    # The table gives the peak between the frequencies, which may be higher.
    assert "highest computed value 9 µm/N at 12 Hz (base)" in format_response(response).splitlines()[0]


def test_linear_peak_between_frequencies_is_computed(response: SteadyResponse) -> None:
    frequency, natural, ratio = np.arange(20.0, 40.0, 0.84), 30.49, 0.005
    row = 1.0 / (1.0 - (frequency / natural) ** 2 + 2j * ratio * frequency / natural)
    names = ("peak", "reference_amplitude", "converged", "repetition", "residual")
    count = {name: np.resize(getattr(response, name), frequency.size) for name in names}
    linear = replace(
        response, **count, frequency=frequency, frf=1e-6 * row[np.newaxis], bodies=("base",),
        motion_type=np.full(frequency.size, "linear"), damper_motion=np.full((1, frequency.size), "linear"),
    )  # fmt: skip
    [line] = [line.split() for line in format_response(linear).splitlines() if line.startswith("base")]
    assert float(line[1]) == pytest.approx(natural, abs=0.005) and float(line[2]) == pytest.approx(100.0, rel=1e-3)


def test_motions_of_several_elements_are_labeled(response: SteadyResponse) -> None:
    motion = np.vstack([response.damper_motion, np.where(response.frequency == 17.0, "1 per 1", "linear")])
    several = replace(response, damper_motion=motion, impacts=np.zeros((2, 10)), joints=1)
    text = format_response(several)
    assert "motion damper 1: riding, I, irregular; joint 1: linear, 1 per 1" in text
    assert "\n  joint 1, 1 per 1: 17 Hz" in text and "damper 1: I; joint 1: 1 per 1" in text


@pytest.mark.parametrize(
    ("down_at_17", "note"),
    [(None, "it may jump there"), (2.0, "the response jumps between 17 and 18 Hz"), (5.0, "fewer than 3 frequencies")],
)
def test_jump_differs_from_unresolved_peak(response: SteadyResponse, down_at_17: float | None, note: str) -> None:
    frequency = np.arange(10.0, 20.0)
    value = 1e-6 * np.array([[1.0, 1, 1, 2, 3, 4, 4.5, 5, 0.5, 0.4]], dtype=np.complex128)
    impacts = np.where(frequency < 18.0, 1.0, 0.0)[np.newaxis]
    jumping = replace(response, frf=value, impacts=impacts, bodies=("base",))
    if down_at_17 is not None:
        down = value.copy()
        down[0, 7] = 1e-6 * down_at_17
        names = ("peak", "reference_amplitude", "motion_type", "damper_motion", "converged", "repetition", "residual")
        twice = {name: np.concatenate([getattr(jumping, name)] * 2, axis=-1) for name in names}
        jumping = replace(
            jumping,
            **twice,
            frequency=np.concatenate([frequency, frequency[::-1]]),
            frf=np.concatenate([value, down[:, ::-1]], axis=1),
            impacts=np.concatenate([impacts, impacts[:, ::-1]], axis=1),
        )
    assert note in format_response(jumping)


def test_motion_types_are_given_as_ranges(response: SteadyResponse) -> None:
    assert "motion riding: 10 to 15 and 19 Hz" in format_response(response)
    assert "no steady state: 18 Hz" in format_response(response)


def test_every_frequency_is_printed_on_request(response: SteadyResponse) -> None:
    lines = format_response(response, every_frequency=True).splitlines()
    n_added = 2 + response.frequency.size  # an empty line, a header, and a row for each frequency
    assert len(lines) == len(format_response(response).splitlines()) + n_added

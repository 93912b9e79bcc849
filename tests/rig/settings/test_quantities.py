"""Quantities: units have their engineering meaning, and the conversion to SI is lossless."""

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.base.errors import SceneError
from rig.core.settings import quantities
from rig.core.settings.quantities import (
    ACCELERATION,
    ACCELERATION_NOISE,
    ACCELERATION_SENSITIVITY,
    COMMON_FACTORS,
    DASHPOT,
    FORCE_FACTOR,
    FORCE_SENSITIVITY,
    FREQUENCY,
    INDUCTANCE,
    LENGTH,
    MASS,
    PER_KELVIN,
    RATE,
    RATIO,
    RESISTANCE,
    SAMPLE_RATE,
    STIFFNESS,
    TIME,
    TRANSCONDUCTANCE,
    VOLTAGE_NOISE,
    Kind,
    ascending_pair,
    number,
    parse,
    pint_factor,
    si_text,
)


def test_tabulated_unit_factors_equal_those_of_pint() -> None:
    for (unit, si), factor in COMMON_FACTORS.items():
        kind = next(kind for kind in KINDS if kind.si == si)
        assert pint_factor(unit, kind) == factor, unit


KINDS = [value for value in vars(quantities).values() if isinstance(value, Kind)]


@pytest.mark.parametrize(
    ("written", "kind", "value"),
    [
        ("6.6 kN/m", STIFFNESS, 6600.0),
        ("0.98 mm", LENGTH, 0.00098),
        ("10 %", RATIO, 0.1),
        ("10%", RATIO, 0.1),
        ("20 ppm", RATIO, 2e-5),
        ("12.8 kS/s", SAMPLE_RATE, 12800.0),
        ("1 MS/s", SAMPLE_RATE, 1e6),
        ("500 Sa/s", SAMPLE_RATE, 500.0),
        ("2 kSPS", SAMPLE_RATE, 2000.0),
        ("10 V/V", RATIO, 10.0),
        (".inf", LENGTH, math.inf),
        (".inf mm", LENGTH, math.inf),
        ("-.inf", LENGTH, -math.inf),
        ("1e-5 s", TIME, 1e-5),
        ("0.1 1/s", RATE, 0.1),
        ("0.5 N s/m", DASHPOT, 0.5),
        ("0.5 N*s/m", DASHPOT, 0.5),
        ("0.5 N·s/m", DASHPOT, 0.5),
        ("74 g", MASS, 0.074),
        ("0.74 kg", MASS, 0.74),
        ("2 g", ACCELERATION, 19.6133),
        ("9.8 m/s²", ACCELERATION, 9.8),
        ("9.8 m s^-2", ACCELERATION, 9.8),
        ("20 ug/sqrt(Hz)", ACCELERATION_NOISE, 20e-6 * 9.80665),
        ("20 µg/sqrt(Hz)", ACCELERATION_NOISE, 20e-6 * 9.80665),
        ("50 nV/sqrt(Hz)", VOLTAGE_NOISE, 50e-9),
        ("2.25 mV/N", FORCE_SENSITIVITY, 0.00225),
        ("100 mV/(m/s^2)", ACCELERATION_SENSITIVITY, 0.1),
        ("2 Ω", RESISTANCE, 2.0),
        ("0.2 mH", INDUCTANCE, 0.0002),
        ("10 N/A", FORCE_FACTOR, 10.0),
        ("10 T m", FORCE_FACTOR, 10.0),
        ("1 A/V", TRANSCONDUCTANCE, 1.0),
        ("0.05 %/K", PER_KELVIN, 0.0005),
        ("600 rpm", FREQUENCY, 10.0),
        ("5.12 kHz", FREQUENCY, 5120.0),
        ("10_000 Hz", FREQUENCY, 10000.0),
        ("50", FREQUENCY, 50.0),
        (50, FREQUENCY, 50.0),
        (0.25, LENGTH, 0.25),
    ],
)
def test_written_quantity_is_the_nearest_double_in_si(written: str | float, kind: Kind, value: float) -> None:
    assert parse(written, kind) == value


def test_g_in_a_sensitivity_is_standard_gravity() -> None:
    assert parse("100 mV/g", ACCELERATION_SENSITIVITY) == float(Fraction("0.1") / Fraction("9.80665"))


def test_angular_frequency_becomes_hertz() -> None:
    assert parse("312.4 rad/s", FREQUENCY) == pytest.approx(312.4 / (2.0 * math.pi), rel=3e-16)


@pytest.mark.parametrize(
    ("written", "kind"),
    [
        ("0.98 kg", LENGTH),
        ("50 S/s", FREQUENCY),
        ("50 1/s", FREQUENCY),  # radians or cycles is ambiguous
        ("2 kg", ACCELERATION),
        ("5 khz", FREQUENCY),
        ("1,5 mm", LENGTH),
        ("1.2.3 mm", LENGTH),
        ("1 2 mm", LENGTH),
        ("2_0 mm", LENGTH),
        (".nan mm", LENGTH),
        ("nan", LENGTH),
        ("", LENGTH),
        ("mm", LENGTH),
        ("1e400 m", LENGTH),
        ("1e99999999999 m", LENGTH),
        ("1 m^9^9^9^9", LENGTH),
        ("1 m**99", LENGTH),
        ("1 " + "(" * 50 + "m", LENGTH),
        ("1 __import__('os')", LENGTH),
        ("1 delta_m", LENGTH),
        ("1 m/", LENGTH),
        ("1 (m", LENGTH),
        ("1 m)", LENGTH),
        ("1 ((((km^9)^9)^9)^9)^9", LENGTH),
        ("1 " + " " * 30 + "!", LENGTH),
        ("24 %", LENGTH),
        (math.nan, LENGTH),
        (True, LENGTH),
        (None, LENGTH),
        ([1.0], LENGTH),
        (10**400, LENGTH),
    ],
)
def test_invalid_quantity_is_rejected(written: object, kind: Kind) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse(written, kind)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.noun)
def test_example_of_a_kind_is_valid(kind: Kind) -> None:
    for example in kind.example.split(" or "):
        assert math.isfinite(parse(example, kind))
    assert parse(f"1 {kind.si.replace('/', ' / ')}", kind) == 1.0


@pytest.mark.parametrize(
    ("written", "kind", "unit"),
    [
        ("4.2 kgs", MASS, "kg"),
        ("4.2 Kg", MASS, "kg"),
        ("5 kN", STIFFNESS, "kN/m"),
        ("5 hz", FREQUENCY, "Hz"),
        ("5 khz", FREQUENCY, "kHz"),
        ("0.5 N/m", DASHPOT, "N s/m"),
    ],
)
def test_similar_unit_of_the_kind_is_suggested(written: str, kind: Kind, unit: str) -> None:
    with pytest.raises(SceneError, match=rf"such as {kind.example}\. Did you mean '{unit}'\?$"):
        number(written, kind, "key")


@pytest.mark.parametrize(
    ("written", "kind"), [("2 Hz", MASS), ("1e400 m", LENGTH), ("kgs", MASS), ("0.98 kg", LENGTH), (True, MASS)]
)
def test_no_unit_is_suggested_without_similarity(written: str, kind: Kind) -> None:
    with pytest.raises(SceneError) as error:
        number(written, kind, "key")
    assert "Did you mean" not in str(error.value)


@pytest.mark.parametrize("values", ["30-50", ["30-50"], ["30Hz..50Hz"], ["30 Hz"]])
def test_range_in_one_text_is_rejected(values: str | list[str]) -> None:
    with pytest.raises(SceneError, match=r"^band: got '30.*'; expected two values with a comma, such as 50Hz,100Hz$"):
        ascending_pair(values, FREQUENCY, "band")
    with pytest.raises(SceneError, match=r"such as 0\.98mm,1\.96mm$"):
        ascending_pair(["1-2"], LENGTH, "clearance")


# `si_text`: a value with its SI unit.
@given(st.floats(allow_nan=False), st.sampled_from(KINDS))
def test_any_double_survives_writing_and_parsing(value: float, kind: Kind) -> None:
    assert parse(si_text(value, kind), kind) == value


@given(st.decimals(allow_nan=False, allow_infinity=False, min_value=-(10**6), max_value=10**6, places=6))
def test_quantity_in_millimeters_is_rounded_once(number: object) -> None:
    assert parse(f"{number} mm", LENGTH) == float(Fraction(str(number)) / 1000)


@given(st.floats(min_value=1e-3, max_value=1e6))
def test_frequency_in_three_units_is_equal(hertz: float) -> None:
    assert parse(f"{2.0 * math.pi * hertz!r} rad/s", FREQUENCY) == pytest.approx(hertz, rel=1e-15)
    assert parse(f"{60.0 * hertz!r} rpm", FREQUENCY) == pytest.approx(hertz, rel=1e-15)


@given(st.text(max_size=40) | st.from_regex(r"\A[0-9]{1,3} ?([kmNsHzg]{1,3}|[*/^() %-]|[0-9]){0,12}\Z"))
def test_any_text_is_a_number_or_rejected(written: str) -> None:
    try:
        value = parse(written, LENGTH)
    except ValueError:
        return
    assert not math.isnan(value)

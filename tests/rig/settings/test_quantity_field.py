"""Numbers with a unit: accepted ranges, and messages about values outside.

`Quantity` describes the values of a scene key: one or more kinds of quantity (length, mass) and bounds. `read` converts
a text or a number to SI units.
"""

from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter
from pydantic_core import PydanticCustomError

from rig.core.settings.quantities import LENGTH, MASS, RATIO
from rig.core.settings.quantity_field import Quantity, format_value, printable, quantity_of

NUMBERS = st.sampled_from([-3.0, -1.0, 0.0, 1.0, 2.0, 5.0, float("inf"), -float("inf")])


@given(
    value=NUMBERS,
    above=st.none() | NUMBERS,
    at_least=st.none() | NUMBERS,
    below=st.none() | NUMBERS,
    infinite=st.fixed_dictionaries({}, optional={"infinite": st.booleans()}),
)
def test_bounds_accept_exactly_the_allowed_numbers(value, above, at_least, below, infinite):
    quantity = Quantity(LENGTH, above=above, at_least=at_least, below=below, **infinite)
    allowed = infinite.get("infinite", False) or abs(value) < float("inf")
    allowed = allowed and not (above is not None and value <= above)
    allowed = allowed and not (at_least is not None and value < at_least)
    allowed = allowed and not (below is not None and value >= below)
    if allowed:
        assert quantity.read(value) == value
    else:
        with pytest.raises(PydanticCustomError, match=r"got .*; expected a length such as"):
            quantity.read(value)


def test_help_text_names_bounds_and_si_unit():
    quantity = Quantity(LENGTH, above=0.0, at_least=1e-3, below=2.5, infinite=False)
    assert (
        quantity.bounded_description
        == f"{LENGTH.noun} such as {LENGTH.example}, above 0 and at least 0.001 and below 2.5"
    )
    assert quantity.help_text == f"{quantity.bounded_description}; a bare number is in m"
    length_or_mass = Quantity(LENGTH, MASS, infinite=True)
    assert (
        length_or_mass.bounded_description == f"{LENGTH.noun} or {MASS.noun} such as {LENGTH.example} or {MASS.example}"
    )
    assert length_or_mass.help_text.endswith("; a bare number is in m or kg")


def test_range_of_a_ratio_has_no_unit():
    with pytest.raises(PydanticCustomError, match=r"expected a ratio from 1e-18 to 1e\+12$"):
        Quantity(RATIO).read("1e15")


def test_unit_selects_the_kind_of_quantity():
    length_or_mass = Quantity(LENGTH, MASS)
    assert (length_or_mass.read("2 mm"), length_or_mass.read("2 g")) == (2e-3, 2e-3)
    with pytest.raises(PydanticCustomError, match=r'got "2 Hz"; expected a length or a mass'):
        length_or_mass.read("2 Hz")


def test_unit_resembling_an_allowed_one_is_suggested():
    with pytest.raises(PydanticCustomError, match=r'got "2 kgs"; .* such as 0\.98 mm or 74 g\. Did you mean \'kg\'\?'):
        Quantity(LENGTH, MASS).read("2 kgs")


def test_list_of_quantities_reads_each_number():
    quantity_or_list = Quantity(LENGTH, above=0.0, listed=True)
    assert quantity_or_list.read(["1 mm", 2.0]) == (1e-3, 2.0)
    assert quantity_or_list.read("1 mm") == 1e-3
    with pytest.raises(PydanticCustomError, match="at least one"):
        quantity_or_list.read([])
    for invalid in ([1.0, -1.0], ["1 kg"]):
        with pytest.raises(PydanticCustomError):
            quantity_or_list.read(invalid)
    with pytest.raises(PydanticCustomError):
        Quantity(LENGTH).read([1.0])


def test_minus_zero_is_read_as_zero():
    assert str(Quantity(LENGTH).read(-0.0)) == "0.0"


def test_extremely_large_number_is_rejected():
    with pytest.raises(PydanticCustomError, match=r"expected a length .*"):
        Quantity(LENGTH).read(1e200)


def test_quantity_schema_has_bounds_and_lists():
    def schema(**bounds):
        return TypeAdapter(Annotated[float, Quantity(LENGTH, **bounds)]).json_schema()

    number, text = schema(above=0.0, below=4.0)["anyOf"]
    assert number == {"type": "number", "exclusiveMinimum": 0.0, "exclusiveMaximum": 4.0}
    assert text == {"type": "string"}
    number, text, array = schema(at_least=1.0, listed=True)["anyOf"]
    assert number == {"type": "number", "minimum": 1.0}
    assert array == {"type": "array", "items": {"anyOf": [number, text]}, "minItems": 1}


def test_quantity_is_detected_inside_unions():
    quantity = Quantity(LENGTH)
    assert quantity_of(Annotated[float, quantity] | None) is quantity
    assert quantity_of(tuple[Annotated[float, quantity], ...]) is quantity
    assert quantity_of(float | None) is None


def test_printed_value_is_short_and_recognizable():
    assert [format_value(value) for value in (None, {}, {"a": 1, "b": 2}, "x", 1.5)] == [
        "nothing",
        "no keys",
        "keys a, b",
        '"x"',
        "1.5",
    ]
    # A longer text than 60 characters, with its quotation marks, is shortened.
    assert format_value("x" * 58) == f'"{"x" * 58}"'
    assert format_value("x" * 59) == f'"{"x" * 56}...'
    assert printable("a b") == "a b"
    with pytest.raises(PydanticCustomError, match=r"\\x1b.*one line of text without control characters"):
        printable("a\x1b[2J")

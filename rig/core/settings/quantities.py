"""Conversion of quantities with units (`0.98 mm`, `312.4 rad/s`, `10 %`) to numbers in SI.

Frequencies are converted to Hz: 312.4 rad/s is 49.72 Hz, 600 rpm is 10 Hz. Pint does the unit arithmetic with a
custom table in which the turn is a dimension. With the usual table (radian = 1), Pint would read rad/s as Hz,
and accept the ambiguous `50 1/s`.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Context, Decimal
from fractions import Fraction
from functools import cache, lru_cache
from operator import index
from typing import Any, SupportsIndex, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.core.base.errors import SceneError, suggestion

UNITS = """
nano- = 1e-9 = n-
micro- = 1e-6 = u-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
turn = [angle] = rev
radian = 1/6.283185307179586 turn = rad
degree = 1/360 turn = deg
second = [time] = s
minute = 60 second = min
hour = 3600 second = h
hertz = turn / second = Hz
rpm = turn / minute
metre = [length] = m
inch = 0.0254 metre
gram = [mass] = g
tonne = 1e6 gram = t
newton = kilogram * metre / second ** 2 = N
pound_force = 4.4482216152605 newton = lbf
pascal = newton / metre ** 2 = Pa
joule = newton * metre = J
watt = joule / second = W
ampere = [current] = A
volt = watt / ampere = V
ohm = volt / ampere = Ω
siemens = ampere / volt = S
henry = volt * second / ampere = H
tesla = volt * second / metre ** 2 = T
kelvin = [temperature] = K
decibel = [level] = dB
standard_gravity = 9.80665 metre / second ** 2 = gn
percent = 0.01
ppm = 1e-6
"""


@dataclass(frozen=True)
class Kind:
    """Kind of a quantity: its name in messages with an article, its SI unit, and an example as in a scene file.

    A nonzero magnitude must be between `minimum` and `maximum`, in SI. Outside these limits, powers and products in the
    model overflow or underflow, or the computation takes too long.
    """

    noun: str
    si: str
    example: str
    minimum: float = 1e-18
    maximum: float = 1e12

    def supports(self, number: float) -> bool:
        """Return whether the model supports the magnitude of a number; zero and infinity are supported.

        >>> MASS.supports(1.0), MASS.supports(1e-30), TIME.supports(1e12), LENGTH.supports(math.inf)
        (True, False, False, True)
        """
        return number == 0.0 or math.isinf(number) or self.minimum <= abs(number) <= self.maximum

    @property
    def range(self) -> str:
        """The allowed magnitudes in words."""
        unit = f" {self.si}".rstrip()
        return f"from {self.minimum:g}{unit} to {self.maximum:g}{unit}"


MASS = Kind("a mass", "kg", "74 g", 1e-9, 1e9)
STIFFNESS = Kind("a stiffness", "N/m", "6.6 kN/m", 1e-9, 1e15)
DASHPOT = Kind("a damping coefficient", "N s/m", "0.5 N s/m")
LENGTH = Kind("a length", "m", "0.98 mm", 1e-15, 1e6)
VELOCITY = Kind("a velocity", "m/s", "0.1 m/s")
ACCELERATION = Kind("an acceleration", "m/s^2", "9.80665 m/s^2", 1e-12, 1e9)
FORCE = Kind("a force", "N", "2.6 N")
TIME = Kind("a time", "s", "4 ms", 1e-15, 1e8)
RATE = Kind("a rate", "1/s", "0.1 1/s")
FREQUENCY = Kind("a frequency", "Hz", "50 Hz or 312.4 rad/s", 1e-6, 1e8)
SAMPLE_RATE = Kind("a sample rate", "Hz", "25.6 kHz", FREQUENCY.minimum, FREQUENCY.maximum)
RATIO = Kind("a ratio", "", "10 %")
ANGLE = Kind("an angle", "rad", "-90 deg")
LEVEL = Kind("a level", "dB", "3 dB")
ACCELERATION_DENSITY = Kind("an acceleration density", "(m/s^2)^2/Hz", "0.01 g^2/Hz")
VOLTAGE = Kind("a voltage", "V", "5 V")
CURRENT = Kind("a current", "A", "2 mA")
RESISTANCE = Kind("a resistance", "ohm", "2 ohm")
INDUCTANCE = Kind("an inductance", "H", "0.2 mH")
FORCE_FACTOR = Kind("a force factor", "N/A", "10 N/A")
TRANSCONDUCTANCE = Kind("a current per voltage", "A/V", "1 A/V")
ACCELERATION_SENSITIVITY = Kind("a voltage per acceleration", "V/(m/s^2)", "100 mV/g")
FORCE_SENSITIVITY = Kind("a voltage per force", "V/N", "2.25 mV/N")
ACCELERATION_NOISE = Kind("an acceleration noise density", "m/s^2/sqrt(Hz)", "20 ug/sqrt(Hz)")
FORCE_NOISE = Kind("a force noise density", "N/sqrt(Hz)", "1 mN/sqrt(Hz)")
VOLTAGE_NOISE = Kind("a voltage noise density", "V/sqrt(Hz)", "50 nV/sqrt(Hz)")
DENSITY = Kind("a density", "kg/m^3", "11340 kg/m^3", 1.0, 1e5)
MODULUS = Kind("a modulus", "Pa", "10 MPa", 1e3, 1e12)
TEMPERATURE = Kind("a temperature difference", "K", "12 K")
PER_KELVIN = Kind("a ratio per kelvin", "1/K", "0.05 %/K")

_NUMBER = re.compile(
    # Underscores separate thousands; elsewhere they are a slip of a decimal point.
    r"([+-]?(?:(?:\d{1,3}(?:_\d{3}){1,12}|\d{1,40})(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][+-]?\d{1,3})?|[+-]?\.inf|[+-]?inf)"
    r"(?![\d._])\s*(.*)",
    re.DOTALL | re.IGNORECASE,
)
# A product of units and brackets with short powers. Pint's parser would evaluate expressions in other text.
_POWER = r"(?:(?:\^|\*\*)(?:-?\d|0\.5))?"
_NAME = rf"[A-Za-zΩ]+{_POWER}"
_JOIN = r"(?:\s*[*/]\s*|\s+)"
_PRODUCT = rf"(?:1\s*/\s*)?{_NAME}(?:{_JOIN}{_NAME})*"
# Brackets of up to three levels: ``((m/s^2)/N)``.
for _ in range(3):
    _FACTOR = rf"(?:{_NAME}|\(\s*{_PRODUCT}\s*\){_POWER})"
    _PRODUCT = rf"(?:1\s*/\s*)?{_FACTOR}(?:{_JOIN}{_FACTOR})*"
_UNIT = re.compile(_PRODUCT)
_SAMPLES_PER_SECOND = re.compile(r"^([kM]?)(?:(?:S|Sa|samples)/s|SPS)$")
_GRAVITY = re.compile(r"(?<![A-Za-z])([num]?)g(?![A-Za-z])")


def parse(value: Any, kind: Kind) -> float:
    """Read a quantity.

    `value`: a number in SI (frequencies in Hz), or text with a number and a unit. `kind`: required kind of quantity.
    Returns the double nearest to the written value, in the SI unit of its kind. The result may be infinite. Raises
    `ValueError` if the text is not a number, the unit is unknown or of a different kind, or the value is NaN.

    >>> parse("0.98 mm", LENGTH)
    0.00098
    >>> round(parse("312.4 rad/s", FREQUENCY), 2)
    49.72
    >>> round(9.80665 * parse("100 mV/g", ACCELERATION_SENSITIVITY), 12)
    0.1
    >>> parse("74 g", MASS)
    0.074
    """
    if isinstance(value, str):
        return _parse_text(value, kind)
    if isinstance(value, bool) or not hasattr(value, "__float__"):
        raise ValueError(f"{value!r} is not a number")
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{value!r} is not a number") from None
    if math.isnan(number):
        raise ValueError("not a number (NaN)")
    return number


def suggest_decimal_point(value: Any, kinds: Sequence[Kind]) -> str | None:
    """Write a quantity with a decimal point instead of a comma; return None if it has no decimal comma.

    >>> suggest_decimal_point("1,5 kg", [MASS]), suggest_decimal_point("a,b", [MASS])
    ('a decimal point: 1.5 kg', None)
    >>> suggest_decimal_point("1,000 Hz", [FREQUENCY])
    'a decimal point and no other separator: 1.000 Hz or 1000 Hz'
    """
    match = re.fullmatch(r"([+-]?\d[\d.]*),(\d+)(\D.*)?", value.strip(), re.DOTALL) if isinstance(value, str) else None
    if match is None:
        return None
    integer, decimals, unit = match[1].replace(".", ""), match[2], match[3] or ""
    with_point = f"{integer}.{decimals}{unit}"
    for kind in kinds:
        try:
            parse(with_point, kind)
        except ValueError:
            continue
        if len(decimals) == 3 and len(integer.lstrip("+-")) < 4:
            return f"a decimal point and no other separator: {with_point} or {integer}{decimals}{unit}"
        return f"a decimal point: {with_point}"
    return None


def expected_quantity(value: Any, kinds: Sequence[Kind]) -> str:
    """Describe what was expected instead of an invalid quantity: an example, and a similar unit if there is one.

    >>> expected_quantity("4.2 kgs", [MASS])
    "a mass such as 74 g. Did you mean 'kg'?"
    >>> expected_quantity("5 kg", [ACCELERATION])  # a unit of a different quantity is not misspelled
    'an acceleration such as 9.80665 m/s^2'
    """
    hint = _similar_unit(value, kinds)
    return suggest_decimal_point(value, kinds) or f"{describe_kinds(kinds)}{hint and '. ' + hint}"


def describe_kinds(kinds: Sequence[Kind]) -> str:
    """Return the kinds of a quantity with examples.

    >>> describe_kinds([VOLTAGE, LENGTH, FORCE])
    'a voltage, a length or a force such as 5 V, 0.98 mm or 2.6 N'
    """
    return " such as ".join(alternatives([getattr(kind, word) for kind in kinds]) for word in ("noun", "example"))


def alternatives(words: Sequence[str]) -> str:
    """Return words as a list with *or*."""
    return " or ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def _similar_unit(value: Any, kinds: Sequence[Kind]) -> str:
    """Return the question whether a usual unit that resembles the given unit was meant; empty if there is none."""
    match = _NUMBER.fullmatch(value.strip()) if isinstance(value, str) else None
    units = [unit for kind in kinds for unit in _usual_units(kind) if unit]
    other_units = {unit for pair in COMMON_FACTORS for unit in pair if unit.isalpha()}
    if match is None or match[2] in (*units, *other_units):
        return ""
    # Wrong upper or lower case is frequent, and changes half of the characters of a short unit: hz, Kg.
    return suggestion({unit.casefold(): unit for unit in units}.get(match[2].casefold(), match[2]), units)


def _usual_units(kind: Kind) -> list[str]:
    return [kind.si, *(unit for unit, si in COMMON_FACTORS if si == kind.si)]


@overload
def number(value: float | str, kind: Kind, name: str) -> float: ...
@overload
def number(value: float | str | None, kind: Kind, name: str) -> float | None: ...
def number(value: float | str | None, kind: Kind, name: str) -> float | None:
    """Convert an argument to a number in SI: numbers are taken as SI, text is parsed with its unit.

    Raises `SceneError` if the text is not a quantity of this kind; the message begins with the argument's name.

    >>> number("2 s", TIME, "duration"), number(2.0, TIME, "duration")
    (2.0, 2.0)
    """
    if value is None:
        return None
    try:
        return parse(value, kind)
    except ValueError as error:
        raise SceneError(f"{name}: {error}; expected {expected_quantity(value, [kind])}") from None


@overload
def finite_number(value: float | str, kind: Kind, name: str) -> float: ...
@overload
def finite_number(value: float | str | None, kind: Kind, name: str) -> float | None: ...
def finite_number(value: float | str | None, kind: Kind, name: str) -> float | None:
    """Convert an argument like `number`; its magnitude must be finite and within the limits of its kind."""
    quantity = number(value, kind, name)
    if quantity is not None and (math.isinf(quantity) or not kind.supports(quantity)):
        raise SceneError(f"{name}: got {str(value)[:60]}; expected {kind.noun} {kind.range}")
    return quantity


def ascending_pair(values: ArrayLike, kind: Kind, name: str) -> tuple[float, float]:
    """Convert an argument of two quantities in ascending order, each like `number`.

    Raises `SceneError` if the argument is invalid; the message begins with its name.

    >>> ascending_pair(["55 Hz", 70], FREQUENCY, "band")
    (55.0, 70.0)
    """
    texts = [values] if isinstance(values, str) else values
    if isinstance(texts, list | tuple) and len(texts) == 1 and isinstance(texts[0], str):
        low, unit = kind.example.split()[:2]
        example = f"{low}{unit},{2.0 * float(low):g}{unit}"
        raise SceneError(f"{name}: got {texts[0]!r:.60}; expected two values with a comma, such as {example}")
    pair = positive_values(values, kind, name).tolist()
    if len(pair) != 2 or not pair[0] < pair[1]:
        listed = ", ".join(f"{number:g} {kind.si}" for number in pair)
        raise SceneError(f"{name}: got {listed}; expected two values, the smaller value first")
    return pair[0], pair[1]


def positive_values(values: ArrayLike, kind: Kind, name: str) -> NDArray[np.float64]:
    """Convert an argument of one or several quantities, each like `number`; all must be positive and finite.

    Raises `SceneError` if a value is invalid; the message begins with the argument's name.

    >>> positive_values(["49 Hz", "3000 rpm"], FREQUENCY, "frequencies").tolist()
    [49.0, 50.0]
    """
    try:
        raw = np.atleast_1d(np.asarray(values))
        if raw.dtype.kind == "U":
            raw = np.array([number(str(item), kind, name) for item in raw.flat]).reshape(raw.shape)
        # A list of complex numbers raises an error; an array would lose its imaginary part.
        numbers = np.asarray(raw.tolist(), dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(
            f"{name}: got {values!r:.60}; expected one or more quantities such as {kind.example}"
        ) from None
    is_valid = (numbers >= kind.minimum) & (numbers <= kind.maximum)
    if numbers.ndim != 1 or not numbers.size or not is_valid.all():
        invalid = ", ".join(map(str, numbers[~is_valid].tolist()[:3])) or f"values of shape {numbers.shape}"
        raise SceneError(
            f"{name}: got {invalid}; expected one or more positive values {kind.range}, such as {kind.example}"
        )
    return numbers


def positive_value(value: ArrayLike, kind: Kind, name: str) -> float:
    """Convert an argument of one positive and finite quantity, like `positive_values`."""
    numbers = positive_values(value, kind, name)
    if numbers.size != 1:
        raise SceneError(f"{name}: got {numbers.size} values; expected one value, such as {kind.example}")
    return float(numbers[0])


def count(value: SupportsIndex, minimum: int, name: str) -> int:
    """Convert an argument that is a number of items to an integer.

    Raises `SceneError` if it is not a whole number or is below the minimum; the message begins with its name.

    >>> count(48, 2, "points")
    48
    """
    try:
        number_of_items = index(value)
    except TypeError:
        number_of_items = minimum - 1
    if number_of_items < minimum:
        raise SceneError(f"{name}: got {value!r}; expected a whole number of at least {minimum}")
    return number_of_items


def si_text(value: float, kind: Kind) -> str:
    """Write a quantity so that `parse` returns the identical double.

    >>> si_text(0.00098, LENGTH)
    '0.00098 m'
    """
    number = repr(value) if math.isfinite(value) else ".inf" if value > 0 else "-.inf"
    return f"{number} {kind.si}".rstrip()


def shortest_notation(value: float, kind: Kind, previous: str | None = None) -> str:
    """Write a quantity with the fewest digits from which `parse` returns the identical double.

    `previous`: the user's notation. This notation is returned unchanged if its value is the same; otherwise its unit is
    used.

    >>> shortest_notation(0.000133, LENGTH), shortest_notation(0.00125, LENGTH, "5e-4 m")
    ('0.133 mm', '0.00125 m')
    >>> shortest_notation(0.00125, LENGTH, "1.25 mm")
    '1.25 mm'
    >>> shortest_notation(parse("100 mV/g", ACCELERATION_SENSITIVITY), ACCELERATION_SENSITIVITY)
    '100 mV/g'
    """
    units = _usual_units(kind)
    if previous is not None:
        notation = previous.strip()
        try:
            if parse(notation, kind) == value:
                return notation
        except ValueError:  # the previous quantity was of another kind, because another key has changed
            pass
        else:
            match = _NUMBER.fullmatch(notation)
            units = [match.group(2).strip()] if match else units
    if not math.isfinite(value):
        return si_text(value, kind).split(" ")[0]
    texts = [_shortest_decimal(value, unit, kind) for unit in units]
    return min(texts, key=_spelling_rank)


def _shortest_decimal(value: float, unit: str, kind: Kind) -> str:
    """Write a number in a unit with the fewest digits that return the identical double."""
    factor = _factor(unit, kind)
    ratio = Fraction(value) / factor
    for digits in range(1, 18):
        number = Context(prec=digits).divide(Decimal(ratio.numerator), Decimal(ratio.denominator))
        if float(Fraction(number) * factor) == value:
            break
    number = number.normalize()
    decimal = f"{number:f}" if -6 < number.adjusted() < 9 else f"{number:e}"
    return f"{decimal} {unit}".rstrip()


# Numbers with at least this many digits count as equally long: they were computed, and no unit makes them short.
_MAX_DIGITS = 13


def _spelling_rank(written: str) -> tuple[int, bool, int]:
    """Return the sort key of notations: significant digits, whether the number is tiny or huge, and length."""
    number = Decimal(written.split(" ")[0]).normalize()
    digits = min(len(number.as_tuple().digits), _MAX_DIGITS)
    return digits, number != 0 and not -2 <= number.adjusted() < 4, len(written)


@lru_cache(maxsize=1024)
def _parse_text(quantity: str, kind: Kind) -> float:
    match = _NUMBER.fullmatch(quantity.strip())
    if match is None:
        raise ValueError(f"{quantity!r} does not begin with a number")
    number, unit = match.groups()
    factor = _factor(unit.strip(), kind)
    number = number.replace("_", "").lower()
    if "inf" in number:
        return -math.inf if number.startswith("-") else math.inf
    try:
        return float(Fraction(number) * factor)
    except OverflowError:
        raise ValueError(f"{quantity!r} is too large") from None


#: Factors of the most frequent units, as Pint computes them: importing Pint takes most of the time to load a scene.
COMMON_FACTORS = {
    ("%", ""): Fraction(1, 100),
    ("g", "kg"): Fraction(1, 1000),
    ("mm", "m"): Fraction(1, 1000),
    ("ms", "s"): Fraction(1, 1000),
    ("kHz", "Hz"): Fraction(1000),
    ("rad/s", "Hz"): 1 / Fraction("6.283185307179586"),
    ("kN/m", "N/m"): Fraction(1000),
    ("mV/g", "V/(m/s^2)"): Fraction(1, 1000) / Fraction("9.80665"),
    ("mV/N", "V/N"): Fraction(1, 1000),
    ("ug/sqrt(Hz)", "m/s^2/sqrt(Hz)"): Fraction("9.80665") / 1_000_000,
    ("mN/sqrt(Hz)", "N/sqrt(Hz)"): Fraction(1, 1000),
    ("nV/sqrt(Hz)", "V/sqrt(Hz)"): Fraction(1, 10**9),
    ("uV/sqrt(Hz)", "V/sqrt(Hz)"): Fraction(1, 10**6),
    ("MHz", "Hz"): Fraction(10**6),
    ("g", "m/s^2"): Fraction("9.80665"),
    ("MN/m", "N/m"): Fraction(10**6),
    ("mV", "V"): Fraction(1, 1000),
    ("mA", "A"): Fraction(1, 1000),
    ("mH", "H"): Fraction(1, 1000),
    ("uH", "H"): Fraction(1, 10**6),
    ("MPa", "Pa"): Fraction(10**6),
}


@lru_cache(maxsize=1024)
def _factor(unit: str, kind: Kind) -> Fraction:
    """Return the exact SI factor of a unit."""
    if unit in ("", kind.si):
        return Fraction(1)
    if kind is SAMPLE_RATE:
        # Samples per second, as on data sheets of converters.
        unit = _SAMPLES_PER_SECOND.sub(r"\1Hz", unit)
    return COMMON_FACTORS.get((unit, kind.si)) or pint_factor(unit, kind)


def pint_factor(unit: str, kind: Kind) -> Fraction:
    """Return a unit's SI factor from Pint; raise `ValueError` if it is unknown or of a different kind."""
    notation = _pint_notation(unit)
    # g is the gram or standard gravity, whichever results in the required kind (74 g, 100 mV/g).
    for candidate in (notation, _GRAVITY.sub(r"\1gn", notation)):
        factor = _conversion(candidate, _pint_notation(kind.si))
        if factor is not None:
            return factor
    raise ValueError(f"{unit!r} is not a unit of {kind.noun.split(' ', 1)[1]}")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, or a product of powers of units."""
    try:
        return _conversion(notation := _pint_notation(text), notation) is not None
    except ValueError:
        return False


def _pint_notation(unit: str) -> str:
    """Convert a unit to Pint's notation, and reject text that is not a product of powers."""
    notation = unit.replace("µ", "u").replace("μ", "u").replace("·", "*").replace("²", "^2").replace("³", "^3")
    notation = notation.replace("%", " percent ").strip()
    notation = re.sub(r"sqrt\(\s*([A-Za-z]+)\s*\)", r"\1**0.5", notation)
    if len(notation) > 60 or (notation and not _UNIT.fullmatch(notation)):
        raise ValueError(f"{unit!r} is not a unit, nor a product of units such as N s/m")
    return notation


@cache
def _registry() -> Any:
    # Imported only here because importing Pint takes longer than all other steps of loading a scene.
    import pint

    registry: Any = pint.UnitRegistry(None, non_int_type=Fraction)
    for definition in UNITS.strip().splitlines():
        registry.define(definition)
    return registry


def _conversion(unit: str, si: str) -> Fraction | None:
    """Return the conversion factor between units, or None if the first is unknown or of a different kind."""
    import pint

    registry = _registry()
    try:
        source, target = registry.parse_units(unit), registry.parse_units(si)
        if source.dimensionality != target.dimensionality:
            return None
        return Fraction(registry.convert(Fraction(1), source, target))
    except pint.UndefinedUnitError:
        return None

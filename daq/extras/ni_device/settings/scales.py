"""Custom scales: convert readings to other units by a line, a map between two ranges, a polynomial or a table."""

from __future__ import annotations

from typing import Any

import numpy as np

from daq.extras.ni_device.errors import Code, DaqError, invalid_value
from daq.extras.ni_device.settings.properties import coerce
from rig.core.base.arrays import Array

# Maximum number of points of a least-squares fit; it limits the computing time.
_MAX_POINTS = 100_000
# Largest order of the fitted polynomial; higher orders are ill-conditioned.
_MAX_ORDER = 50
# NI's numbers of the types of scales.
LINEAR, MAP_RANGES, POLYNOMIAL, TABLE = 10447, 10448, 10449, 10450


class Scale:
    """A custom scale of type LINEAR, MAP_RANGES, POLYNOMIAL or TABLE; `settings` are its parameters by NI's names."""

    def __init__(self, scale_type: int, settings: dict[str, Any]) -> None:
        self.settings: dict[str, Any] = {
            "type": scale_type,
            "descr": "",
            "scaled_units": "",
            "pre_scaled_units": 10348,
        } | settings
        for name, value in self.settings.items():
            if isinstance(value, float | list) and not np.all(np.isfinite(value)):
                raise invalid_value(f"{name} of a scale is {str(value)[:80]}. Give finite numbers.")
            if value == [] and name != "poly_reverse_coeff":
                raise invalid_value(f"{name} of a scale is empty. Give at least one number.")
        self.convert(np.zeros(1))  # The evaluation raises an error if the settings are invalid.

    def changed(self, name: str, value: Any) -> Scale:
        """Return the scale with a changed parameter.

        Raises `DaqError` -200077 for an invalid value, -200601 for a parameter that this type of scale does not have.
        """
        settings = self.settings
        if name not in settings or name == "type":
            raise DaqError(
                f"a scale of this type has no {name}. Set a property that this type of scale has.",
                Code.PROPERTY_NOT_SUPPORTED_FOR_SCALE_TYPE,
            )
        return Scale(settings["type"], settings | {name: coerce(name, value, settings[name])})

    def convert(self, values: Array) -> Array:
        """Return scaled readings of the same shape; raise `DaqError` if the scale is invalid."""
        settings = self.settings
        if settings["type"] == LINEAR:
            scaled = settings["lin_slope"] * values + settings["lin_y_intercept"]
        elif settings["type"] == MAP_RANGES:
            low, high = settings["map_pre_scaled_min"], settings["map_pre_scaled_max"]
            if low == high:
                raise invalid_value(
                    f"map_pre_scaled_min and map_pre_scaled_max of a scale are both {low:g}. Give two different values."
                )
            first, last = settings["map_scaled_min"], settings["map_scaled_max"]
            scaled = first + (values - low) * (last - first) / (high - low)
        elif settings["type"] == POLYNOMIAL:
            scaled = np.polynomial.polynomial.polyval(values, settings["poly_forward_coeff"])
        elif len(settings["table_pre_scaled_vals"]) != len(settings["table_scaled_vals"]):
            raise DaqError(
                f"a table scale has {len(settings['table_pre_scaled_vals'])} pre-scaled and "
                f"{len(settings['table_scaled_vals'])} scaled values. Give the same number of both.",
                Code.MISMATCHED_INPUT_ARRAY_SIZES,
            )
        else:
            pre_scaled = np.array(settings["table_pre_scaled_vals"])
            order = np.argsort(pre_scaled)
            scaled = np.interp(values, pre_scaled[order], np.array(settings["table_scaled_vals"])[order])
        return np.asarray(scaled, dtype=np.float64)


def reverse_polynomial(forward: list[float], low: float, high: float, points: int, order: int) -> list[float]:
    """Fit the inverse of a polynomial by least squares, for readings from `low` to `high`.

    Returns the coefficients of the polynomial from scaled values to readings, the constant first, like `forward`.
    `points` is the number of fitted points; 0 or less means 1000. A negative `order` means the order of `forward`.
    Raises `DaqError` -200077 if the fit is not possible.

    >>> [round(value, 6) for value in reverse_polynomial([1.0, 2.0], -10.0, 10.0, 100, 1)]
    [-0.5, 0.5]
    """
    if not forward:
        raise invalid_value("there are no coefficients to reverse. Give at least one.")
    points, degree = points if points > 0 else 1000, order if order >= 0 else len(forward) - 1
    if not degree < points <= _MAX_POINTS or degree > _MAX_ORDER:
        raise invalid_value(
            f"a polynomial of order {degree} cannot be fitted to {points} points. Give an order up to {_MAX_ORDER}, "
            f"and more points than the order, up to {_MAX_POINTS}."
        )
    x = np.linspace(low, high, points)
    with np.errstate(all="ignore"):
        y = np.polynomial.polynomial.polyval(x, forward)
        largest_power = np.abs(y).max() ** max(degree, 1)
    if not (np.isfinite(x).all() and np.isfinite(largest_power)):
        raise invalid_value(
            "the values of the polynomial between the limits are too large for its inverse. Give finite and narrower "
            "limits, smaller coefficients or a lower order."
        )
    # With full=True, numpy returns the fit diagnostics and does not warn about a poor fit.
    fitted, _ = np.polynomial.polynomial.polyfit(y, x, degree, full=True)
    return [float(coefficient) for coefficient in fitted]

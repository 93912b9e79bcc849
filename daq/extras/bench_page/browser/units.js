// Units as engineers read them: g, µm, mm; numbers with few digits; limits and ticks of axes.
"use strict";

// Factor from the SI unit, name, and smallest full scale of an axis, which the noise of an idle bench must not fill.
const QUANTITIES = {
  "m/s^2": { factor: 1 / 9.80665, name: "g", smallest: 0.1 },
  "m/s": { factor: 1e3, name: "mm/s", smallest: 0.1 },
  m: { factor: 1e6, name: "µm", smallest: 10 },
  "m/N": { factor: 1e6, name: "µm/N", smallest: 0 },
  N: { factor: 1, name: "N", smallest: 5 },
  V: { factor: 1, name: "V", smallest: 0.02 },
};

function quantity(unit) {
  return QUANTITIES[unit] ?? { factor: 1, name: unit, smallest: 0 };
}

const SUPERSCRIPTS = "⁰¹²³⁴⁵⁶⁷⁸⁹";

function digits(value, count = 4) {
  if (value == null || !isFinite(value)) return "–";
  const magnitude = Math.abs(value);
  if (magnitude < 1e5 && (magnitude >= 1e-3 || !magnitude)) return String(Number(value.toPrecision(count)));
  const [mantissa, exponent] = value.toExponential(1).split("e");
  const power = `10${exponent < 0 ? "⁻" : ""}${[...String(Math.abs(exponent))].map((digit) => SUPERSCRIPTS[digit]).join("")}`;
  return mantissa === "1.0" ? power : `${Number(mantissa)}·${power}`;
}

// A measured value has the zeros at its end, so that values below each other have equal digits.
function reading(value, count) {
  const short = digits(value, count), full = value?.toPrecision(count);
  return Number(full) === Number(short) && !full.includes("e") ? full : short;
}

// A value with its unit; micrometers from 1000 on are millimeters.
function withUnit(value, unit, count = 3, format = digits) {
  const { factor, name } = quantity(unit), scaled = value * factor;
  return name.startsWith("µm") && Math.abs(scaled) >= 1000
    ? `${format(scaled / 1000, count)} ${name.replace("µm", "mm")}` : `${format(scaled, count)} ${name}`;
}

// A value with its expanded uncertainty, which has two digits.
function withInterval(value, expanded) {
  const decimals = Math.max(0, 1 - Math.floor(Math.log10(expanded)));
  return `${value.toFixed(decimals)} ± ${expanded.toFixed(decimals)}`;
}

// The smallest of 1, 2, 5, 10, ... that is at least a value.
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((mantissa) => mantissa * power).find((rounded) => rounded >= value * (1 - 1e-9));
}

// Ticks of an axis, at least `space` pixels apart, and whether each is labeled.
function ticks(low, high, pixels, log, space = 44) {
  const made = [];
  if (!(high > low) || (log && !(low > 0))) return made;
  if (!log) {
    const step = roundUp((high - low) / Math.max(1, pixels / space));
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) made.push([Number((k * step).toPrecision(12)), true]);
    return made.length > 1 ? made : [[low, true], [0.5 * (low + high), true], [high, true]];
  }
  const decades = Math.log10(high / low), labeled = decades > 2.5 ? [1] : decades > 1.2 ? [1, 2, 5] : decades > 0.9 ? [1, 2, 3, 5, 7] : [1, 2, 3, 4, 5, 6, 8];
  const every = Math.max(1, Math.ceil(space / 2.2 / (pixels / decades)));
  for (let exponent = Math.floor(Math.log10(low)); 10 ** exponent <= high; exponent++) {
    for (let mantissa = 1; mantissa < 10; mantissa++) {
      const value = Number(`${mantissa}e${exponent}`);
      if (value < low || value > high || (every > 1 && mantissa > 1)) continue;
      made.push([value, labeled.includes(mantissa) && exponent % every === 0]);
    }
  }
  return made.filter(([, label]) => label).length > 1 ? made : ticks(low, high, pixels, false, space);
}

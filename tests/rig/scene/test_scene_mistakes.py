"""Mistakes in scenes: each is reported, all at once, with its line, the value and what was expected."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rig
from rig.core.base.errors import SceneError

# Lines of scenes. The structure is one line, usually line 1.
STRUCTURE = "structure: {masses: [1 kg, 2 kg], springs: [1 kN/m, 1 kN/m]}\n"
FORCE = "shaker: {kind: force, body: 1}\n"
ELECTRODYNAMIC = "shaker: {kind: electrodynamic, body: 1, spring: 6.6 kN/m}\n"


def error_of(text: str) -> str:
    """Return the message about an invalid scene."""
    with pytest.raises(SceneError) as raised:
        rig.loads(text, "scene.yaml")
    return str(raised.value)


NAMED_BODIES = "structure: {masses: {base: 4 kg, arm: 1 kg}, springs: [1 MN/m, 1 MN/m]}\n"
# A scene, and a part of the message: line, key, value and what was expected.
MISTAKES = [
    # unknown and missing keys
    ("structre: {}\n" + STRUCTURE, ":1: structre: unknown key 'structre'. Did you mean 'structure'?"),
    ("name: x", ":1: structure: missing; expected keys masses and springs, or matrices"),
    (STRUCTURE + "dampers:\n  - {body: 1, mass: 10 g, clearance: 1 mm, restitutoin: 10 %}",
     ":3: dampers[1].restitutoin: unknown key 'restitutoin'. Did you mean 'restitution'?"),
    (STRUCTURE + "dampers:\n  - {body: 1, mass: 10 g}",
     ":3: dampers[1].clearance: missing; expected a length such as 0.98 mm"),
    (STRUCTURE + "shaker: {kind: force, body: 1, spring: 6.6 kN/m}",
     ":2: shaker.spring: unknown key 'spring' for kind force, which has kind, body, output. Remove the "
     "key, or give kind: table or electrodynamic."),
    (STRUCTURE + "shaker: {kind: table, body: 1}", ":2: shaker.spring: missing; expected a stiffness such as 6.6 kN/m"),
    (STRUCTURE + FORCE + "test: {kind: sine, force: 1 N}",
     ":3: test.frequency: missing; expected a frequency such as 50 Hz or 312.4 rad/s"),
    # units and kinds
    (STRUCTURE + "dampers:\n\n  - {body: 1, mass: 10 g, clearance: 0.98 kg}",
     ':4: dampers[1].clearance: got "0.98 kg"; expected a length such as 0.98 mm'),
    (STRUCTURE + "gravity: heavy", ':2: gravity: got "heavy"; expected an acceleration such as'),
    (STRUCTURE + "gravity: .nan", ':2: gravity: got ".nan"; expected an acceleration such as'),
    (STRUCTURE + "gravity:", ":2: gravity: got nothing; expected an acceleration such as"),
    (STRUCTURE + "seed: 1.5", ':2: seed: got "1.5"; expected a whole number'),
    (STRUCTURE + "seed: -1", ':2: seed: got "-1"; expected a whole number, at least 0'),
    (STRUCTURE + "joints: [{between: [1, 3], gap: 1 mm, stiffness: 1 MN/m}]",
     ":2: joints[1].between[2]: body 3 does not exist; expected a body of the structure, 1 to 2"),
    (STRUCTURE + "joints: [{between: [1, 1], gap: 1 mm, stiffness: 1 MN/m}]",
     ":2: joints[1].between: both ends are 1; expected two bodies, or a body and ground"),
    (STRUCTURE + "joints: [{between: 1, gap: 1 mm, stiffness: 1 MN/m}]",
     ':2: joints[1].between: got "1"; expected two items, such as [1, 2] or [ground, 1]'),
    (STRUCTURE + "joints: [{between: [0, ground], gap: 1 mm, stiffness: 1 MN/m}]",
     ':2: joints[1].between[1]: got "0"; expected a body by its number from 1 or its name, or ground'),
    (STRUCTURE + "joints: [{between: [1, 2], slip_force: 0 N, stiffness: 1 MN/m}]",
     ':2: joints[1].slip_force: got "0 N"; expected a force such as 2.6 N, above 0 and finite'),
    (STRUCTURE + "joints: [{between: [1, 2], slip_force: 1 N}]",
     ":2: joints[1].stiffness: missing; expected a stiffness such as 6.6 kN/m"),
    (STRUCTURE + "joints: [{between: [1, 2], slip_force: 1 N, gap: 1 mm, stiffness: 1 MN/m}]",
     ":2: joints[1]: got keys between, slip_force, gap, stiffness; expected exactly one of the keys gap, slip_force"),
    (STRUCTURE + "joints: [{between: [1, 2], slip_force: 1 N, stiffness: 1 MN/m, damping: 3 N s/m}]",
     ":2: joints[1].damping: unknown key 'damping'; expected one of between, slip_force, stiffness"),
    (STRUCTURE + "joints: [{between: [1, ground], gap: 1 mm, stiffness: 1 MN/m}]\nshaker: {kind: base}",
     ":3: shaker: a shaker of kind base moves the ground, to which joints are connected. Connect them to bodies only."),
    (STRUCTURE + "recording: {truth: maybe}", ':2: recording.truth: got "maybe"; expected true or false'),
    (STRUCTURE + "name: [a]", ":2: name: got ['a']; expected text"),
    (STRUCTURE + "dampers: {body: 1}", ":2: dampers: got keys body; expected a list"),
    (STRUCTURE + "converter: fast", ':2: converter: got "fast"; expected keys such as'),
    (STRUCTURE + "shaker: strong",
     ':2: shaker: got "strong"; expected keys and values, with kind: force, table, electrodynamic'),
    ("structure: {masses: [1 kg], springs: [1 kN/m], damping: 1 %}",
     ':1: structure.damping: got "1 %"; expected keys and values, with one of the keys modal, rayleigh, dashpots'),
    (STRUCTURE + "shaker: {kind: tabel, body: 1}",
     ":2: shaker.kind: got \"tabel\"; expected one of force, table, electrodynamic, base. Did you mean 'table'?"),
    (STRUCTURE + "shaker: {body: 1}", ":2: shaker.kind: missing; expected one of force, table, electrodynamic"),
    (STRUCTURE + "test: {kind: impulse, start: later, body: 1, peak: 1 N, width: 1 ms}",
     ':2: test.start: got "later"; expected one of settled or empty'),
    # quantities that depend on another key
    (STRUCTURE + ELECTRODYNAMIC.replace("}", ", amplifier: {mode: current, limit: 5 V}}"),
     ':2: shaker.amplifier.limit: got "5 V"; expected a current such as 2 mA'),
    (STRUCTURE + ELECTRODYNAMIC + "test: {kind: sine, frequency: 1 Hz, drive: 5 mm}",
     ':3: test.drive: got "5 mm"; expected a voltage such as 5 V'),
    (STRUCTURE + ELECTRODYNAMIC.replace("electrodynamic", "table") + "test: {kind: sine, frequency: 1 Hz, drive: 5 V}",
     ':3: test.drive: got "5 V"; expected a length such as 0.98 mm'),
    (STRUCTURE + "channels:\n- {name: a, at: body 1, integrator: {order: 2}, abort: 1 m/s}",
     ':3: channels[1].abort: got "1 m/s"; expected a length such as 0.98 mm'),
    # impossible values
    ("structure: {masses: [-1 kg], springs: [1]}",
     ':1: structure.masses[1]: got "-1 kg"; expected a mass such as 74 g, above 0 and finite'),
    ("structure: {masses: [.inf], springs: [1]}", ':1: structure.masses[1]: got ".inf"; expected a mass'),
    ("structure: {masses: [1], springs: [-5]}", ':1: structure.springs[1]: got "-5"; expected a stiffness'),
    ("structure: {masses: [], springs: [1]}", ":1: structure.masses: got []; expected a list of length 1 or more"),
    (STRUCTURE + "dampers: [{body: 1, mass: 10 g, clearance: -1 mm}]",
     ':2: dampers[1].clearance: got "-1 mm"; expected a length such as 0.98 mm, at least 0'),
    (STRUCTURE + "dampers: [{body: 1, mass: 10 g, clearance: 1 mm, restitution: 1}]",
     ':2: dampers[1].restitution: got "1"; expected a ratio such as 10 %, at least 0 and below 1'),
    (STRUCTURE + "dampers: [{body: 0, mass: 10 g, clearance: 1 mm}]",
     ':2: dampers[1].body: got "0"; expected a whole number, at least 1'),
    (STRUCTURE + "converter: {bits: 99}", ':2: converter.bits: got "99"; expected a whole number, at most 32'),
    (STRUCTURE + "channels: []", ":2: channels: got []; expected a list of length 1 or more"),
    (STRUCTURE + "shaker: {kind: force, body: [1, 1]}",
     ":2: shaker.body: got ['1', '1']; expected a list that names each body once"),
    (STRUCTURE + "shaker: {kind: force, body: left}",
     ":2: shaker.body: no body has the name 'left': the bodies have no names; expected its number, 1 to 2"),
    (STRUCTURE + "channels: [{name: a/b, at: body 1}]", ':2: channels[1].name: got "a/b"; expected a name of letters'),
    (STRUCTURE + "channels: [{name: a, at: tabel}]",
     ':2: channels[1].at: got "tabel"; expected a location: a body (its name, or body 1), table'),
    # exclusive and dependent keys
    (STRUCTURE + "dampers: [{body: 1, mass: 10 g, mass_ratio: 1 %, clearance: 1 mm}]",
     ":2: dampers[1]: mass and mass_ratio given together; expected exactly one of mass or mass_ratio"),
    (STRUCTURE + "dampers: [{body: 1, clearance: 1 mm}]",
     ":2: dampers[1]: mass or mass_ratio missing; expected exactly one of mass or mass_ratio"),
    ("structure: {masses: [1]}", ":1: structure: springs missing; expected 1, one for each mass"),
    ("structure: {masses: [1, 2], springs: [1]}",
     ":1: structure.springs: got 1 springs; expected 2, one for each mass"),
    ("structure: {masses: [1], springs: [1], damping: {modal: [1 %, 2 %]}}",
     ":1: structure.damping.modal: got 2 values; expected 1, one for each mode"),
    ("structure: {masses: [1], springs: [1], damping: {dashpots: [1, 2]}}",
     ":1: structure.damping.dashpots: got 2 values; expected 1, one for each spring"),
    ("structure: {masses: [1], springs: [1], damping: {modl: 1 %}}",
     ":1: structure.damping: got keys modl; expected exactly one of the keys modal, rayleigh, dashpots"),
    (STRUCTURE + FORCE + "test: {kind: sine, frequency: 1 Hz}",
     ":3: test: force or drive missing; expected exactly one of force or drive"),
    (STRUCTURE + FORCE + "test: {kind: sine, frequency: 1 Hz, drive: 1}",
     ":3: test.drive: a shaker of kind force is driven by its force. Give force instead."),
    (STRUCTURE + FORCE + "test: {kind: stepped_sine, from: 9 Hz, to: 8 Hz, points: 3, force: 1}",
     ":3: test.from: got 9 Hz, which is not below `to`, 8 Hz. Give the lower end first; direction: down"),
    (STRUCTURE + FORCE + "test: {kind: stepped_sine, to: 8 Hz, points: 3, force: 1}",
     ":3: test: from missing; expected a frequency such as 8 Hz"),
    (STRUCTURE + FORCE + "test: {kind: stepped_sine, frequencies: [2, 1], force: 1}",
     ":3: test.frequencies: the frequencies do not ascend"),
    (STRUCTURE + FORCE + "test: {kind: stepped_sine, frequencies: [2], from: 1, force: 1}",
     ":3: test: frequencies and from or to are given together"),
    (STRUCTURE + FORCE + "test: {kind: stepped_sine, frequencies: [2], force: []}",
     ":3: test.force: got []; expected at least one: a force such as 2.6 N"),
    (STRUCTURE + FORCE + "test: {kind: swept_sine, from: 8, to: 8, duration: 1, force: 1}",
     ":3: test.to: got 8 Hz, the same as `from`"),
    (STRUCTURE + FORCE + "test: {kind: random, from: 9, to: 8, duration: 1, force: 1}",
     ":3: test.from: got 9 Hz, which is not below `to`, 8 Hz"),
    (STRUCTURE + FORCE + "test: {kind: multisine, from: 8.1, to: 8.9, period: 1 s, force: 1}",
     ":3: test.period: no line of the multisine (multiple of 1 Hz) lies between from and to. Give a longer period."),
    (STRUCTURE + "test: {kind: impulse, body: 1, peak: [1 N, 2 N], width: 1 ms, repeats: 3}",
     ":2: test.peak: got 2 values; expected 3, one for each impact (repeats)"),
    (STRUCTURE + "converter: {rate: 25.6 kS}",
     """:2: converter.rate: got "25.6 kS"; expected a sample rate such as 25.6 kHz"""),
    (STRUCTURE + "test: {kind: impulse, body: 1, peak: 1, width: 9 s}",
     ":2: test.width: got 9 s, which is not shorter than the interval between impacts, 6 s. Give a shorter width"),
    (STRUCTURE + "test: {kind: impulse, body: 1, peak: 1, width: 9 ms, double_hit: {after: 1 ms}}",
     ":2: test.double_hit.after: got 0.001 s, but the second pulse must lie between the first pulse and the next "
     "impact. Give at least 0.009 s and less than 5.991 s"),
    (STRUCTURE + "test: {kind: impulse, body: 1, peak: 1, width: 9 ms, double_hit: {hits: [2]}}",
     ":2: test.double_hit.hits[1]: impact 2 does not exist; expected at most 1, the number of repeats"),
    (STRUCTURE + "test: {kind: free}", ":2: test: no initial state; expected displacement, velocity, or mode"),
    (STRUCTURE + "test: {kind: free, mode: 1}", ":2: test.mode: given without amplitude"),
    (STRUCTURE + "test: {kind: free, mode: 1, amplitude: 1 mm, velocity: [1, 1]}",
     ":2: test.mode: mode is given together with displacement or velocity"),
    (STRUCTURE + "channels: [{name: a, at: body 1, accelerometer: {q: 30}}]",
     ":2: channels[1].accelerometer.q: given without resonance. Add resonance, or remove q."),
    (STRUCTURE + "channels: [{name: a, at: body 1, hammer: {}}]",
     ":2: channels[1].hammer: the key hammer is for force sensors, but the channel at body 1"),
    # presets
    (STRUCTURE + "channels: [{name: a, at: body 1, accelerometer: {preset: PCB 352C34}}]",
     ":2: channels[1].accelerometer.preset: unknown accelerometer preset 'PCB 352C34'; expected one of "
     "PCB 352C33, PCB 356A02, PCB 356A16, PCB 356B18. Did you mean 'PCB 352C33'?"),
    (STRUCTURE + "channels: [{name: a, at: body 1, accelerometer: {preset: NI 9234}}]",
     ":2: channels[1].accelerometer.preset: unknown accelerometer preset 'NI 9234'"),
    (STRUCTURE + "converter: {preset: NI 9999}",
     ":2: converter.preset: unknown converter preset 'NI 9999'; expected one of NI 9234"),
    (STRUCTURE + "converter: {preset: NI 9234, rate: 60 kHz}",
     ":2: converter.rate: got 60000 Hz; expected 1651.61 to 51200 Hz, the range of sample rates of NI 9234"),
    (STRUCTURE + "converter: {bits: 16}", ":2: converter.bits: given without range. Add range"),
    (STRUCTURE + "converter: {ac_corner: 1 Hz}", ":2: converter.ac_corner: given without coupling: AC"),
    (STRUCTURE + "converter: {clock_error: 50 %}", ":2: converter.clock_error: got 0.5; expected less than 10 %"),
    # references to bodies, shakers and channels
    (STRUCTURE + "dampers:\n- {body: 7, mass: 10 g, clearance: 1 mm}",
     ":3: dampers[1].body: body 7 does not exist; expected a body of the structure, 1 to 2"),
    (STRUCTURE + "shaker: {kind: force, body: [1, 3]}", ":2: shaker.body[2]: body 3 does not exist"),
    (STRUCTURE + "test: {kind: impulse, body: 3, peak: 1, width: 1 ms}", ":2: test.body: body 3 does not exist"),
    (STRUCTURE + "test: {kind: free, velocity: [1]}", ":2: test.velocity: got 1 values; expected 2"),
    (STRUCTURE + "test: {kind: free, mode: 3, amplitude: 1}", ":2: test.mode: mode 3 does not exist; expected 1 to 2"),
    (STRUCTURE + "test: {kind: sine, frequency: 1, force: 1}",
     ":2: test.kind: sine requires a shaker. Add a shaker to the scene."),
    (STRUCTURE + FORCE + "channels: [{name: a, at: table}]",
     ":3: channels[1].at: the scene has no shaker table; expected a body, or a shaker of kind table"),
    (STRUCTURE + "channels: [{name: a, at: hammer}]", ":2: channels[1].at: this test has no hammer"),
    (STRUCTURE + "channels: [{name: a, at: shaker}]",
     ":2: channels[1].at: the scene has no shaker. Mount the channel on a body"),
    (STRUCTURE + "shaker: {kind: base}\nchannels: [{name: a, at: shaker}]",
     ":3: channels[1].at: a shaker of kind base exerts no single force. Measure the motion of the table instead"),
    (STRUCTURE + FORCE + "test: {kind: impulse, body: 1, peak: 1 N, width: 1 ms}\nchannels: [{name: a, at: shaker}]",
     ":4: channels[1].at: in an impact test the shaker is idle, so its force is not measured"),
    (STRUCTURE + FORCE + "channels: [{name: a, at: shaker, integrator: {order: 1}}]",
     ":3: channels[1].integrator: the channel at the shaker measures force. Replace integrator with hammer"),
    (STRUCTURE + FORCE + "channels: [{name: a, at: shaker, abort: 1 m/s}]",
     ':3: channels[1].abort: got "1 m/s"; expected a force such as'),
    (STRUCTURE + "channels:\n- {name: a, at: body 1}\n- {name: a, at: body 2}",
     ':4: channels[2].name: "a" is also the name of channels[1]; expected a unique name'),
    (STRUCTURE + "channels: [{name: a, at: body 1}]\nconverter: {skew: [1 us, 2 us]}",
     ":3: converter.skew: got 2 values; expected 1, one for each channel"),
    (STRUCTURE + "recording: {samples: counts}", ":2: recording.samples: counts require a converter with bits"),
    # frequencies above half the sample rate
    (STRUCTURE + FORCE + "test: {kind: sine, frequency: 2000 Hz, force: 1}\nconverter: {rate: 2048 Hz}",
     ":3: test.frequency: 2000 Hz at 2048 samples a second; expected less than half the rate, 1024 Hz. Lower the "
     "frequency, or raise converter.rate."),
    (
        STRUCTURE + FORCE + "test: {kind: stepped_sine, from: 9, to: 1500, points: 3, force: 1}\n"
        "converter: {rate: 2048 Hz}",
        ":3: test.to: 1500 Hz at 2048 samples",
    ),
    (
        STRUCTURE + FORCE + "test: {kind: stepped_sine, force: 1, frequencies: [9,\n 1024]}\n"
        "converter: {rate: 2048 Hz}",
        ":4: test.frequencies[2]: 1024 Hz at 2048 samples",
    ),
    (STRUCTURE + FORCE + "test: {kind: swept_sine, from: 3 kHz, to: 8, duration: 1, force: 1}",
     ":3: test.from: 3000 Hz at 5120 samples"),
    (STRUCTURE + FORCE + "test: {kind: random, from: 5, to: 3000, duration: 1, force: 1}",
     ":3: test.to: 3000 Hz at 5120 samples"),
    (STRUCTURE + FORCE + "test: {kind: multisine, from: 5, to: 3000, lines: 9, force: 1}",
     ":3: test.to: 3000 Hz at 5120 samples"),
    (STRUCTURE + FORCE + "test: {kind: sine, frequency: 5 kHz, force: 1}\nconverter: {preset: NI 9234, rate: 8 kHz}",
     ":3: test.frequency: 5000 Hz at 8533.33 samples"),
    # matrices
    ("structure: {matrices: {mass: [[1, 2]], stiffness: [[1]]}}",
     ":1: structure.matrices.mass: got a matrix of shape (1, 2); expected a square matrix"),
    ("structure: {matrices: {mass: [[1, 2], [3]], stiffness: [[1]]}}",
     ":1: structure.matrices.mass: got rows of unequal length, or values that are not numbers"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[a]]}}",
     ":1: structure.matrices.stiffness: got rows of unequal length, or values that are not numbers"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[nan]]}}",
     ":1: structure.matrices.stiffness: got nan in row 1, column 1; expected finite numbers"),
    ("structure: {matrices: {mass: [[1, 0.5], [0.2, 1]], stiffness: [[1, 0], [0, 1]]}}",
     ":1: structure.matrices.mass: the matrix is not symmetric: entry (1, 2) is 0.5, entry (2, 1) is 0.2"),
    ("structure: {matrices: {mass: [[1, 2], [2, 1]], stiffness: [[1, 0], [0, 1]]}}",
     ":1: structure.matrices.mass: not positive definite"),
    ("structure: {matrices: {mass: [[1, 1], [1, 1]], stiffness: [[1, 0], [0, 1]]}}",
     ":1: structure.matrices.mass: not positive definite"),
    ("structure: {matrices: {mass: [[1, 0], [0, 1]], stiffness: [[1, 3], [0, 1]]}}",
     ":1: structure.matrices.stiffness: the matrix is not symmetric"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[1]], damping: [[1, 0], [0, 1]]}}",
     ":1: structure.matrices.damping: got 2 rows; expected 1, as in the mass matrix"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[1]], damping: [[1]]}, damping: {modal: 1 %}}",
     ":1: structure.damping: damping is given together with matrices.damping"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[1]]}, damping: {dashpots: [1]}}",
     ":1: structure.damping: dashpots are for a chain"),
    ("structure: {matrices: {mass: [[1]], stiffness: [[1]]}, springs: [1]}",
     ":1: structure.springs: springs and matrices are given together"),
    ("structure: {matrices: {mass: M.npy, stiffness: [[1]]}}",
     ':1: structure.matrices.mass: got "M.npy", but a .npy file is read from the folder of the scene file'),
    ("structure: {matrices: {mass: M.mat, stiffness: [[1]]}}",
     ':1: structure.matrices.mass: got "M.mat"; expected rows of numbers or the name of a .npy file'),
    # YAML
    (STRUCTURE + "seed: 1\nseed: 2", ":3: seed: given twice, first on line 2; expected each key once"),
    ("structure: [1, 2}", ":1: the list or mapping has no closing ]"),
    ("a: b: 2", ':1: a second ": " in one value'),
    ("structure:\n\tmasses: [1 kg]", ":2: a tab in the indentation; expected spaces"),
    ("structure:\n  masses: [1 kg]\n damping: 1", ":3: the indentation does not match any line above"),
    (STRUCTURE + "gravity 9.81", ':2: a line without ": "'),
    (STRUCTURE + 'name: "a', ":2: a quotation mark is not closed"),
    (STRUCTURE + "gravity: 9,81 m/s^2", ':2: gravity: got "9,81 m/s^2"; expected a decimal point: 9.81 m/s^2'),
    (STRUCTURE + "dampers: [{body: 1, mass: 0,05 kg, clearance: 1 mm}]",
     ':2: dampers[1].mass: got "0,05 kg"; expected a decimal point: 0.05 kg'),
    ("structure: {masses: [1,5 kg], springs: [1 kN/m]}",
     ':1: structure.masses[1]: got "1,5 kg"; expected a decimal point: 1.5 kg'),
    (STRUCTURE + "gravity: 1,000 m/s^2",
     ':2: gravity: got "1,000 m/s^2"; expected a decimal point and no other separator: 1.000 m/s^2 or 1000 m/s^2'),
    # Names of bodies
    (NAMED_BODIES + "dampers: [{body: amr, mass: 1 g, clearance: 1 mm}]",
     ":2: dampers[1].body: no body has the name 'amr'. Did"),
    (NAMED_BODIES + "channels: [{name: a, at: wing}]",
     ":2: channels[1].at: no body has the name 'wing'; expected one of base, arm (bodies), table, hammer, shaker"),
    (NAMED_BODIES.replace("arm", "table"), ':1: structure.masses.table: "table" is reserved for another location'),
    (NAMED_BODIES.replace("arm", "a b"), ':1: structure.masses.a b: "a b" is not a name for a body'),
    (NAMED_BODIES.replace("1 kg", "1 kN"), ':1: structure.masses.arm: got "1 kN"; expected a mass such as 74 g'),
    ("structure: {names: [a, a], matrices: {mass: [[1, 0], [0, 1]], stiffness: [[1, 0], [0, 1]]}}",
     ':1: structure.names[2]: "a" is the name of body 1; expected each name once'),
    ("structure: {names: [a], matrices: {mass: [[1, 0], [0, 1]], stiffness: [[1, 0], [0, 1]]}}",
     ":1: structure.names: got 1 names; expected 2, one for each body"),
    ("structure: *chain", ":1: alias *chain is not defined above"),
    ("structure: &a [*a]", ":1: alias *a is not defined above"),
    ("? [a]\n: b", ":1: the key is a list or a mapping"),
    ("a: !!python/object:os.system x", ":1: got the YAML tag tag:yaml.org,2002:python/object:os.system"),
    ("a: 1\n---\nb: 2", ":2: a second document begins here (---); expected one scene in a file"),
    ("just words", " has no keys; expected a scene, at least structure: with masses and springs"),
    ("", " is empty; expected a scene"),
    ("# a comment only", " is empty; expected a scene"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), MISTAKES, ids=[message for _, message in MISTAKES])
def test_single_mistake_names_place_value_and_expectation(text: str, message: str) -> None:
    report = error_of(text)
    assert f"scene.yaml{message}" in report
    assert len(report.splitlines()) == 1


def test_frequencies_are_checked_against_the_module_rate() -> None:
    module = "converter: {preset: NI 9234, rate: 8 kHz}"
    scene = rig.loads(STRUCTURE + FORCE + "test: {kind: sine, frequency: 4.2 kHz, force: 1}\n" + module)
    assert scene.converter.sample_rate == pytest.approx(51200 / 6)


def test_all_unknown_presets_are_reported_with_lines() -> None:
    report = error_of(
        STRUCTURE
        + """gravity: heavy
channels:
  - {name: a, at: body 1, accelerometer: {preset: PCB 1}}
  - {name: b, at: body 2, accelerometer: {preset: PCB 2}}
converter:
  preset: NI 9999
"""
    )
    assert [line.split(": ")[:2] for line in report.splitlines()] == [
        ["scene.yaml:2", "gravity"],
        ["scene.yaml:4", "channels[1].accelerometer.preset"],
        ["scene.yaml:5", "channels[2].accelerometer.preset"],
        ["scene.yaml:7", "converter.preset"],
    ]


def test_many_mistakes_each_have_their_line() -> None:
    report = error_of(
        """name: wrong in many ways
structure:
  masses: [0.74 kg, -1 kg, 0.64 m]
  springs: [24.3 kN/m, 21.8 kN/m, 19.8 kN/m]
dampers:
  - {body: 7, mass: 1 g, clearance: 1 mm}
  - {body: 1, mass_ratio: 10 %, clearance: 1 mm}
  - {body: 1, mass_ratio: 10 %, clearance: 0.98 kg}
  - {body: 1, mass_ratio: 10 %, clearance: 1 mm, clearance: 2 mm}
shaker: {kind: tabel, body: 1, spring: 6.6 kN/m}
test: {kind: sine, frequency: 10 1/s, force: 1 N}
channels:
  - {name: a, at: body 9}
  - {name: head, at: table}
  - {name: a, at: body 2}
sed: 4
"""
    )
    places = [line.split(": ")[0] + ": " + line.split(": ")[1] for line in report.splitlines()]
    assert sorted(places) == sorted(
        [
            "scene.yaml:3: structure.masses[2]",
            "scene.yaml:3: structure.masses[3]",
            "scene.yaml:6: dampers[1].body",
            "scene.yaml:8: dampers[3].clearance",
            "scene.yaml:9: dampers[4].clearance",
            "scene.yaml:10: shaker.kind",
            "scene.yaml:11: test.frequency",
            "scene.yaml:13: channels[1].at",
            "scene.yaml:15: channels[3].name",
            "scene.yaml:16: sed",
        ]
    )


@pytest.mark.parametrize("content", [b"\x89PNG\r\n\x1a\n\x00\x00", b"\xff\xfe\x00", bytes(range(256))])
def test_binary_file_is_rejected(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scene.yaml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match="not a text file; expected a scene in YAML"):
        rig.load(path)


def test_empty_missing_and_invalid_paths_are_distinguished(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").touch()
    with pytest.raises(SceneError, match=r"empty\.yaml is empty"):
        rig.load(tmp_path / "empty.yaml")
    with pytest.raises(SceneError, match="is a folder"):
        rig.load(tmp_path)
    with pytest.raises(SceneError, match=r"missing\.yaml: the file does not exist"):
        rig.load(tmp_path / "missing.yaml")
    with pytest.raises(SceneError, match="Did you mean 'fig8-three-dampers'"):
        rig.load("fig8-tree-dampers")
    with pytest.raises(SceneError, match="`rig scenes` lists the bundled scenes"):
        rig.load("q")
    with pytest.raises(SceneError, match="is neither a bundled scene nor a file"):
        rig.load("a\0b")


def test_unusable_matrix_files_have_their_reasons(tmp_path: Path) -> None:
    scene = tmp_path / "s.yaml"
    scene.write_text("structure: {matrices: {mass: M.npy, stiffness: K.npy, damping: C.npy}}\n")
    (tmp_path / "K.npy").write_bytes(b"\x93NUMPY nonsense")
    np.save(tmp_path / "C.npy", np.array([["a"]], dtype=object), allow_pickle=True)
    with pytest.raises(SceneError) as raised:
        rig.load(scene)
    mass, stiffness, damping = str(raised.value).splitlines()
    assert "M.npy: the file does not exist" in mass and mass.endswith("next to the scene file")
    assert "matrices.stiffness" in stiffness and "cannot be read as .npy" in stiffness
    assert "matrices.damping" in damping and "cannot be read as .npy" in damping


@pytest.mark.parametrize(
    ("kind", "shape"), [("'<f8'", "(1000000, 1000000)"), ("'<f8'", f"({10**30}, 1)"), ("(" * 500, "(1, 1)")]
)
def test_oversized_matrix_file_is_rejected_unread(kind: str, shape: str, tmp_path: Path) -> None:
    # A .npy file with a header alone: `kind` of its elements (invalid in the last case), and its shape.
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}, }}"
    raw = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    (tmp_path / "M.npy").write_bytes(raw)
    (tmp_path / "s.yaml").write_text("structure: {matrices: {mass: M.npy, stiffness: [[1]]}}\n")
    with pytest.raises(SceneError, match=r"matrices\.mass"):
        rig.load(tmp_path / "s.yaml")


def test_complex_matrix_is_rejected(tmp_path: Path) -> None:
    np.save(tmp_path / "M.npy", np.array([[1.0 + 2.0j]]))
    (tmp_path / "s.yaml").write_text("structure: {matrices: {mass: M.npy, stiffness: [[1]]}}\n")
    with pytest.raises(SceneError, match=r"matrices\.mass: .*values that are not numbers"):
        rig.load(tmp_path / "s.yaml")


# Each alias is a list of nine of the previous aliases: 9^10 values in total.
NESTED_ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NESTED_ALIASES, "repeat more than"),
        ("[" * 100_000, "levels of nesting"),
        ("{a: " * 100_000, "levels of nesting"),
        ("structure: {masses: [" + "9" * 100_000 + "], springs: [1]}", "expected a mass"),
    ],
)
def test_extreme_text_is_rejected_quickly(text: str, message: str) -> None:
    assert message in error_of(text)


yaml_tokens = st.sampled_from(
    ["structure", "masses", "[1 kg]", "springs", ": ", "\n", "  ", "- ", *"{}[]", ", ", "&a ", "*a", "body", "1"]
)


@given(st.text(max_size=60) | st.lists(yaml_tokens, max_size=30).map("".join))
def test_any_text_gives_a_scene_or_scene_error(text: str) -> None:
    try:
        scene = rig.loads(text)
    except SceneError as error:
        assert str(error)
    else:
        assert scene.structure.bodies >= 1


def count_calls(text: str) -> int:
    """Count the calls of functions while an invalid scene is loaded."""
    count = 0

    def profile(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event == "call"

    sys.setprofile(profile)
    try:
        error_of(text)
    finally:
        sys.setprofile(None)
    return count


def many_unknown_keys(n: int) -> str:
    return STRUCTURE + "".join(f"unknown{k}: 1\n" for k in range(n))


def many_unknown_names(n: int) -> str:
    bodies = ", ".join(f"part{k}: 1 kg" for k in range(n))
    channels = "".join(f"  - {{name: c{k}, at: pert{k}}}\n" for k in range(n))
    return f"structure: {{masses: {{{bodies}}}, springs: [{', '.join(['1 kN/m'] * n)}]}}\nchannels:\n{channels}"


def many_wrong_values(n: int) -> str:
    return f"structure: {{masses: [{', '.join(['-1 kg'] * n)}], springs: [{', '.join(['1 N'] * n)}]}}\n"


@pytest.mark.parametrize("scene", [many_unknown_keys, many_unknown_names, many_wrong_values])
def test_work_is_linear_in_mistakes(scene: Callable[[int], str]) -> None:
    error_of(scene(10))
    assert count_calls(scene(400)) < 2.2 * count_calls(scene(200))

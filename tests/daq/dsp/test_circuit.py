"""State-space circuits of a signal chain, alone and in series, compared with textbook transfer functions."""

import numpy as np
import pytest

from daq.core.dsp.circuit import Circuit, Section, high_pass, integration, recovery, resonance

S = 2j * np.pi * np.array([0.01, 0.7, 12.0, 300.0, 4e3, 9e4])  # rad/s


def transfer_of_states(section: Section) -> np.ndarray:
    """Return the transfer function of the state-space form at `S`."""
    eye = np.eye(section.states)
    return np.array([section.c @ np.linalg.solve(s * eye - section.a, section.b) + section.d for s in S])


def transfer_of_roots(section: Section) -> np.ndarray:
    """Return the transfer function of zeros, poles and gain at `S`."""
    numerator = np.prod([S - zero for zero in section.zeros], axis=0) if section.zeros else 1.0
    denominator = np.prod([S - pole for pole in section.poles], axis=0) if section.poles else 1.0
    return section.gain * numerator / denominator


OMEGA = 2 * np.pi * 50.0  # corner or resonance of the sections, rad/s
# Sections and their transfer functions at `S`.
SECTIONS = [
    (resonance(50.0, 7.0), OMEGA**2 / (S**2 + S * OMEGA / 7.0 + OMEGA**2)),
    (resonance(50.0, 0.3), OMEGA**2 / (S**2 + S * OMEGA / 0.3 + OMEGA**2)),
    (high_pass(50.0, "low cut-off"), S / (S + OMEGA)),
    (integration(50.0, 3.0), 3.0 / (S + OMEGA)),
    (integration(0.0, 2.0), 2.0 / S),
    (recovery(0.1), np.ones(S.size)),
]


@pytest.mark.parametrize(("section", "transfer_function"), SECTIONS)
def test_section_has_its_transfer_function(section, transfer_function):
    np.testing.assert_allclose(transfer_of_states(section), transfer_function, rtol=1e-9)
    np.testing.assert_allclose(transfer_of_roots(section), transfer_function, rtol=1e-9)


def test_series_has_transfer_of_following_sections():
    random = np.random.default_rng(1)
    for _ in range(20):
        chosen = random.integers(0, len(SECTIONS), random.integers(0, 6))
        circuit = Circuit.series([SECTIONS[k][0] for k in chosen])
        assert circuit.sections == tuple(np.cumsum([0, *(SECTIONS[k][0].states for k in chosen)]))
        states = circuit.sections[-1]
        result = np.zeros((len(chosen) + 1, S.size), dtype=complex)
        for column, s in enumerate(S):
            inner = np.linalg.solve(s * np.eye(states) - circuit.a, circuit.b.T) if states else np.zeros((0, 1))
            result[:, column] = circuit.c @ inner + circuit.d
        for entry in range(len(chosen) + 1):
            expected = np.prod([SECTIONS[k][1] for k in chosen[entry:]], axis=0) * np.ones(S.size)
            np.testing.assert_allclose(result[entry], expected, rtol=1e-8)


def test_zero_shift_decays_with_its_time_constant():
    section = recovery(0.1)
    # Only an overload excites the state. The state reduces the reading and halves in 0.1 ln 2 seconds.
    assert not section.b.any()
    assert section.c.tolist() == [-1.0]
    assert np.exp(section.a[0, 0] * 0.1 * np.log(2.0)) == pytest.approx(0.5)

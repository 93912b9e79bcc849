"""Random tests of spring-mass chains, simulated by numpy alone: a reference that shares no code with the package.

The force is periodic and band-limited. Its spectrum is multiplied by the exact accelerance; the record is half a period
of force and responses. White noise is added to the force and to each response.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from rig.core.base.arrays import Array


@dataclass(frozen=True)
class Chain:
    """Masses [kg], springs [N/m] from ground on, and a damping ratio for each mode."""

    masses: Array
    springs: Array
    damping: Array

    @property
    def matrices(self) -> tuple[Array, Array]:
        """Return the mass and stiffness matrices."""
        next_springs = np.append(self.springs[1:], 0.0)
        coupling = np.diag(next_springs[:-1], 1)
        return np.diag(self.masses), np.diag(self.springs + next_springs) - coupling - coupling.T

    @property
    def modes(self) -> tuple[Array, Array]:
        """Return the natural frequencies in Hz, and the mode shapes of unit modal mass (bodies, modes)."""
        mass, stiffness = self.matrices
        omega_squared, shapes = linalg.eigh(stiffness, mass)
        return np.sqrt(omega_squared) / (2.0 * np.pi), shapes


def random_chain(seed: int) -> Chain:
    """Draw a chain of 2 to 4 bodies."""
    random = np.random.default_rng(seed)
    bodies = int(random.integers(2, 5))
    while True:
        chain = Chain(
            random.uniform(0.4, 3.0, bodies),
            10 ** random.uniform(4.0, 5.5, bodies),
            random.uniform(0.004, 0.02, bodies),
        )
        frequency = chain.modes[0]
        if np.all(frequency[1:] > 1.15 * frequency[:-1]) and frequency[0] > 8.0 and frequency[-1] < 180.0:
            return chain


def accelerances(chain: Chain, frequency: Array) -> NDArray[np.complex128]:
    """Return the accelerances of all bodies for a force on body 1, shape (bodies, frequencies)."""
    natural, shapes = chain.modes
    omega, natural_omega = 2.0 * np.pi * frequency, 2.0 * np.pi * natural[:, None]
    modal_accelerance = -(omega**2) / (
        natural_omega**2 - omega**2 + 2j * chain.damping[:, None] * natural_omega * omega
    )
    return np.asarray((shapes * shapes[0]) @ modal_accelerance)


def random_test(chain: Chain, path: Path, seed: int) -> dict[str, Any]:
    """Write a random test as a text table; return the settings of its scene, with wrong masses and springs.

    The force on body 1 has an rms value of 10 N. The noise is 3 % of the rms value of the force, and 1 % of the rms
    value of each response.
    """
    random = np.random.default_rng(seed)
    rate, low, high, duration = 1000.0, 4.0, 220.0, 20.0
    count = 2 * round(duration * rate)
    frequency = np.fft.rfftfreq(count, 1.0 / rate)
    # The force covers more than the band of the test.
    is_excited = (frequency > 0.5 * low) & (frequency < 1.2 * high)
    spectrum = np.zeros(frequency.size, dtype=complex)
    spectrum[is_excited] = random.normal(size=is_excited.sum()) + 1j * random.normal(size=is_excited.sum())
    spectra = np.zeros((chain.masses.size + 1, frequency.size), dtype=complex)
    spectra[0] = spectrum
    spectra[1:, is_excited] = accelerances(chain, frequency[is_excited]) * spectrum[is_excited]
    rows = np.fft.irfft(spectra, count, axis=1)[:, : count // 2]
    rows *= 10.0 / rows[0].std()
    noise_rms = np.array([0.03] + [0.01] * chain.masses.size) * rows.std(axis=1)
    rows += noise_rms[:, None] * random.normal(size=rows.shape)
    names = ["force [N]", *(f"a{k} [m/s^2]" for k in range(1, chain.masses.size + 1))]
    table = np.vstack([np.arange(count // 2) / rate, rows]).T
    np.savetxt(path, table, "%.9g", ",", header=",".join(["time [s]", *names]), comments="")
    guess_random = np.random.default_rng(seed + 1)
    return {
        "name": path.stem,
        "structure": {
            "masses": (chain.masses * np.exp(guess_random.uniform(-0.2, 0.2, chain.masses.size))).tolist(),
            "springs": (chain.springs * np.exp(guess_random.uniform(-0.2, 0.2, chain.masses.size))).tolist(),
            "damping": {"modal": 0.01},
        },
        "shaker": {"kind": "force", "body": 1},
        "test": {
            "kind": "random", "from": low, "to": high, "duration": duration, "force": 10.0,
        },
        "channels": [
            {"name": "force", "at": "shaker"},
            *({"name": f"a{k}", "at": f"body {k}"} for k in range(1, chain.masses.size + 1)),
        ],
        "converter": {"rate": rate},
        "recording": {"display": False},
    }  # fmt: skip

"""All parts of the reproduction (simulations and virtual experiments) with their inputs."""

from pathlib import Path
from typing import Any

import numpy as np

import rig
from analysis.studies.paper import bed_study, contact_study, experiment, scan, simulation
from analysis.studies.paper.store import PaperPart
from rig.core.scene.scene import Scene

# Frequency band around the third mode.
THIRD_MODE_BAND_HZ = (45.0, 54.0)
# Forces of the scans [N].
FORCES = np.array([2.0, 2.6, 3.3, 4.0, 5.0, 7.5, 10.0, 15.0])
# Clearances of the scans [m].
CLEARANCES = 1e-3 * np.array([0.3, 0.4, 0.5, 0.6, 0.7, 1.0, 1.4, 2.0, 3.0])
# Force [N] and clearance [m] of Figs 5 and 6: our choice, because the paper does not give these values.
FIGURE_5_SETTING = (3.3, 0.5e-3)
# Frequency band around each mode [Hz].
MODE_BANDS = {1: (11.5, 14.0), 2: (31.0, 36.0), 3: (45.5, 51.5)}
# Damping ratios for Fig 9.
DAMPINGS = np.array([0.003, 0.005, 0.0075, 0.01, 0.015])
# Clearances for Fig 9, m.
FIGURE_9_CLEARANCES = 1e-3 * np.array([0.9, 0.98, 1.05, 1.1, 1.15, 1.2, 1.3])
# Mass ratios for the best clearance.
MASS_RATIOS = (0.03, 0.06, 0.10)
# Mass ratios of the search for the best damper.
WIDE_MASS_RATIOS = np.array([0.02, 0.05, 0.1, 0.15, 0.2, 0.3])
# Damping ratios of each mode for Fig 8; the paper gives none.
SCANNED_DAMPINGS = np.array([0.002, 0.005, 0.01, 0.02])
# Forces for Fig 8 [N]; the paper has 2.6 N.
SCANNED_FORCES = np.array([0.65, 1.3, 2.6, 5.2])
# Mass ratios for Fig 8; the paper has 10 %.
SCANNED_MASS_RATIOS = np.array([0.05, 0.10])
# Noise densities of the accelerometers in Fig 10a, ug/sqrt(Hz).
NOISES = (20, 200, 2000)
# Frequency grid that resolves the peaks and antiresonances of bodies 1 and 2 with three dampers [Hz].
NOISE_GRID = np.concatenate(
    [
        np.linspace(low, high, 5)
        for low, high in ((12.2, 13.0), (16.4, 17.2), (26.4, 26.8), (33.9, 34.7), (41.8, 42.6), (47.0, 49.0))
    ]
)
# Third resonance, finer near the peak with a single damper.
THIRD_RESONANCE_GRID = np.unique(np.concatenate([np.linspace(45.5, 53.0, 16), np.linspace(46.2, 50.4, 22)]))
# Fig 8 covers all resonances: fine around them, with and without the dampers' masses, and coarse elsewhere.
SWEEP_GRID = np.unique(
    np.round(
        np.concatenate(
            [np.linspace(8, 60, 80), np.linspace(12, 13.8, 28), np.linspace(31.5, 36, 28), np.linspace(45.5, 51, 28)]
        ),
        3,
    )
)
# Computing time of the parts on one core [s]; all other parts take a few seconds at most.
EFFORT = {
    "approx-peaks": 50.0, "scan-three": 17.0, "least-affected": 16.0, "optimum": 9.0, "rec-one": 7.0, "rec-two": 7.0,
    "rec-three": 7.0, "rec-bare": 5.0, "rec-fig9": 5.0, "rec-fig9-down": 5.0, "scan-single": 4.0, "best-03": 4.0,
    "best-06": 3.0, "best-10": 3.0, "rec-noise-20": 1.5, "rec-noise-200": 1.5, "rec-noise-2000": 2.0,
    "fig9-damping": 1.5, "sim-three": 1.5,
}  # fmt: skip
# Clearances at which a body on a spring shows each type of motion at one force and frequency, in Fig 3.
TYPES = {"I": 0.98e-3, "II": 0.5e-3, "III": 0.25e-3}
# Points of Fig 5 whose waveforms Fig 6 shows.
WAVES = {"a": ("fig5-single-damper", 48.25), "b": ("fig5-three-dampers", 48.0), "c": ("fig5-three-dampers", 49.75)}


def all_parts(folder: Path) -> list[PaperPart]:
    """Return all parts; `folder`: output folder, for the recordings of the virtual experiments."""
    single, three = rig.load("fig5-single-damper"), rig.load("fig5-three-dampers")
    fig9, fig10a = rig.load("fig9"), rig.load("fig10a")
    grid = {"forces": FORCES, "clearances": CLEARANCES, "frequencies": THIRD_RESONANCE_GRID, "mass_ratio": 0.10}
    optimum_inputs: dict[str, Any] = {"force": 3.3, "frequencies": THIRD_RESONANCE_GRID}
    wide_band, dense_grid = {"band": (46.0, 54.0)}, {"frequencies": np.linspace(*THIRD_MODE_BAND_HZ, 109)}
    jobs: list[tuple[str, str, Any, Scene, dict[str, Any]]] = [
        ("scan-three", "scan of force and clearance, three dampers", scan.scan, three, grid),
        ("scan-single", "scan of force and clearance, one damper", scan.scan, single, grid),
        *(
            (
                f"best-{round(100 * ratio):02d}", f"best clearance, mass ratio {100 * ratio:.0f} %",
                scan.best_clearance, fig9, optimum_inputs | {"mass_ratio": ratio, "clearances": CLEARANCES},
            )
            for ratio in MASS_RATIOS
        ),
        (
            "optimum", "best clearance and mass ratio", scan.best_damper, fig9,
            optimum_inputs | {"mass_ratios": WIDE_MASS_RATIOS, "clearances": CLEARANCES[1:-1]},
        ),
        (
            "approx-peaks", "approximate method over force and clearance", simulation.approximate_peaks, single,
            {"forces": FORCES, "clearances": CLEARANCES, "band": THIRD_MODE_BAND_HZ},
        ),
        ("orbit-fig9", "exact orbits of Fig 9", simulation.exact_orbits, fig9, wide_band),
        (
            "approx-fig9", "approximate method, Fig 9", simulation.approximate_branches, fig9,
            wide_band | {"mode": 3, "weighting": "printed"},
        ),
        ("sim-three", "simulation of Fig 10a", simulation.simulate_response, fig10a, {"frequencies": SWEEP_GRID}),
        (
            "fig9-damping", "Fig 9 over damping and clearance", scan.type_iii_over_damping, fig9,
            {"dampings": DAMPINGS, "clearances": FIGURE_9_CLEARANCES, "frequencies": THIRD_RESONANCE_GRID},
        ),
        *(
            (
                f"type-{kind}", f"motion of Type {kind}", simulation.waveforms, _one_body(clearance),
                {"frequency": 49.67},
            )
            for kind, clearance in TYPES.items()
        ),
        *(
            (
                f"weights-{count}", f"both weightings of the mass ratio, {count.replace('-', ' ')}",
                simulation.peaks_by_weighting, rig.load(f"fig8-{count}"), {"bands": MODE_BANDS},
            )
            for count in ("one-damper", "two-dampers", "three-dampers")
        ),
        (
            "least-affected", "Fig 8 over damping, mass ratio and force", scan.least_affected,
            rig.load("fig8-three-dampers"),
            {
                "dampings": SCANNED_DAMPINGS, "mass_ratios": SCANNED_MASS_RATIOS, "forces": SCANNED_FORCES,
                "bands": MODE_BANDS,
            },
        ),
        (
            "sim-noise", "Fig 10a where noise matters", simulation.simulate_response, fig10a,
            {"frequencies": np.sort(NOISE_GRID)},
        ),
        ("sim-fig5-single", "simulation of Fig 5, one damper", simulation.simulate_response, single, dense_grid),
        ("sim-fig5-three", "simulation of Fig 5, three dampers", simulation.simulate_response, three, dense_grid),
        *(
            (
                f"wave-{letter}", f"waveform {letter} of Fig 6", simulation.waveforms, rig.load(name),
                {"frequency": frequency},
            )
            for letter, (name, frequency) in WAVES.items()
        ),
        (
            "structure", "linear properties of the structure", simulation.linear_properties, fig10a,
            {"frequencies": np.linspace(8.0, 60.0, 2001)},
        ),
    ]  # fmt: skip
    bundled = [
        PaperPart(name, f"{name}\n{study.TABLE.bundled.read_text(encoding='utf-8')}", study.table, {}, title, 0.1)
        for name, study, title in (
            ("beds", bed_study, "beds of grains compared with the single-mass model, stored"),
            ("contacts", contact_study, "single-mass model with contacts of finite duration, stored"),
        )
    ]
    return [*_experiments(folder), *(_part(*job) for job in jobs), *bundled]


def _one_body(clearance: float) -> Scene:
    """Build the scene of Fig 3: one body with a damper, mass ratio 6 %, 3.3 N around its resonance at 50 Hz."""
    return rig.loads(
        "{name: one body, structure: {masses: [2 kg], springs: [200 kN/m], damping: {modal: 0.5 %}}, "
        "shaker: {kind: force, body: 1}, test: {kind: stepped_sine, frequencies: [49.67 Hz], force: 3.3 N}, "
        f"dampers: [{{body: 1, mass_ratio: 6 %, clearance: {clearance}}}]}}"
    )


def _experiments(folder: Path) -> list[PaperPart]:
    """Return the parts that record and evaluate a virtual experiment."""
    fig10a, without_display = rig.load("fig10a"), {"display": False}
    test = {"kind": "stepped_sine", "frequencies": SWEEP_GRID.tolist(), "force": 2.6, "settle": {"longest": 20.0}}
    noise_test = test | {"frequencies": np.sort(NOISE_GRID).tolist()}
    jobs: list[tuple[str, Scene, Any]] = [
        (name, scene.replace(test=test, recording=without_display), compute)
        for name, scene, compute in (
            ("rec-bare", rig.load("fig4-structure"), experiment.bare_sweep),
            ("rec-one", rig.load("fig8-one-damper"), experiment.sweep),
            ("rec-two", rig.load("fig8-two-dampers"), experiment.sweep),
            ("rec-three", fig10a, experiment.sweep),
        )
    ]
    for noise in NOISES:
        noisy = _with_noise(fig10a, noise).replace(test=noise_test, recording=without_display)
        jobs.append((f"rec-noise-{noise}", noisy, experiment.sweep))
    jobs += [
        ("rec-fig9", rig.load("fig9", {"test.direction": "up"}), experiment.damper_sweep),
        ("rec-fig9-down", rig.load("fig9", {"test.direction": "down"}), experiment.damper_sweep),
        ("rec-hit-none", rig.load("fig10b-no-damper"), experiment.ring_down),
        ("rec-hit-three", rig.load("fig10b-three-dampers"), experiment.ring_down),
    ]
    return [
        _part(name, f"virtual experiment: {scene.name}", compute, scene, {}, folder) for name, scene, compute in jobs
    ]


def _with_noise(scene: Scene, density: float) -> Scene:
    """Set the noise density [ug/sqrt(Hz)] of all accelerometers of a scene."""
    noise = f"{density:g} ug/sqrt(Hz)"
    channels = [
        channel.replace(accelerometer=channel.accelerometer.replace(noise=noise)) if channel.accelerometer else channel
        for channel in scene.channels or ()
    ]
    return scene.replace(channels=tuple(channels))


def _part(
    name: str, title: str, compute: Any, scene: Scene, arguments: dict[str, Any], folder: Path | None = None
) -> PaperPart:
    """Return a part; `folder`: output folder, if the part makes a recording. The folder does not affect the results."""
    serialized = {
        key: value if isinstance(value, dict) else np.asarray(value).tolist() for key, value in arguments.items()
    }
    all_inputs = f"{name}\n{scene.to_si_yaml()}\n{serialized}"
    inputs = {"scene": scene, **arguments}
    if folder is not None:
        inputs["path"] = folder / "recordings" / f"{name.removeprefix('rec-')}.mcap"
    return PaperPart(name, all_inputs, compute, inputs, title, EFFORT.get(name, 1.0))

"""A bed of grains shared by two MPI ranks (processes), compared with the same bed on one rank."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rig.core.system.spheres import spheres_of
from rig.extras.grains import packing
from rig.extras.grains.bed import FLOOR, Bed
from rig.extras.grains.coupling import CoupledPropagator
from rig.extras.grains.shared_bed import new_bed
from tests.rig.grains.scenes import momentum_errors, with_grains
from tests.rig.mpi import on_two_ranks


def coupled_bed() -> CoupledPropagator:
    """Return the engine for a body with about 30 grains in a narrow cavity, so that one rank has the upper half."""
    return CoupledPropagator(with_grains(mass="1.5 g", cavity="5 mm"), 1e-3)


def flying_grains() -> tuple[dict[str, NDArray[np.float64]], CoupledPropagator]:
    """Return the motion of grains that were accelerated into flight, and the engine after further flight."""
    coupled = coupled_bed()
    # Push the body up for 60 time steps, then down for 60, N.
    force = np.repeat([1.5, -5.0], [60, 60])[None]
    coupled.set_state(coupled.system.initial, force[:, 0])
    initial_momentum = coupled.momentum
    trajectory, beds = coupled.propagate_steps(force)
    motion = {
        "gap": beds.gap,
        "force": beds.force,
        "displacement": trajectory.state[:, 0],
        "positions": coupled.beds[0].positions,
        "momentum_errors": momentum_errors(coupled, initial_momentum, beds) / (np.abs(beds.force).sum() * coupled.step),
    }
    # Move the grains up by 0.75 mm, so that some cross the border between two ranks.
    coupled.beds[0].add_velocity(2.0)
    coupled.beds[0].advance(25)
    return motion | {"last_positions": coupled.beds[0].positions}, coupled


def bed_below_a_high_grain() -> Bed:
    """Return a column of grains, the highest of which is far above: half of the height contains a single grain."""
    spheres = spheres_of(with_grains(mass="0.8 g"))[0]
    heights = 1e-3 + 2.1e-3 * np.arange(spheres.count)
    heights[-1] = 0.2
    positions = np.column_stack([0.0 * heights, 0.0 * heights, heights])
    return new_bed(spheres, positions, np.inf, 9.8, spheres.longest_step())


def program(*lines: str) -> str:
    """Return the text of a Python program that uses the packings (settled positions of grains) of this test run."""
    folder_line = f"packing.folder = lambda: Path({str(packing.folder())!r})"
    return "\n".join(["from pathlib import Path", "from rig.extras.grains import packing", folder_line, *lines])


def error_lines(stderr: str) -> list[str]:
    """Return the lines of standard error without the progress of slow computations and of compilation."""
    return [line for line in stderr.splitlines() if not line.startswith(("running", "compiling"))]


@pytest.fixture(scope="module")
def two_ranks(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    """Run two ranks that simulate a bed before `ranks.join()`, and move others afterwards as on one core.

    Returns the output, and the file of the motion.
    """
    file = tmp_path_factory.mktemp("shared") / "motion.npz"
    completed = on_two_ranks(
        program(
            "import numpy as np",
            "import rig",
            "import rig.extras.grains.shared_bed as shared_bed",
            "from rig.extras.grains import ranks",
            "from rig.core.base.errors import RunError",
            "from tests.rig.grains.scenes import with_grains",
            "from tests.rig.grains.test_shared_bed import bed_below_a_high_grain, coupled_bed, flying_grains",
            "try:",
            "    rig.simulate(with_grains(), duration=0.001)",
            "except RunError as error:",
            "    print(error, flush=True)",
            "ranks.join()",
            "shared_bed.cores = lambda: 1",
            "(motion, coupled), (repeated, other) = flying_grains(), flying_grains()",
            "assert all(np.array_equal(motion[name], repeated[name]) for name in motion)",
            "push = 1.5 * np.ones((1, 60))",
            "state = other.state()",
            "_, expected = other.propagate_steps(push)",
            "restored = coupled_bed()",
            "local = [each.beds[0]._array_sizes()[0] for each in (restored, coupled)]",
            "shared_bed.cores = lambda: 2",
            "local.append(bed_below_a_high_grain()._array_sizes()[0])",
            f"np.savez({str(file)!r}, **motion, local=local)",
            "restored.resume(state)",
            "_, resumed = restored.propagate_steps(push)",
            "print(np.array_equal(expected.force, resumed.force), np.ptp(expected.force) > 0.0)",
        )
    )
    return completed, file


def test_two_ranks_move_a_bed_as_one_rank(two_ranks: tuple[subprocess.CompletedProcess[str], Path]) -> None:
    # On two ranks: repeated motions are identical; a bed resumes from a stored state; each rank has half of the grains.
    completed, file = two_ranks
    one_rank, _ = flying_grains()

    assert (completed.returncode, completed.stdout.splitlines()[-1]) == (0, "True True")
    motion = np.load(file)
    first_count, last_count, count_below = motion["local"]
    assert 0.3 < first_count / len(motion["positions"]) < 0.7
    assert count_below == pytest.approx(len(bed_below_a_high_grain().positions) / 2, abs=1)
    assert last_count != first_count, "no grain changes its rank"
    assert one_rank["force"][0, FLOOR, -1] == 0.0 and one_rank["gap"].max() > 1e-5, "the bed is not in flight"
    for name in ("gap", "force", "displacement", "positions", "last_positions"):
        assert np.abs(motion[name] - one_rank[name]).max() < 1e-9 * np.abs(one_rank[name]).max(), name
    assert np.abs(motion["momentum_errors"]).max() < 1e-12


def test_simulation_before_joining_is_reported(two_ranks: tuple[subprocess.CompletedProcess[str], Path]) -> None:
    # The lines of the ranks may be interleaved.
    assert two_ranks[0].stdout.count("rig.extras.grains.ranks.join()") == 2


def test_more_ranks_than_cores_cause_one_warning(two_ranks: tuple[subprocess.CompletedProcess[str], Path]) -> None:
    # The warning and its source line.
    warning, _ = error_lines(two_ranks[0].stderr)
    assert "2 ranks on 1 cores" in warning


def test_command_on_two_ranks_prints_once(tmp_path: Path) -> None:
    file = tmp_path / "bed.csv"
    scene = tmp_path / "bed.yaml"
    scene.write_text(
        "{name: bed, structure: {masses: [10 g], springs: [400 N/m]}, shaker: {kind: force, body: 1},"
        "test: {kind: sine, frequency: 30 Hz, force: 0.4 N}, dampers: [{body: 1, mass: 0.3 g, clearance: 1 mm,"
        "grains: {diameter: 2 mm, cavity: 6 mm, modulus: 10 MPa, time_step: 0.015 ms}}]}"
    )
    arguments = ["rig", "simulate", str(scene), "--duration", "2 ms", "-o", str(file)]

    result = on_two_ranks(
        program(
            "import sys",
            f"sys.argv = {arguments!r}",
            "from rig.commands.command_line import run_command",
            # On a busy machine, lines of progress would follow.
            "from rig.core.base import console",
            "console.REPORT_INTERVAL_S = float('inf')",
            "run_command('rig.commands.cli')",
        )
    )

    assert (result.returncode, error_lines(result.stderr)) == (0, [])
    assert result.stdout.count("work of the drive") == 1
    assert file.is_file()

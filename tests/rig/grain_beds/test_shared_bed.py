"""A bed shared by two ranks against the same bed on one rank."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rig.grain_beds import packing
from rig.grain_beds.coupling import CoupledPropagator
from tests.rig.grain_beds.scenes import with_grains
from tests.rig.mpi import on_two_ranks


def coupled_bed() -> CoupledPropagator:
    """Some 60 grains in two or three layers."""
    return CoupledPropagator(with_grains(mass="3 g", cavity="12 mm"), 1e-3)


def thrown() -> tuple[dict[str, NDArray[np.float64]], CoupledPropagator]:
    """Grains that have been thrown into flight: what was seen of them, and what they are in."""
    coupled = coupled_bed()
    push = np.repeat([1.5, -1.5], [150, 100])[None]
    coupled.place(coupled.system.initial, push[:, 0])
    trajectory, beds = coupled.march(push)
    seen = {
        "lift": beds.lift,
        "force": beds.force,
        "displacement": trajectory.state[:, 0],
        "positions": coupled.beds[0].positions,
        "momentum_errors": coupled.momentum_errors / (np.abs(beds.force).sum() * coupled.step),
    }
    return seen, coupled


def program(*lines: str) -> str:
    """Give a program whose beds are kept where those of this run of the tests are."""
    kept = f"packing.folder = lambda: Path({str(packing.folder())!r})"
    return "\n".join(["from pathlib import Path", "from rig.grain_beds import packing", kept, *lines])


def test_two_ranks_move_a_bed_alike(tmp_path: Path) -> None:
    file = tmp_path / "seen.npz"
    one, _ = thrown()

    done = on_two_ranks(
        program(
            "from rig import ranks",
            "ranks.join()",
            "import numpy as np",
            "from tests.rig.grain_beds.test_shared_bed import thrown",
            "(seen, coupled), (again, _) = thrown(), thrown()",
            "assert all(np.array_equal(seen[name], again[name]) for name in seen)",
            f"np.savez({str(file)!r}, **seen, held=coupled.beds[0]._sizes()[0])",
        )
    )

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    two = np.load(file)
    assert 0.3 < two["held"] / len(two["positions"]) < 0.7
    assert one["force"][0, 0, -1] == 0.0 and one["lift"].max() > 1e-5, "the bed does not fly"
    for name in ("lift", "force", "displacement", "positions"):
        assert np.abs(two[name] - one[name]).max() < 1e-9 * np.abs(one[name]).max(), name
    assert np.abs(two["momentum_errors"]).max() < 1e-12


def test_read_bed_of_two_ranks_has_same_bits() -> None:
    done = on_two_ranks(
        program(
            "from rig import ranks",
            "ranks.join()",
            "import numpy as np",
            "from tests.rig.grain_beds.test_shared_bed import coupled_bed, thrown",
            "push = -0.5 * np.ones((1, 60))",
            "_, there = thrown()",
            "state = there.state()",
            "_, seen = there.march(push)",
            "read = coupled_bed()",
            "read.resume(state)",
            "_, again = read.march(push)",
            "print(np.array_equal(seen.force, again.force), np.ptp(seen.force) > 0.0)",
        )
    )

    assert (done.returncode, done.stdout, done.stderr) == (0, "True True\n", "")


def test_two_ranks_run_a_command_once(tmp_path: Path) -> None:
    file = tmp_path / "bed.csv"
    scene = tmp_path / "bed.yaml"
    scene.write_text(
        "{name: bed, structure: {masses: [10 g], springs: [400 N/m]}, shaker: {kind: force, body: 1},"
        "test: {kind: sine, frequency: 30 Hz, force: 0.4 N}, dampers: [{body: 1, mass: 0.3 g, clearance: 1 mm,"
        "grains: {diameter: 2 mm, cavity: 6 mm, modulus: 10 MPa, time_step: 15 us}}]}"
    )
    words = ["rig", "simulate", str(scene), "--duration", "2 ms", "-o", str(file)]

    done = on_two_ranks(
        program(
            "import sys",
            f"sys.argv = {words!r}",
            "from rig.command_line import run_command",
            "run_command('rig.cli')",
        )
    )

    # On a busy machine, lines of progress appear.
    reported = [line for line in done.stderr.splitlines() if not line.startswith("running")]
    assert (done.returncode, reported) == (0, [])
    assert done.stdout.count("work of the drive") == 1
    assert file.is_file()


def test_processes_that_have_not_joined_are_reported() -> None:
    done = on_two_ranks(
        program(
            "import rig",
            "from tests.rig.grain_beds.scenes import with_grains",
            "from rig.errors import RunError",
            "try:",
            "    rig.simulate(with_grains(), duration=0.001)",
            "except RunError as error:",
            "    print(error)",
        )
    )

    assert done.returncode == 0
    assert done.stdout.count("rig.ranks.join()") == 2


def test_more_ranks_than_cores_are_warned_of() -> None:
    done = on_two_ranks(
        program(
            "import rig.grain_beds.shared_bed as shared_bed",
            "from rig import ranks",
            "ranks.join()",
            "shared_bed.cores = lambda: 1",
            "from tests.rig.grain_beds.test_shared_bed import coupled_bed",
            "coupled_bed()",
        )
    )

    assert done.returncode == 0
    assert "2 ranks on 1 cores" in done.stderr

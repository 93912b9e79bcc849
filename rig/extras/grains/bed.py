"""A bed of grains (the particles in one cavity of a body), moved by LAMMPS with the discrete element method.

The motion is described in the frame of the cavity, in which floor, ceiling and side wall are at rest. In this frame an
acceleration of the body appears as an equal velocity change of all grains, which `Bed.add_velocity` applies. Forces and
impulses follow from LAMMPS's velocity Verlet scheme: with the force F of the walls before and F' after a step h, the
grains receive the impulse (F + F') h / 2.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.base.output_files import temporary_folder
from rig.core.scene.damper import Grains
from rig.core.system.spheres import Spheres
from rig.extras.grains.lammps_library import new_lammps
from rig.extras.grains.rebound import restitution_at_step

#: Walls of a cavity, in the order of the entries of `Bed.forces`.
WALLS = ("floor", "ceiling", "side")
FLOOR, CEILING = 0, 1
#: Code of LAMMPS's function `extract_fix`: one row of data per atom.
_PER_ATOM = 1
#: Code of LAMMPS's function `extract_fix`: data as an array.
_ARRAY = 2


class Bed:
    """Grains in a cavity, whose axis is z and whose floor is at z = 0.

    `spheres`: properties of the grains; `positions`: positions of their centers [m], shape (grains, 3); `ceiling`:
    height of the ceiling, m, infinite for no ceiling; `gravity`: m/s²; `step`: time step [s].
    """

    def __init__(self, spheres: Spheres, positions: Array, ceiling: float, gravity: float, step: float) -> None:
        self.mass, self.gravity, self.step = spheres.mass, gravity, step
        self.walls = tuple(name for name in WALLS if name != "ceiling" or math.isfinite(ceiling))
        self._count = len(positions)
        self._grain_law, self._wall_commands = _contact_laws(spheres, ceiling, step)
        self._diameter = float(spheres.diameters().max())
        self._lammps = self._new_lammps()
        half_width = 1.1 * (0.5 * spheres.settings.cavity) + self._diameter
        bottom, top = -self._diameter, float(positions[:, 2].max()) + self._diameter
        box = f"region box block {-half_width!r} {half_width!r} {-half_width!r} {half_width!r} {bottom!r} {top!r}"
        self._command(*_SETUP_COMMANDS, box, "create_box 1 box")
        self._define_model()
        flat = np.ascontiguousarray(positions, dtype=np.float64).ravel()
        numbers = list(range(1, self._count + 1))
        self._call(self._lammps.create_atoms, self._count, numbers, [1] * self._count, flat.tolist())
        for atom, diameter in enumerate(spheres.diameters().tolist(), 1):
            self._command(f"set atom {atom} diameter {diameter!r}")
        self._command(f"set group all density {spheres.density()!r}")
        self._initialize()
        self._initial_center_of_mass = self.center_of_mass

    def state_bytes(self) -> bytes:
        """Return the state of the grains and of their contacts, for `resume`.

        This bed and a resumed bed both recompute neighbor lists and forces, so they continue bit-identically.
        """
        with temporary_folder() as folder:
            file = folder / "bed"
            self._command(f'write_restart "{file}"', "run 0 post no")
            # With several ranks, the first rank writes the state of all ranks.
            return file.read_bytes() if file.exists() else b""

    def resume(self, stored: bytes) -> None:
        """Continue from a state of the same grains in the same cavity."""
        self._lammps.close()
        self._lammps = self._new_lammps()
        with temporary_folder() as folder:
            file = folder / "bed"
            file.write_bytes(stored)
            self._command(*_SETUP_COMMANDS, f'read_restart "{file}"')
            self._define_model()
            self._initialize()

    def advance(self, steps: int = 1) -> None:
        """Advance by a number of steps."""
        self._command(f"run {steps} pre no post no")

    def add_drag(self, relaxation: float) -> None:
        """Add a viscous drag to each grain, for packing; `relaxation`: time constant of the drag [s]."""
        self._command(f"fix slow all viscous {float(self._masses.mean()) / relaxation!r}", "run 0 post no")

    def lower_ceiling(self, depth: float) -> None:
        """Move the ceiling, from the next step on, to a depth below its initial height [m]."""
        self._call(self._lammps.set_internal_variable, "lid", -depth)

    def stop_grains(self) -> None:
        """Set all velocities to zero."""
        self._velocity[:] = 0.0

    def add_velocity(self, change: float) -> None:
        """Add a change to the vertical velocity of all grains [m/s]."""
        self._velocity[:, 2] += change

    def forces(self) -> Array:
        """Return the upward force of floor, ceiling and side on the grains [N]; shape (3,)."""
        forces = [self._contacts[name][:, 3].sum() if name in self._contacts else 0.0 for name in WALLS]
        return self._sum_over_processes(np.array(forces))

    @property
    def momentum(self) -> float:
        """Upward momentum of the grains in the cavity [kg m/s]."""
        return float(self._sum_over_processes(self._masses @ self._velocity[:, 2]))

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy of the grains in the cavity without their rotation [J]."""
        return 0.5 * float(self._sum_over_processes(self._masses @ (self._velocity**2).sum(axis=1)))

    @property
    def center_of_mass(self) -> float:
        """Height of the center of mass above the floor [m]."""
        return float(self._sum_over_processes(self._masses @ self._position[:, 2])) / self.mass

    @property
    def gap(self) -> float:
        """Height of the center of mass above its initial height [m]: the gap of the equivalent single mass."""
        return self.center_of_mass - self._initial_center_of_mass

    @property
    def positions(self) -> Array:
        """Copy of the positions in the order in which they were given, shape (grains, 3)."""
        return self._position.copy()

    def _define_model(self) -> None:
        """Define contact laws, gravity, walls and time integration."""
        self._command(
            f"neighbor {0.25 * self._diameter!r} bin",
            "neigh_modify every 1 delay 0 check yes",
            "comm_modify vel yes",
            "pair_style granular",
            f"pair_coeff * * {self._grain_law}",
            "fix move all nve/sphere",
            f"fix weight all gravity {self.gravity!r} vector 0 0 -1",
            f"timestep {self.step!r}",
            # Otherwise LAMMPS would compute energy and pressure at both ends of a run, and a run is a single step.
            "thermo 1000000000",
            "thermo_style custom step",
            "variable lid internal 0.0",
            "variable lowered equal v_lid",
            *self._wall_commands,
        )

    def _initialize(self) -> None:
        """Compute neighbors and forces, and create views of LAMMPS's arrays."""
        self._command("run 0 post no")
        self._create_views()

    def _new_lammps(self) -> Any:
        return new_lammps()

    def _sum_over_processes(self, local: Array) -> Array:
        """Return the sum over all grains, from the sum over the grains of this process."""
        return local

    def _create_views(self) -> None:
        """Create views of LAMMPS's arrays of the grains, valid until the number or order of the grains changes."""
        count, arrays = self._lammps.extract_setting("nlocal"), self._lammps.numpy
        self._position, self._velocity, self._masses = (
            arrays.extract_atom(name)[:count] for name in ("x", "v", "rmass")
        )
        self._contacts = {name: arrays.extract_fix(name, _PER_ATOM, _ARRAY)[:count] for name in self.walls}

    def _command(self, *commands: str) -> None:
        for command in commands:
            self._call(self._lammps.command, command)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Call a function of LAMMPS; raises `RunError` with the reason if it fails."""
        try:
            function(*arguments)
        except Exception as error:
            reason = str(error).strip().splitlines()[0][:200]
            raise RunError(
                f"LAMMPS stopped the simulation of the grains: {reason}. If a grain has left the cavity, set a shorter "
                "grains.time_step, or a larger grains.modulus."
            ) from None


def contact_law(grains: Grains, restitution: float) -> str:
    """Return the contact law for LAMMPS: Hertz with a dashpot for the restitution, Mindlin up to Coulomb's limit."""
    return (
        f"hertz/material {grains.modulus!r} {restitution!r} {grains.poisson_ratio!r} "
        f"tangential mindlin NULL 1.0 {grains.friction!r} damping coeff_restitution"
    )


def _contact_laws(spheres: Spheres, ceiling: float, step: float) -> tuple[str, tuple[str, ...]]:
    """Return the contact law of two grains, and the LAMMPS commands that create the walls."""
    grains, mass = spheres.settings, spheres.mass / spheres.count
    radius, side_friction = 0.5 * grains.diameter, grains.side_friction
    wall_restitution = restitution_at_step(grains, mass, radius, step)
    floor_law = contact_law(grains, wall_restitution)
    side_law = (
        floor_law if side_friction is None else contact_law(grains.replace(friction=side_friction), wall_restitution)
    )
    # Two equal grains have half the mass and half the radius as reduced mass and radius.
    grain_law = contact_law(grains, restitution_at_step(grains, 0.5 * mass, 0.5 * radius, step))
    shapes = {"floor": "plane 0 0 0 0 0 1", "side": f"cylinder z 0 0 {0.5 * grains.cavity} INF INF"}
    if math.isfinite(ceiling):
        shapes["ceiling"] = f"plane 0 0 {float(ceiling)!r} 0 0 -1 move NULL NULL v_lowered"
    commands = []
    for name in WALLS:
        if name in shapes:
            law = side_law if name == "side" else floor_law
            commands += [
                f"region {name} {shapes[name]}",
                f"fix {name} all wall/gran/region granular {law} region {name} contacts",
            ]
    return grain_law, tuple(commands)


#: Commands before the box is created.
_SETUP_COMMANDS = (
    "units si",
    "atom_style sphere",
    # The order of the grains does not change, so index i of an array is always the same grain.
    "atom_modify map array sort 0 0",
    "boundary f f m",
    "newton off",
)

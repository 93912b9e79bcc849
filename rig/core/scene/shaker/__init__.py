"""Settings of shakers. Each kind has a module with the name of the kind."""

from typing import Annotated, get_args

from rig.core.scene.shaker.base import BaseShaker as BaseShaker
from rig.core.scene.shaker.electrodynamic import ElectrodynamicShaker as ElectrodynamicShaker
from rig.core.scene.shaker.force import ForceShaker as ForceShaker
from rig.core.scene.shaker.kind import KindOfShaker as KindOfShaker
from rig.core.scene.shaker.kind import Load as Load
from rig.core.scene.shaker.parts import DRIVE_PER_VOLT as DRIVE_PER_VOLT
from rig.core.scene.shaker.parts import Body as Body
from rig.core.scene.shaker.parts import Output as Output
from rig.core.scene.shaker.parts import at_shaker as at_shaker
from rig.core.scene.shaker.table import TableShaker as TableShaker
from rig.core.settings.alternatives import Alternatives, OneOrSeveral, by_kind

Shaker = Annotated[ForceShaker | TableShaker | ElectrodynamicShaker | BaseShaker, Alternatives(by_kind)]
#: Classes of shaker, by the value of their key `kind`.
KINDS: dict[str, type[KindOfShaker]] = {
    kind.model_fields["kind"].default: kind for kind in get_args(get_args(Shaker)[0])
}
#: Type of `shaker:` in a scene: one shaker or a list.
Shakers = Annotated[Shaker | tuple[Shaker, ...], OneOrSeveral(Shaker)]


def as_tuple(shaker: Shaker | tuple[Shaker, ...] | None) -> tuple[Shaker, ...]:
    """Return the shakers of the section `shaker`."""
    return shaker if isinstance(shaker, tuple) else () if shaker is None else (shaker,)

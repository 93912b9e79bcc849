"""Help of the commands: options in groups, and an example for each command."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

_SCENE, _TEST, _FREQUENCIES, _OUTPUT, _COMPUTING = "Scene", "Test", "Frequencies", "Output", "Computing"
_DAMPERS, _CRITERION, _CURVES, _BLOCKS, _NETWORK = (
    "Dampers to choose from", "Criterion", "Curves", "Averages of blocks", "Network",
)  # fmt: skip
# Group by parameter name, for options that do not specify their group.
_GROUPS = {
    _SCENE: ("changes", "scene", "clock", "table"),
    _TEST: ("duration", "rate", "force", "drive", "block_samples", "dry_run", "anyway", "measure"),
    _FREQUENCIES: (
        "frequency", "frequencies", "first", "last", "points", "direction", "periods", "over", "least", "most", "rows",
    ),
    _DAMPERS: ("budget", "bodies", "dampers", "clearance"),
    _CRITERION: ("levels", "band", "watched", "damping_off", "stiffness_off"),
    _CURVES: ("response", "reference", "motion", "unit", "theory", "modes", "channel", "hit", "free"),
    _BLOCKS: ("estimator", "block", "overlap", "window"),
    _NETWORK: ("address", "port", "certificate", "key", "client_ca", "session_timeout", "proto"),
    _OUTPUT: (
        "output", "overwrite", "save", "web", "viewer", "screenshot", "at", "begin", "end", "speed", "what", "fresh",
    ),
    _COMPUTING: ("cluster",),
}  # fmt: skip
_GROUP_OF = {name: group for group, names in _GROUPS.items() for name in names}
_OTHER = "Options"
# Number of options below which groups are not used.
_FEW = 5


class GroupedCommand(TyperCommand):
    """A command that lists its options in groups, and whose epilog is an example."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, then options by group, then all other options."""
        parameters = [(each, each.get_help_record(ctx)) for each in self.get_params(ctx)]
        options = [
            (each, record) for each, record in parameters if each.param_type_name == "option" and record
        ]
        sections: dict[str, list[tuple[str, str]]] = {
            "Arguments": [
                record for each, record in parameters if each.param_type_name != "option" and record
            ]
        }
        for each, record in options:
            group = getattr(each, "rich_help_panel", None) or _GROUP_OF.get(each.name or "", _OTHER)
            sections.setdefault(group if len(options) > _FEW else _OTHER, []).append(record)
        order = ["Arguments", *_GROUPS, _OTHER]
        for title in sorted(sections, key=order.index):
            if sections[title]:
                with formatter.section(title):
                    formatter.write_dl(sections[title])

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the example in one line of any length."""
        if self.epilog:
            with formatter.section("Example"):
                formatter.write(f"{'':{formatter.current_indent}}{self.epilog}\n")


class Application(typer.Typer):
    """An application in which each command has an example."""

    def command(
        self, name: str | None = None, *, example: str | None = None, **settings: Any
    ) -> Callable[..., Any]:
        """Register a command.

        `name`: name of the command; omitted, the name of the function; `example`: a command line as a user types it;
        `**settings`: arguments of `typer.Typer.command`.
        """
        return super().command(name, cls=GroupedCommand, epilog=example, **settings)

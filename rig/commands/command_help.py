"""Layout of the help that `COMMAND --help` prints: options in groups, and an example for each command."""

from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

from rig.commands.declaration import declare

# Group titles and their options (parameter names), for options whose declaration specifies no group.
_GROUPS = {
    "Scene": ("changes", "scene", "clock", "table"),
    "Test": ("duration", "rate", "force", "drive", "block_samples", "dry_run", "anyway", "measure"),
    "Frequencies": (
        "frequency", "first", "last", "points", "direction", "periods", "over", "least", "most", "lowest", "highest",
        "rows",
    ),
    "Dampers to choose from": ("budget", "bodies", "dampers", "clearance"),
    "Criterion": ("levels", "band", "watched", "damping_off", "stiffness_off"),
    "Curves": ("response", "reference", "motion", "unit", "theory", "modes", "channel", "impact", "free"),
    "Averages of blocks": ("estimator", "block", "overlap", "window"),
    "Network": ("host", "port", "certificate", "key", "client_ca", "session_timeout"),
    "Output": (
        "output", "overwrite", "save", "web", "viewer", "screenshot", "at", "begin", "end", "speed", "what", "fresh",
    ),
    "Computing": ("cluster",),
}  # fmt: skip
_GROUP_OF = {name: group for group, names in _GROUPS.items() for name in names}
# Title of options without a group.
_OTHER = "Options"
# Maximum number of options that are listed without groups; the heads of groups would be longer than the list.
_MAX_UNGROUPED = 5


class GroupedCommand(TyperCommand):
    """A command that lists its options in groups, and whose epilog is an example."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, then options by group, then all other options."""
        parameters = [(parameter, parameter.get_help_record(ctx)) for parameter in self.get_params(ctx)]
        options = [
            (parameter, help_row)
            for parameter, help_row in parameters
            if parameter.param_type_name == "option" and help_row
        ]
        sections: dict[str, list[tuple[str, str]]] = {
            "Arguments": [
                help_row for parameter, help_row in parameters if parameter.param_type_name != "option" and help_row
            ]
        }
        for parameter, help_row in options:
            group = getattr(parameter, "rich_help_panel", None) or _GROUP_OF.get(parameter.name or "", _OTHER)
            sections.setdefault(group if len(options) > _MAX_UNGROUPED else _OTHER, []).append(help_row)
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
        self, name: str | None = None, *, example: str | None = None, options: str = "", call: str = "", **settings: Any
    ) -> Callable[..., Any]:
        """Register a command.

        `name`: name of the command; omitted, the name of the function; `example`: a command line as a user types it;
        `options`: options that are parameters of a Python call, see `declare`; `call`: its name, by default the name of
        the command; `**settings`: arguments of `typer.Typer.command`.
        """

        def register(function: Callable[..., Any]) -> Any:
            declare(function, call or name or function.__name__, options)
            return super(Application, self).command(name, cls=GroupedCommand, epilog=example, **settings)(function)

        return register

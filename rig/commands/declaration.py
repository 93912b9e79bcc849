"""Options of commands. Each option is declared once: by the Python call with this parameter, or by the command.

Signature and docstring (numpydoc) of a call are read from its source, because its import would load numba or scipy.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

# Old names of options, which still work.
_OLD_NAMES = {"--impact": ["--hit"]}
# Upper limit of numbers whose type gives none ("int, at least 1"), so typing errors are rejected.
_MAX_COUNT = 100_000
# Options whose parameters have a different name in Python.
_OPTIONS = {
    "changes": "--set", "first": "--from", "from_s": "--from", "last": "--to", "to_s": "--to", "host": "--address",
}  # fmt: skip
# Types of options by the annotations of calls. Text may contain units, and commas between several values.
_TYPES: dict[str, Any] = {
    "bool": bool,
    "int": int,
    "float": float,
    "str": str,
    "float | str": str,
    "Sequence[float | str]": str,
    "Sequence[int | str]": str,
    "str | Path": Path,
    "Sequence[str]": list[str],
    "Sequence[float]": list[float],
}
_PACKAGES = Path(__file__).parents[2]


def declare(command: Callable[..., Any], call: str, usage: str) -> None:
    """Give a command function the signature from which typer makes its arguments and options.

    A parameter of the function is annotated with a placeholder and a text: `Annotated[float, "S: Time in seconds."]`.
    `usage`: options that are parameters of a call, with placeholders, such as `--at S --speed X`; `call`: its name in
    the package of the command. The function has parameters of the same names, or `**options`.
    """
    of_call = list(_options_of(command.__module__.partition(".")[0], call, usage)) if usage else []
    names = [option.name for option in of_call]
    own = [
        parameter.replace(annotation=_with_text(parameter))
        for parameter in inspect.signature(command, eval_str=True).parameters.values()
        if parameter.kind is not parameter.VAR_KEYWORD and parameter.name not in names
    ]
    n_first = sum(parameter.kind is not parameter.KEYWORD_ONLY for parameter in own)
    signature = inspect.Signature([*own[:n_first], *of_call, *own[n_first:]])
    # The signature contains all types; typer would evaluate the annotations of the function again.
    vars(command).update(__signature__=signature, __annotations__={})


def _with_text(parameter: inspect.Parameter) -> Any:
    """Return the annotation of a parameter of a command, with an argument or option."""
    value_type, *notes = get_args(parameter.annotation) or (parameter.annotation,)
    if not notes or not isinstance(notes[0], str):
        return parameter.annotation
    placeholder, separator, text = notes[0].partition(": ")
    if not separator or " " in placeholder:
        placeholder, text = "", notes[0]
    if placeholder.startswith("[") or (parameter.default is parameter.empty and parameter.name != "output"):
        return Annotated[value_type, typer.Argument(metavar=placeholder, help=text)]
    return _option(parameter.name, value_type, placeholder, text, is_on=parameter.default is True)


def _option(name: str, value_type: Any, placeholder: str, text: str, *, is_on: bool, kind: str = "") -> Any:
    """Return the annotation of an option. `is_on`: it is a flag that is on by default; `kind`: type with limits."""
    option = _option_name(name)
    old = _OLD_NAMES.get(option, [])
    names = ["-o", option] if name == "output" else [f"{option}/--no-{option[2:]}" if is_on else option, *old]
    limits = re.search(r"at least (\d+)|(\d+) to (\d+)", kind)
    minimum, maximum = (int(limits[1] or limits[2]), int(limits[3] or _MAX_COUNT)) if limits else (None, None)
    return Annotated[value_type, typer.Option(*names, metavar=placeholder or None, help=text, min=minimum, max=maximum)]


def _option_name(parameter: str) -> str:
    return _OPTIONS.get(parameter, f"--{parameter.replace('_', '-')}")


def _options_of(package: str, call: str, usage: str) -> Iterator[inspect.Parameter]:
    """Yield the options in a usage text, such as `--from F --direction`, from the parameters of a call."""
    function = _read(package, call)
    arguments = [*function.args.args, *function.args.kwonlyargs]
    defaults = [*function.args.defaults, *function.args.kw_defaults]
    by_option = {
        _option_name(argument.arg): (argument, default)
        for argument, default in zip(arguments[-len(defaults) :], defaults, strict=True)
    }
    for words in usage.removeprefix("--").split(" --"):
        option, _, placeholder = words.partition(" ")
        argument, default_node = by_option[f"--{option}"]
        default = ast.literal_eval(default_node)
        value_type = _TYPES[ast.unparse(argument.annotation).removesuffix(" | None")]
        kind, text = _kind_and_text(package, call, argument.arg)
        if value_type in (list[str], list[float]):
            text += " May be repeated."
        declared = _option(
            argument.arg,
            value_type,
            placeholder or "|".join(re.findall(r"'(\w+)'", kind)),
            text,
            is_on=default is True,
            kind=kind,
        )
        yield inspect.Parameter(argument.arg, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=declared)


def _kind_and_text(package: str, call: str, parameter: str) -> tuple[str, str]:
    """Return type and text of a parameter from the docstring of a call; the docstring may refer to a different call."""
    docstring = ast.get_docstring(_read(package, call)) or ""
    for names, kind, lines in re.findall(r"^(\w[\w, ]*) : (.*)\n((?:    .*\n?)+)", docstring, re.MULTILINE):
        if parameter in names.split(", "):
            if kind.startswith("as in `"):
                return _kind_and_text(package, kind.strip("`").rpartition("`")[2].rpartition(".")[2], parameter)
            # In a terminal, text is in single quotes, and names have no quotes.
            return kind, re.sub(r"``(.*?)``", lambda code: code[1].replace('"', "'"), " ".join(lines.split()))
    raise KeyError(f"the docstring of {package}.{call} does not describe the parameter {parameter}")


@cache
def _read(package: str, call: str) -> Any:
    """Return the syntax tree of a public call without its code."""
    source = (_PACKAGES / package / f"{_modules(package)[call].replace('.', '/')}.py").read_text(encoding="utf-8")
    begin = source.index(f"\ndef {call}(")
    end = source.index('"""', source.index('"""', begin) + 3)
    return ast.parse(source[begin : end + 3]).body[0]


@cache
def _modules(package: str) -> dict[str, str]:
    """Return the modules of the public names of a package."""
    stub = (_PACKAGES / package / "__init__.pyi").read_text(encoding="utf-8")
    imports = re.findall(r"^from \.(\S+) import (.*)", stub, re.MULTILINE)
    return {name: module for module, names in imports for name in names.split(", ")}

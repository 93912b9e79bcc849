"""Handling of Ctrl-C during the import of a command: the process ends immediately, without a traceback.

The packages import this module first, so it has no slow imports. Later, `rig.commands.command_line` handles signals.
"""

import sys

_COMMANDS = ("rig", "daq", "analysis")


def restore_default_interrupt() -> None:
    """Restore the default action of Ctrl-C, if this process runs one of the commands.

    Scripts and notebooks that import the packages keep their own handlers.
    """
    if not is_command(getattr(sys, "argv", []), sys.orig_argv):
        return
    import signal

    # The parent may ignore the signal (background jobs of a shell), or have its own handler.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_command(words: list[str], all_words: list[str]) -> bool:
    """Return whether a process runs one of the commands.

    `words`: `sys.argv`; its first element is ``-m`` until Python has located the module; `all_words`:
    `sys.orig_argv`, which includes the options of Python.

    >>> is_command(["/usr/bin/rig", "scenes"], ["python", "/usr/bin/rig", "scenes"])
    True
    >>> is_command(["-m", "scenes"], ["python", "-X", "dev", "-m", "rig", "scenes"])
    True
    >>> is_command(["my_script.py", "rig"], ["python", "my_script.py", "rig"])
    False
    """
    if not words:
        return False
    if words[0] == "-m" and len(words) < len(all_words):
        return all_words[-len(words)].removeprefix("-m") in _COMMANDS
    return words[0].replace("\\", "/").rpartition("/")[2].removesuffix(".exe") in _COMMANDS

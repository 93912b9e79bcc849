"""Ctrl-C while a command is still being imported: it ends at once and without a word, never in a traceback.

The packages import this before anything else, so it imports nothing that takes time; `rig.command_line` answers
signals from when it is there.
"""

import sys

_COMMANDS = ("rig", "daq", "analysis")


def end_silently() -> None:
    """Let Ctrl-C end this process as it ends programs that are not of Python, if it is one of the commands.

    Scripts and notebooks that import the packages keep what they have set.
    """
    if not is_command(getattr(sys, "argv", []), sys.orig_argv):
        return
    import signal

    # Whoever started the process may want it to go on (a shell's background), or have an answer of its own.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_command(words: list[str], all_words: list[str]) -> bool:
    """Whether a process runs one of the commands.

    Parameters
    ----------
    words : list of str
        `sys.argv`; its first is ``-m`` while Python still looks for the module to run.
    all_words : list of str
        `sys.orig_argv`, with the words that were Python's own.

    Examples
    --------
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

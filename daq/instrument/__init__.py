"""The emulated DAQ device: modules on one clock, tasks, and engines that run the tasks.

This package does not depend on clients or on a network. Start with `chassis`, then `task`; `plans` converts the
settings of a task into plans for the engines.
"""

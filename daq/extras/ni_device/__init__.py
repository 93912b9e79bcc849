"""An NI DAQ device, emulated on the bench of a scene: modules on one clock, tasks, and engines that run the tasks.

The package does not depend on clients or on a network. Start with `chassis`, then `task`; `plans` converts the
settings of a task into plans for the engines. Names of settings, values and errors are those of NI-DAQmx.
"""

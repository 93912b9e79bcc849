"""The objects that a script for `nidaqmx` sees: tasks, channels, timing, streams, triggers, events.

Start with `task`.
"""

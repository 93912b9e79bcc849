"""The device: modules on one clock, tasks as data, engines that run them; it knows no client and no network.

Start with `chassis`, then `task`; `plans` turns what a task's settings ask into what the engines run.
"""

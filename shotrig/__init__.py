"""The command `shotrig`, which runs the commands `rig`, `daq` and `analysis`."""

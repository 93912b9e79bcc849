"""Settings of tasks as data: channels, timing, triggers and streams, and settings saved under a name."""

"""Settings of tasks: channels, timing, triggers and streams, custom scales, and settings saved under a name."""

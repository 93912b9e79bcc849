"""What a script says of a task, as data: its channels, timing, triggers and streams, and what is saved under a name."""

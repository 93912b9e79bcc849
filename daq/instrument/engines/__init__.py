"""What runs on the clock: inputs with their buffers, triggers and logs, and outputs; knows no task and no device."""

"""What every analysis uses."""

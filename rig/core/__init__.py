"""What every test uses."""

"""What needs an installable extra."""

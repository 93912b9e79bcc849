"""What each remote call does on the instrument."""

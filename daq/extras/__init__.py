"""One vendor's device, foreign files, viewers."""
